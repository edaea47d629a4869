"""What is won by learning where a detector puts its joints.

Simulated detectors have the body's joints, or joints of their own; one half of Shelf judges what the other taught.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.offsets.estimation import learn_offsets
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.detector_offsets import confident_targets, spread_frames
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import QUICK_FRAMES, Scale, Stretch, shorter
from shapepose_fg.evaluation.footage import Footage, shelf_footage
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.matching import match_people
from shapepose_fg.evaluation.metrics import metrics_of
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people, reconstruct
from shapepose_fg.simulation import DetectorConfig, simulate
from shapepose_fg.simulation.foreign import DETECTOR_S_OWN

SEEDS = (2000, 2001, 2002)
"""Of the built-in scene."""
FRAMES = 60
"""Of each scene, and of each half of Shelf."""
DOUBTFUL = 0.25
"""A joint whose mean confidence over all views is less is doubtful (the paper's rho_3D)."""
DETECTORS: dict[str, KeypointOffsets | None] = {
    "the body's joints": None,
    "joints of its own, 18 to 46 mm off": DETECTOR_S_OWN,
}
"""What a simulated detector's joints are."""
_MODES = {"over time": True, "frame by frame": False}
_SOURCES = {"without": "none", "learnt": PipelineConfig().offsets.source}
"""Offsets: what the table calls them, and the setting."""
_APART = 20
"""Frames at the end of a half of Shelf that are left out: the other half would begin with the same poses."""


def detector_joints(scale: Scale) -> Experiment:
    """Each scene before each detector."""
    scenes = _scenes(scale)
    cases = [
        Case(f"{group}, {stretch.label}, seed {stretch.seed}, {name}", partial(_measure, stretch, offsets))
        for group, stretches in scenes.items()
        for stretch in stretches
        for name, offsets in DETECTORS.items()
    ]
    return Experiment("detector joints", cases, partial(_table, tuple(scenes)))


def detector_joints_shelf(scale: Scale) -> Experiment | None:
    """What one half of Shelf teaches, judged on the other, without the annotation."""
    folder = scale.shelf
    if folder is None or scale.quick:
        return None
    return Experiment("shelf joints", [Case("halves", lambda: _halves(shelf_footage(folder)))], _halves_table)


def _scenes(scale: Scale) -> dict[str, list[Stretch]]:
    """The built-in scene, and the first frames of each sequence of recorded motions."""
    frames, seeds = (QUICK_FRAMES, SEEDS[:1]) if scale.quick else (FRAMES, SEEDS)
    scenes = {"built-in": [Stretch("demo", range(frames), seed=seed) for seed in seeds]}
    if scale.mocap is not None and not scale.quick:
        scenes["recorded motions"] = [shorter(stretch, frames) for stretch in scale.one_each]
    return scenes


def _measure(stretch: Stretch, offsets: KeypointOffsets | None) -> Figures:
    """Against the joints that the detector means, with time and without, without offsets and with them."""
    scene = stretch.scene
    detections = simulate(scene, DetectorConfig(offsets=offsets), stretch.seed)
    truth = (scene if offsets is None else scene.with_keypoint_offsets(offsets)).keypoints
    times, found = FrameTimes.from_fps(scene.fps, len(scene)), {}
    for mode, temporal in _MODES.items():
        for label, source in _SOURCES.items():
            default = replace(PipelineConfig(), temporal=temporal)
            config = replace(default, offsets=replace(default.offsets, source=source))
            people = reconstruct(detections, scene.rig, config, times=times)
            matches = match_people(people.frame, people.joints, truth)
            metrics = metrics_of(matches, people.joints, truth)
            error = np.linalg.norm(people.joints[matches.row] - truth[matches.frame, matches.person], axis=-1)
            doubtful = error[(people.confidence[matches.row] < DOUBTFUL) & np.isfinite(error)]
            found[f"{mode}, {label}"] = {
                "f1": 100 * metrics.f1,
                "mpjpe_mm": metrics.mpjpe_mm,
                "doubtful_mm": np.round(1e3 * doubtful, 2).tolist(),
            }
    return found


def _table(groups: tuple[str, ...], found: Mapping[str, Figures]) -> list[str]:
    """A row for each group of scenes, detector and mode; without offsets on the left."""
    columns = "F1, % | MPJPE, mm | doubtful joints: mean (median), mm"
    rows = [f"| the detector has | | without offsets: {columns} | learnt: {columns} |", rule(8)]
    for group in groups:
        for name in DETECTORS:
            those = [each for case, each in found.items() if case.startswith(group) and case.endswith(name)]
            for mode in _MODES:
                if len(those) > 0:
                    cells = " | ".join(_cells([each[f"{mode}, {label}"] for each in those]) for label in _SOURCES)
                    rows.append(f"| {name} | {group}, {mode} | {cells} |")
    return rows


def _cells(parts: list[dict[str, Any]]) -> str:
    """F1 and MPJPE in the mean over scenes; doubtful joints of all scenes together."""
    f1, mpjpe = (np.mean([each[name] for each in parts]) for name in ("f1", "mpjpe_mm"))
    error = np.concatenate([each["doubtful_mm"] for each in parts])
    doubtful = "-" if len(error) == 0 else f"{error.mean():.1f} ({np.median(error):.1f})"
    return f"{f1:.2f} | {mpjpe:.1f} | {doubtful}"


def _halves(shelf: Footage) -> Figures:
    """How far a joint's own views are from the body that is fitted to all other joints, millimetres."""
    middle = len(shelf.detections) // 2
    first, second = (_targets(shelf, start, middle) for start in (0, middle))
    found = {}
    for name, learn, judge in (("second half", first, second), ("first half", second, first)):
        with torch_threads(1):
            learnt = BodyModel.default().with_keypoint_offsets(learn_offsets(learn, BodyModel.default()))
            for label, body in (("without", BodyModel.default()), ("learnt", learnt)):
                fit = LevenbergMarquardtFitter(body).fit(judge)
                seen = (np.abs(judge.information).max(axis=(2, 3)) > 0) & fit.ok[:, None]
                found[f"{name}, {label}"] = _mean_and_median(fit.prior_xyz[seen] - judge.xyz[seen])
    return found


def _targets(shelf: Footage, start: int, length: int) -> JointTargets:
    """Joints that three views see well, in frames spread over the half that begins with frame `start`."""
    config = replace(PipelineConfig(), temporal=False)
    frames = [start + frame for frame in spread_frames(length - _APART, FRAMES)]
    detections = shelf.detections
    rows = [find_people(detections[t], shelf.rig, detections.skeleton, config) for t in frames]
    return confident_targets(Observations.concatenate(rows), shelf.rig, config.observations, config.offsets)


def _mean_and_median(errors: NDArray[np.float64]) -> list[float]:
    length = 1e3 * np.linalg.norm(errors, axis=-1)
    return [float(length.mean()), float(np.median(length))]


def _halves_table(found: Mapping[str, Figures]) -> list[str]:
    halves = found["halves"]
    rows = ["| Shelf, mean (median), mm | without offsets | learnt from the other half |", rule(3)]
    for name in ("first half", "second half"):
        cells = (
            f"{mean:.1f} ({median:.1f})" for mean, median in (halves[f"{name}, {label}"] for label in _SOURCES)
        )
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return rows
