"""Covariances with a factor of one's own: a box whose width is known, carried in both hands."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import isotropic
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.metrics import covariance_calibration
from shapepose_fg.pipeline.pipeline import PipelineConfig

SIGMA_M = 0.01
"""How well a width is known: what is given is off by so much, drawn anew in every frame."""
SEEDS = range(3000, 3016)
"""Scenes of one person each, so that everybody's box is known by the frame. Many of them: errors last, so a scene
is hardly more than one draw for each wrist."""
WRISTS = (BODY_25.index("RWrist"), BODY_25.index("LWrist"))
CAMERAS = (3, 6)


@dataclass(frozen=True)
class Box:
    """The width of the box in each frame, as a factor between the wrists."""

    width_m: NDArray[np.float64]
    """(T,) metres, with its error."""

    def __call__(self, window, keys):
        """The wrists are the width apart in every frame, to within `SIGMA_M`."""
        for frame, (right, left) in zip(window.frames.tolist(), keys[:, WRISTS].tolist(), strict=True):
            yield gtsam.RangeFactor3(right, left, float(self.width_m[frame]), isotropic(1, SIGMA_M))


def experiment(scale: Scale) -> Experiment:
    """Wrists with the box and without, with time and without, before three cameras and six."""
    frames = range(4 if scale.quick else 60)
    cases = []
    for count in CAMERAS:
        stretches = [Stretch("demo", frames, cameras=count, seed=seed, people=1) for seed in SEEDS]
        for temporal in (True, False):
            name = f"{count} cameras, {'with' if temporal else 'without'} time"
            cases.append(Case(name, partial(_measure, stretches[: 2 if scale.quick else None], temporal)))
    return Experiment("box", cases, _table)


def _measure(stretches: list[Stretch], temporal: bool) -> Figures:
    config = replace(PipelineConfig(), temporal=temporal)
    found: dict[str, list[tuple[NDArray, NDArray]]] = {"without": [], "with": []}
    for stretch in stretches:
        truth = stretch.scene.keypoints[:, 0, WRISTS]
        error = SIGMA_M * np.random.default_rng(stretch.seed).standard_normal(len(truth))
        box = Box(np.linalg.norm(truth[:, 0] - truth[:, 1], axis=1) + error)
        found["without"].append(_errors(stretch.reconstruct(config), truth))
        found["with"].append(_errors(stretch.reconstruct(config, extra_factors=box), truth))
    return {name: _figures(parts) for name, parts in found.items()}


def _errors(people: Reconstruction, truth: NDArray) -> tuple[NDArray, NDArray]:
    """Errors (M, 3) of both wrists in all rows, and their covariances (M, 3, 3)."""
    error = people.joints[:, WRISTS] - truth[people.frame]
    return error.reshape(-1, 3), people.covariance[:, WRISTS].reshape(-1, 3, 3)


def _figures(parts: list[tuple[NDArray, NDArray]]) -> Figures:
    error = np.concatenate([error for error, _ in parts])
    covariance = np.concatenate([covariance for _, covariance in parts])
    known = np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    calibration = covariance_calibration(error[known], covariance[known])
    of_scenes = [covariance_calibration(*each).coverage[0.95] for each in parts]
    return {
        "wrists": int(known.sum()),
        "mean_mm": float(1e3 * np.linalg.norm(error[known], axis=1).mean()),
        "inside_95_sigma": float(100 * np.std(of_scenes, ddof=1) / np.sqrt(len(of_scenes))),
        **{f"inside_{100 * level:.0f}": 100 * share for level, share in calibration.coverage.items()},
    }


def _table(found: Mapping[str, Figures]) -> list[str]:
    rows = []
    for name, each in found.items():
        cells = [str(each["without"]["wrists"])]
        for how in ("without", "with"):
            f = each[how]
            inside = f"{f['inside_50']:.1f} / {f['inside_95']:.1f} ± {f['inside_95_sigma']:.1f}"
            cells.append(f"{f['mean_mm']:.1f} | {inside}")
        rows.append(f"| {name} | {' | '.join(cells)} |")
    head = "| wrists | count | error, mm | inside 50 / 95 %, % | with the box: error | inside 50 / 95 %, % |"
    return [head, rule(6), *rows]
