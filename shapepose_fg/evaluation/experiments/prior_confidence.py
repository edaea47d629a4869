"""Joint errors before and after the body's prior against the joint's confidence, a figure of the paper."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.estimator import Estimator
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch, shorter
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.matching import match_people
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people, reconstruct
from shapepose_fg.simulation import DetectorConfig, Scene, simulate
from shapepose_fg.simulation.foreign import DETECTOR_S_OWN, people_of, recast

FRAMES = 60
"""Of each stretch."""
BINS = (0.0, 0.1, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0)
"""Borders of w_i, the mean confidence of a joint over all views."""
PAPER_CROSSES = 0.25
"""From where on the body makes joints no better in the paper's figure: its rho_3D."""
CURVES = {"paper": ("X_0", "body fitted to it"), "ours": ("views alone", "views and body")}
"""Of each setting what is before the prior, and after it."""
SETTINGS = {"paper": "the paper's setting", "ours": "ours"}
WORLDS = {"own": "as the body model has them", "foreign": "other bones, other joints"}
"""Who is there, and what the detector means: in the second bones are up to 5 % off the model's, left and right
apart, and hips, shoulders, neck and others lie 18 to 46 mm from the model's."""

Curve = dict[str, list[list[float]]]
"""Of each figure the sum of errors in millimetres and how many, bin by bin."""


def prior_confidence(scale: Scale, images: Path | None = None) -> Experiment | None:
    """By the paper's setting: X_0, and the body fitted to it. By ours: the views, and fused with the body.

    Drawn into the folder `images`, if given.
    """
    if not scale.has_scenes:
        return None
    stretches = [shorter(stretch, FRAMES) for stretch in scale.one_each]
    cases = [
        Case(f"{setting}, {world}, {stretch.label}", partial(_measure, stretch, setting, world))
        for stretch in stretches
        for world in WORLDS
        for setting in CURVES
    ]

    def table(figures: Mapping[str, Figures]) -> list[str]:
        if images is not None:
            draw_prior_confidence(figures, images / "prior_confidence.png")
        return _table(figures)

    return Experiment("prior confidence", cases, table)


def curves(figures: Mapping[str, Figures]) -> dict[tuple[str, str], dict[str, NDArray[np.float64]]]:
    """Mean error (bins,) in millimetres before and after, by world and setting; NaN where there is no joint."""
    found = {}
    for world in WORLDS:
        for setting, names in CURVES.items():
            those = [each for name, each in figures.items() if name.startswith(f"{setting}, {world},")]
            sums = {name: np.sum([each[name] for each in those], axis=0) for name in names}
            found[world, setting] = {
                name: np.where(total[:, 1] > 0, total[:, 0] / np.maximum(total[:, 1], 1), np.nan)
                for name, total in sums.items()
            }
    return found


def crosses(before: NDArray[np.float64], after: NDArray[np.float64]) -> float | None:
    """The confidence from which on `after` (bins,) is no better than `before` (bins,); None: it always is.

    Between the middles of two bins in a straight line; 0 where the body never helps.
    """
    known = np.isfinite(before) & np.isfinite(after)
    middle, gain = np.array([(a + b) / 2 for a, b in pairwise(BINS)])[known], (before - after)[known]
    worse = np.flatnonzero(gain <= 0)
    if len(worse) == 0:
        return None
    first = int(worse[0])
    if first == 0:
        return 0.0
    share = gain[first - 1] / (gain[first - 1] - gain[first])
    return float(middle[first - 1] + share * (middle[first] - middle[first - 1]))


