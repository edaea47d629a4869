"""A simulated scene reconstructed over time and scored, as the figures of a case; and means over cases."""

import time
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.bodies import body_joints
from shapepose_fg.evaluation.experiments.experiment import Figures
from shapepose_fg.evaluation.identities import identity_metrics
from shapepose_fg.evaluation.matching import match_people
from shapepose_fg.evaluation.metrics import covariance_calibration, metrics_of
from shapepose_fg.evaluation.tracking import views_used
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import Scene


def solve_and_score(scene: Scene, detections: DetectionSequence, config: PipelineConfig | None = None) -> Figures:
    """`score_scene` of the reconstruction of `detections`, and the processor's milliseconds a frame."""
    began = time.process_time()
    people = reconstruct(detections, scene.rig, config, times=FrameTimes.from_fps(scene.fps, len(scene)))
    cpu_ms = 1e3 * (time.process_time() - began)
    return score_scene(people, scene) | {"cpu_ms": cpu_ms}


def score_scene(people: Reconstruction, scene: Scene) -> Figures:
    """Sums and counts, so that several cases have a mean: `mean_of` makes figures of them.

    Seen are the joints of matched rows that two views or more saw, unseen those that fewer did.
    """
    truth = scene.keypoints
    matches = match_people(people.frame, people.joints, truth)
    joints = metrics_of(matches, people.joints, truth)
    identities = identity_metrics(matches, people.frame.astype(np.intp), people.person, people.joints, truth)
    found, true = people.rows(matches.row), truth[matches.frame, matches.person]
    error, seen = found.joints - true, views_used(found) >= 2
    inside = {
        name: covariance_calibration(error[those], found.covariance[those])
        for name, those in (("seen", seen), ("unseen", ~seen))
    }
    return {
        "frames": len(scene),
        "true": joints.joints_true,
        "predicted": joints.joints_predicted,
        "correct": joints.joints_correct,
        "identified": 2 * identities.true_positives,
        "identities": identities.rows + identities.people_true,
        "nobody": joints.people_invented + joints.people_duplicated,
        "missed": joints.people_missed,
        "error_mm": _sum(error),
        "seen_mm": _sum(error[seen]),
        "unseen_mm": _sum(error[~seen]),
        "body_mm": _sum(body_joints(found) - true),
        "inside_95": _inside(inside["seen"].nees, inside["seen"].coverage[0.95]),
        "unseen_inside_95": _inside(inside["unseen"].nees, inside["unseen"].coverage[0.95]),
    }


def mean_of(cases: Iterable[Figures]) -> dict[str, float]:
    """F1, IDF1 and shares in %, mean errors in mm, ms a frame, counts: of all cases together; NaN for none."""
    all_of = list(cases)
    counts = ("frames", "true", "predicted", "correct", "identified", "identities")
    total = {name: sum(case[name] for case in all_of) for name in counts}
    pairs = ("error_mm", "seen_mm", "unseen_mm", "body_mm", "inside_95", "unseen_inside_95")
    figures = {name: _ratio(*(sum(case[name][i] for case in all_of) for i in (0, 1))) for name in pairs}
    figures |= {name: 100 * figures[name] for name in ("inside_95", "unseen_inside_95")}
    figures |= {"f1": 200 * _ratio(total["correct"], total["predicted"] + total["true"])}
    figures |= {"idf1": 100 * _ratio(total["identified"], total["identities"])}
    figures |= {name: sum(case[name] for case in all_of) for name in ("nobody", "missed")}
    figures["unseen_share"] = 100 * _ratio(
        sum(case["unseen_mm"][1] for case in all_of), sum(case["error_mm"][1] for case in all_of)
    )
    return figures | {"ms": _ratio(sum(case.get("cpu_ms", np.nan) for case in all_of), total["frames"])}


def _sum(errors: NDArray[np.float64]) -> list[float]:
    """Sum of the lengths of errors (..., 3), millimetres, and how many there are; those that are NaN are not."""
    length = np.linalg.norm(errors, axis=-1)
    return [1e3 * float(np.nansum(length)), int(np.isfinite(length).sum())]


def _inside(nees: NDArray[np.float64], share: float) -> list[float]:
    """How many lie inside, and of how many."""
    return [float(np.nan_to_num(share) * len(nees)), len(nees)]


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else float("nan")
