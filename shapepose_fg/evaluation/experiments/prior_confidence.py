"""Joint errors before and after the body's prior against the joint's confidence: the paper's figure 5."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.estimation.estimator import Estimator
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.evaluation.bodies import body_joints
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch, shorter
from shapepose_fg.evaluation.matching import match_people
from shapepose_fg.observations import Observations
from shapepose_fg.pipeline import PipelineConfig, find_people

FRAMES = 100
"""Of each stretch."""
BINS = (0.0, 0.1, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0)
"""Borders of w_i, the mean confidence of a joint over all views."""
PAPER_CROSSES = 0.25
"""From where on the body makes joints no better in the paper's figure 5: its rho_3D."""
CURVES = {
    "paper": ("the paper's setting: X_0", "the body fitted to it"),
    "ours": ("ours: views alone", "the body", "views and body fused"),
}
"""Figures of each setting, the first before the prior."""

Curve = dict[str, list[list[float]]]
"""Of each figure the sum of errors in millimetres and how many, bin by bin."""


def prior_confidence(scale: Scale) -> Experiment | None:
    """By the paper's setting: X_0 and the body fitted to it. By ours: the views, the body, and both fused."""
    if not scale.has_scenes:
        return None
    stretches = [shorter(stretch, FRAMES) for stretch in scale.one_each]
    cases = [
        Case(f"{name}, {stretch.label}", partial(measure, stretch))
        for stretch in stretches
        for name, measure in (("paper", _of_paper), ("ours", _of_ours))
    ]
    return Experiment("prior confidence", cases, _table)


def curves(figures: Mapping[str, Figures]) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Mean error (bins,) in millimetres of each figure of each setting; NaN where there is no joint."""
    found = {}
    for setting, names in CURVES.items():
        those = [each for name, each in figures.items() if name.startswith(f"{setting},")]
        sums = {name: np.sum([each[name] for each in those], axis=0) for name in names}
        found[setting] = {
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
    """The picture that goes with the table, in the manner of the paper's figure 5."""
    from matplotlib.figure import Figure

    middle = [(a + b) / 2 for a, b in pairwise(BINS)]
    figure = Figure(figsize=(7.2, 2.9), layout="constrained")
    for axes, (setting, found) in zip(figure.subplots(1, 2), curves(figures).items(), strict=True):
        for (name, errors), style in zip(found.items(), ("o:", "s--", "D-"), strict=False):
            axes.plot(middle, errors, style, label=name, markersize=4)
        axes.set_yscale("log")
        axes.set_xlabel("mean confidence of the joint over all views")
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
        if setting == "paper":
            axes.axvline(PAPER_CROSSES, color="0.5", linewidth=0.8)
            axes.set_ylabel("mean error, mm")
    figure.savefig(file, dpi=130)


def _table(figures: Mapping[str, Figures]) -> list[str]:
    found = curves(figures)
    columns = [errors for of_setting in found.values() for errors in of_setting.values()]
    names = [name for of_setting in found.values() for name in of_setting]
    rows = [f"| confidence, mean error in mm | {' | '.join(names)} |", "|---" * (1 + len(names)) + "|"]
    for n, (low, high) in enumerate(pairwise(BINS)):
        cells = " | ".join(f"{each[n]:.0f}" if np.isfinite(each[n]) else "-" for each in columns)
        rows.append(f"| {low:g} to {high:g} | {cells} |")
    cells = []
    for of_setting in found.values():
        first, *rest = of_setting.values()
        cells += ["", *(_words(crosses(first, after)) for after in rest)]
    return [*rows, f"| no better from here on (the paper: {PAPER_CROSSES}) | {' | '.join(cells)} |"]


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


def _of_paper(stretch: Stretch) -> Figures:
    """Stage I's proposals, and the body fitted to them, all joints alike."""
    config, scene = PipelineConfig.paper(), stretch.scene
    detections = stretch.detections
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
    return dict(people.by_confidence({before: rows.initial, after: bodies}, scene.keypoints))


def _of_ours(stretch: Stretch) -> Figures:
    """Frame by frame: what the views say, with the body only where they leave a joint open; and fused."""
    ours = replace(PipelineConfig(), temporal=False)
    alone = replace(ours, window_graph=replace(ours.window_graph, rho_3d=0.0))
    views, fused = (stretch.reconstruct(config) for config in (alone, ours))
    if not np.array_equal(views.frame, fused.frame):
        raise RuntimeError("the body's prior changed who is there: rows cannot be compared")
    seen = views.observations
    assert seen is not None
    confidence = seen.confidence.mean(axis=-1)
    first, body, both = CURVES["ours"]
    figures = {first: views.joints, body: body_joints(fused), both: fused.joints}
    people = _Rows(views.frame.astype(np.intp), confidence, fused.joints)
    return dict(people.by_confidence(figures, stretch.scene.keypoints))
