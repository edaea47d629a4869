"""Human proposals: one is right where its hip is within 0.2 m of a person's (Zhang et al. 2020, the paper)."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, DetectionSequence, Recording
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.experiments.experiment import Figures
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people, reconstruct
from shapepose_fg.simulation import Scene

Array = NDArray[np.float64]

CORRECT_M = 0.2
"""Metres from the hip to the true one."""
HIP = BODY_25.index("MidHip")
HIPS = (HIP, BODY_25.index("RHip"), BODY_25.index("LHip"))
_OWN_M = 0.25
"""A detection farther from where a hip truly is, as a length at its depth, is not of that hip."""


def hips_by_stage_one(
    detections: DetectionSequence, rig: Rig, config: PipelineConfig | None = None
) -> list[Array]:
    """(P_t, 3) for each frame: the hips of the first stage, alone."""
    config = PipelineConfig() if config is None else config
    return [
        find_people(detections[t], rig, detections.skeleton, config).initial[:, HIP]
        for t in range(len(detections))
    ]


def hips_of_people(detections: DetectionSequence, scene: Scene, *, temporal: bool) -> list[Array]:
    """(P_t, 3) for each frame: the hips of the people who are found in the end, by frames or over time."""
    config = replace(PipelineConfig(), temporal=temporal)
    people = reconstruct(detections, scene.rig, config, times=FrameTimes.from_fps(scene.fps, len(scene)))
    return [people.joints[people.frame == t, HIP] for t in range(len(scene))]


METHODS = {
    "stage I alone": lambda detections, scene: hips_by_stage_one(detections, scene.rig),
    "final, without time": lambda detections, scene: hips_of_people(detections, scene, temporal=False),
    "final, over time": lambda detections, scene: hips_of_people(detections, scene, temporal=True),
}
"""What proposes people, by what tables call it."""
BY_THE_PAPER = "stage I alone, the paper's settings"
"""The same by the paper's preset."""


def proposed_by_the_paper(detections: DetectionSequence, scene: Scene) -> list[Array]:
    """(P_t, 3) for each frame: the hips of the first stage as the paper has it."""
    return hips_by_stage_one(detections, scene.rig, PipelineConfig.paper())


def score_hips(found: list[Array], truth: Array) -> Figures:
    """How many proposals there are, people, and pairs of the two (one-to-one) within 0.2 m.

    `found` holds (P_t, 3) for each frame, metres, NaN for a proposal without a hip; `truth` is (T, P, 3).
    """
    right = 0
    for hips, true in zip(found, truth, strict=True):
        near = np.linalg.norm(hips[:, None] - true[None], axis=-1) <= CORRECT_M  # NaN compares false
        rows, columns = linear_sum_assignment(near, maximize=True)
        right += int(near[rows, columns].sum())
    return {"proposals": sum(len(hips) for hips in found), "people": int(np.prod(truth.shape[:2])), "right": right}


def precision_recall_f1(cases: Iterable[Figures]) -> tuple[float, float, float]:
    """In %, of all cases together."""
    all_of = list(cases)
    right, proposals, people = (sum(case[name] for case in all_of) for name in ("right", "proposals", "people"))
    return 100 * right / max(proposals, 1), 100 * right / people, 200 * right / max(proposals + people, 1)


@dataclass(frozen=True)
class SeenHips:
    """The hips that a detector saw, each the true one's in one view: at most so many views a person."""

    detections: Recording
    """What is left of the recording."""
    views: float
    """Mean count of views that see somebody's middle of the hips."""


def with_hips_in_views(detections: DetectionSequence, scene: Scene, most: int, seed: int = 0) -> SeenHips:
    """The same recording with everybody's hips (middle, left and right) seen by at most `most` views.

    A person's views are asked in an order that lasts for the whole recording: in each frame the first `most` that
    see one of the hips keep theirs.
    """
    order = np.random.default_rng([seed, 8]).permuted(
        np.tile(np.arange(len(scene.rig)), (scene.people, 1)), axis=1
    )
    frames, seen = [], 0
    for t in range(len(detections)):
        owner = _owners(detections[t], scene.rig, scene.truth_at(t))
        keep, count = _kept(detections[t], owner, order, most)
        frames.append(detections[t].only(keep))
        seen += count
    return SeenHips(Recording(detections.skeleton, frames), seen / max(len(frames) * scene.people, 1))


def _kept(
    detections: Detections, owner: NDArray[np.intp], order: NDArray[np.intp], most: int
) -> tuple[NDArray[np.bool_], int]:
    """Which detections (D,) stay, and how many views are left that see somebody's middle of the hips, in all."""
    keep = np.ones(len(detections), dtype=bool)
    for person, views in enumerate(order):
        own = owner == person
        sees = np.isin(views, detections.view[own])
        blind = views[sees][most:]
        keep &= ~(own & np.isin(detections.view, blind))
    middle = (owner >= 0) & keep & (detections.joint == HIP)
    return keep, int(middle.sum())


def _owners(detections: Detections, rig: Rig, truth: Array) -> NDArray[np.intp]:
    """(D,) whose hip a detection is, -1 for none; each person's hip in a view is one detection at most."""
    owner = np.full(len(detections), -1)
    xy, depth = rig.project(truth)
    for view in range(len(rig)):
        for joint in HIPS:
            those = np.flatnonzero((detections.view == view) & (detections.joint == joint))
            gap_px = np.linalg.norm(detections.xy[those, None] - xy[view, :, joint], axis=-1)
            gap_m = np.nan_to_num(gap_px * depth[view, :, joint] / rig.focal_px[view], nan=np.inf)
            place, person = linear_sum_assignment(np.minimum(gap_m, 2 * _OWN_M))
            near = gap_m[place, person] < _OWN_M
            owner[those[place[near]]] = person[near]
    return owner
