"""What is won by learning where a detector puts its joints: python scripts/detector_skeleton.py [--data FOLDER].

Prints the two tables of docs/evaluation.md about it as Markdown. Simulated scenes are seen by a detector with a
known skeleton of its own. Shelf (`--data`, or SHAPEPOSE_DATA) is cut in two: offsets are learnt from one half and
judged on the other, by where the body puts a joint without that joint's own views against where the views put it.
The annotation is not opened. Takes about two minutes.
"""

import argparse
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.offsets.estimation import learn_offsets
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.camera import Rig
from shapepose_fg.detections import DetectionSequence
from shapepose_fg.estimation.detector_offsets import confident_targets, spread_frames
from shapepose_fg.evaluation.footage import shelf_footage
from shapepose_fg.evaluation.matching import match_people
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.observations import Observations
from shapepose_fg.pipeline import PipelineConfig, find_people, reconstruct
from shapepose_fg.simulation import DetectorConfig, built_in_scene, simulate
from shapepose_fg.simulation.foreign import DETECTOR_S_OWN

SEEDS = (2000, 2001, 2002)
CONFIG = replace(PipelineConfig(), temporal=False)
DOUBTFUL = 0.25
"""A joint whose mean confidence over all views is less is doubtful (the paper's rho_3D)."""
WITHOUT = replace(CONFIG, offsets=replace(CONFIG.offsets, source="none"))


def simulated() -> list[str]:
    """Errors against the keypoints that the detector means, offsets learnt or not."""
    rows = [
        "| detector | offsets | F1, % | MPJPE, mm | doubtful joints: mean (median), mm |",
        "|---|---|---|---|---|",
    ]
    for name, offsets in (("has the body's joints", None), ("has its own", DETECTOR_S_OWN)):
        for label, config in (("none", WITHOUT), ("learnt", CONFIG)):
            f1, mpjpe, doubtful = zip(*(_scene(seed, offsets, config) for seed in SEEDS), strict=True)
            error = np.concatenate(doubtful)
            rows.append(
                f"| {name} | {label} | {100 * np.mean(f1):.2f} | {np.mean(mpjpe):.1f} | "
                f"{1e3 * error.mean():.1f} ({1e3 * np.median(error):.1f}) |"
            )
    return rows


def _scene(
    seed: int, offsets: KeypointOffsets | None, config: PipelineConfig
) -> tuple[float, float, NDArray[np.float64]]:
    """F1, MPJPE in mm, and the errors in m of doubtful joints."""
    scene = built_in_scene(seed)
    recording = simulate(scene, DetectorConfig(offsets=offsets), seed)
    meant = scene if offsets is None else scene.with_keypoint_offsets(offsets)
    people = reconstruct(recording, scene.rig, config)
    metrics = joint_metrics(people, meant.keypoints)
    matches = match_people(people.frame, people.joints, meant.keypoints)
    true = meant.keypoints[matches.frame, matches.person]
    error = np.linalg.norm(people.joints[matches.row] - true, axis=-1)
    doubtful = people.confidence[matches.row] < DOUBTFUL
    return metrics.f1, metrics.mpjpe_mm, error[doubtful & np.isfinite(error)]


def shelf(folder: Path) -> list[str]:
    """The distance between a joint's views and the body that is fitted to all other joints."""
    recording = shelf_footage(folder)
    rig, detections = recording.rig, recording.detections
    middle = len(detections) // 2
    halves = [_targets(detections, rig, first) for first in (0, middle)]
    rows = [
        "| Shelf | offsets | body without the joint's views: mean (median), mm | fitted body, mm |",
        "|---|---|---|---|",
    ]
    for name, learn, judge in (("second half", *halves), ("first half", *halves[::-1])):
        for label, offsets in (("none", None), ("learnt on the other", learn_offsets(learn, BodyModel.default()))):
            body = BodyModel.default() if offsets is None else BodyModel.default().with_keypoint_offsets(offsets)
            fit = LevenbergMarquardtFitter(body).fit(judge)
            seen = (np.abs(judge.information).max(axis=(2, 3)) > 0) & fit.ok[:, None]
            left_out = 1e3 * np.linalg.norm(fit.prior_xyz - judge.xyz, axis=-1)[seen]
            fitted = 1e3 * np.linalg.norm(fit.joints - judge.xyz, axis=-1)[seen]
            rows.append(
                f"| {name} | {label} | {left_out.mean():.1f} ({np.median(left_out):.1f}) | {fitted.mean():.1f} |"
            )
    return rows


def _targets(detections: DetectionSequence, rig: Rig, first: int) -> JointTargets:
    """Joints that three views see well in 60 frames of the half that begins with frame `first`, less 20 frames."""
    length = len(detections) // 2 - 20
    frames = [first + frame for frame in spread_frames(length, 60)]
    found = [find_people(detections[t], rig, detections.skeleton, CONFIG) for t in frames]
    return confident_targets(Observations.concatenate(found), rig, CONFIG.observations, CONFIG.offsets)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=os.environ.get("SHAPEPOSE_DATA"), help="folder with data/shelf/"
    )
    arguments = parser.parse_args()
    with torch_threads(1):
        print("\n".join(simulated()), flush=True)
        if arguments.data is not None:
            print("\n" + "\n".join(shelf(Path(arguments.data) / "data" / "shelf")))


if __name__ == "__main__":
    main()