def draw_prior_confidence(figures: Mapping[str, Figures], file: Path) -> None:
    """The picture that goes with the table, in the manner of the paper's."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter, ScalarFormatter

    middle = [(a + b) / 2 for a, b in pairwise(BINS)]
    figure = Figure(figsize=(7.2, 3.8), layout="constrained")
    axes = dict(zip(CURVES, figure.subplots(1, 2, sharey=True), strict=True))
    for (world, setting), found in curves(figures).items():
        colour = "C0" if world == "own" else "C1"
        for (name, errors), style in zip(found.items(), ("o:", "D-"), strict=True):
            label = f"{name}; {WORLDS[world]}"
            axes[setting].plot(middle, errors, style, color=colour, label=label, markersize=4)
    axes["paper"].axvline(PAPER_CROSSES, color="0.5", linewidth=0.8, label="where the paper's curves cross")
    for setting, each in axes.items():
        each.set_title(SETTINGS[setting], fontsize=9)
        each.set_xlabel("mean confidence of a joint over all views", fontsize=9)
        each.set_yscale("log")
        each.set_yticks([10, 20, 50, 100, 200, 500])
        each.yaxis.set_major_formatter(ScalarFormatter())
        each.yaxis.set_minor_formatter(NullFormatter())
        each.grid(alpha=0.3)
        each.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.18), frameon=False)
    axes["paper"].set_ylabel("mean error, mm", fontsize=9)
    figure.savefig(file, dpi=130)


def _table(figures: Mapping[str, Figures]) -> list[str]:
    found = curves(figures)
    columns = [errors for pair in found.values() for errors in pair.values()]
    names = [
        f"{WORLDS[world]}, {SETTINGS[setting]}: {name}" if n == 0 else name
        for (world, setting), pair in found.items()
        for n, name in enumerate(pair)
    ]
    rows = [f"| confidence | {' | '.join(names)} |", rule(1 + len(names))]
    for n, (low, high) in enumerate(pairwise(BINS)):
        cells = " | ".join(f"{each[n]:.0f}" if np.isfinite(each[n]) else "-" for each in columns)
        rows.append(f"| {low:g} to {high:g} | {cells} |")
    cells = " | ".join(f" | {_words(crosses(*pair.values()))}" for pair in found.values())
    return [*rows, f"| no better from here on (the paper: {PAPER_CROSSES}) | {cells} |"]


def _words(confidence: float | None) -> str:
    return "always better" if confidence is None else f"{confidence:.2f}"


@dataclass(frozen=True)
class _Rows:
    """N rows with a confidence for each joint."""

    frame: NDArray[np.intp]
    confidence: NDArray[np.float64]
    """(N, J)"""
    joints: NDArray[np.float64]
    """(N, J, 3) by which people are matched with the truth."""

    def by_confidence(self, figures: Mapping[str, NDArray[np.float64]], truth: NDArray[np.float64]) -> Curve:
        """Errors of joints (N, J, 3) that every figure has, of matched people."""
        matches = match_people(self.frame, self.joints, truth)
        true = truth[matches.frame, matches.person]
        error = {name: np.linalg.norm(xyz[matches.row] - true, axis=-1) for name, xyz in figures.items()}
        known = np.isfinite(np.sum(list(error.values()), axis=0))
        place = np.digitize(self.confidence[matches.row], BINS[1:-1])
        return {
            name: [
                [1e3 * float(e[known & (place == n)].sum()), int((known & (place == n)).sum())] for n in _PLACES
            ]
            for name, e in error.items()
        }


_PLACES = range(len(BINS) - 1)


def _measure(stretch: Stretch, setting: str, world: str) -> Figures:
    scene, detections, truth = _foreign(stretch) if world == "foreign" else (
        stretch.scene, stretch.detections, stretch.scene.keypoints
    )  # fmt: skip
    return dict((_of_paper if setting == "paper" else _of_ours)(scene, detections, truth))


@lru_cache(maxsize=1)
def _foreign(stretch: Stretch) -> tuple[Scene, DetectionSequence, NDArray[np.float64]]:
    """The same motions by people with bones of their own, before a detector with joints of its own."""
    scene = recast(stretch.scene, people_of("own bones", stretch.scene.people, stretch.seed))
    seen = simulate(scene, DetectorConfig(offsets=DETECTOR_S_OWN), stretch.seed)
    return scene, seen, scene.with_keypoint_offsets(DETECTOR_S_OWN).keypoints


def _of_paper(scene: Scene, detections: DetectionSequence, truth: NDArray[np.float64]) -> Curve:
    """Stage I's proposals, and the body fitted to them, all joints alike."""
    config = PipelineConfig.paper()
    found = [find_people(detections[t], scene.rig, detections.skeleton, config) for t in range(len(detections))]
    frame = np.repeat(np.arange(len(found)), [len(people) for people in found])
    rows = Observations.concatenate(found)
    rows = replace(rows, track=np.arange(len(rows)), frame=frame)
    refine = replace(config.refine, alternations=1)
    settings = EstimatorConfig(config.observations, config.window_graph, refine, config.motion)
    with torch_threads(config.threads):
        estimator = Estimator(scene.rig, make_fitter(config.body), detections.skeleton.joints, settings)
        bodies = estimator.estimate(rows).fit.joints
    before, after = CURVES["paper"]
    people = _Rows(frame, rows.confidence.mean(axis=-1), rows.initial)
    return people.by_confidence({before: rows.initial, after: bodies}, truth)


def _of_ours(scene: Scene, detections: DetectionSequence, truth: NDArray[np.float64]) -> Curve:
    """Frame by frame: what the views say, with the body only where they leave a joint open; and both fused."""
    ours = replace(PipelineConfig(), temporal=False)
    alone = replace(ours, window_graph=replace(ours.window_graph, rho_3d=0.0))
    views, fused = (reconstruct(detections, scene.rig, config) for config in (alone, ours))
    if not np.array_equal(views.frame, fused.frame):
        raise RuntimeError("the body's prior changed who is there: rows cannot be compared")
    seen = views.observations
    assert seen is not None
    before, after = CURVES["ours"]
    people = _Rows(views.frame.astype(np.intp), seen.confidence.mean(axis=-1), fused.joints)
    return people.by_confidence({before: views.joints, after: fused.joints}, truth)
