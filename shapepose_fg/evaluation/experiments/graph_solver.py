"""The joints' step of the alternation: Levenberg-Marquardt in the graph, or Algorithm 1's gradient step."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.linearisation import observation_sigmas
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch, shorter
from shapepose_fg.evaluation.gradient_x_step import Alternated, GradientStep, GraphStep, alternate_with
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.matching import match_people
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people

FRAMES = 20
"""Of each stretch."""
STEPS_M2 = (1e-5, 3e-5, 1e-4, 3e-4, 1e-3)
"""Step sizes lambda. Too large ones diverge: lambda times the information of six sure views must stay under 2."""
ROUNDS, LONG_ROUNDS = 10, 100
"""N of Algorithm 1; and so many that small steps arrive."""
SOLVER = "Levenberg-Marquardt in the graph, N = 10"


def graph_solver(scale: Scale) -> Experiment | None:
    """The paper's preset from the same proposals; only how X is stepped differs."""
    if not scale.has_scenes:
        return None
    stretches = [shorter(stretch, FRAMES) for stretch in scale.one_each]
    cases = [Case(stretch.label, partial(_measure, stretch, quick=scale.quick)) for stretch in stretches]
    return Experiment("graph solver", cases, _table)


def _table(figures: Mapping[str, Figures]) -> list[str]:
    rows = [
        "| X step | MPJPE, mm | from the minimum, mm (mean; 99 %) | E over the minimum's | steps of X "
        "| X step, ms a frame | with bodies, ms |",
        rule(7),
    ]
    for name in next(iter(figures.values())):
        those = [each[name] for each in figures.values()]
        errors = np.array([each["error_mm"] for each in those], dtype=float)
        frames = sum(each["frames"] for each in those)
        if not np.isfinite(errors).all():
            rows.append(f"| {name} | diverges | - | - | {those[0]['steps']} | - | - |")
            continue
        mean, tail, energy = (
            np.mean([each[key] for each in those]) for key in ("apart_mm", "apart_99_mm", "energy_ratio")
        )
        ms = [1e3 * sum(each[key] for each in those) / frames for key in ("step_s", "body_s")]
        rows.append(
            f"| {name} | {errors.mean():.1f} | {mean:.1f}; {tail:.0f} | {energy:.2f} | {those[0]['steps']} "
            f"| {ms[0]:.1f} | {sum(ms):.1f} |"
        )
    return rows


def _measure(stretch: Stretch, *, quick: bool) -> Figures:
    """Every way of stepping, from the same proposals."""
    config, scene, detections = PipelineConfig.paper(), stretch.scene, stretch.detections
    found = [find_people(detections[t], scene.rig, detections.skeleton, config) for t in range(len(detections))]
    frame = np.repeat(np.arange(len(found)), [len(people) for people in found])
    rows, views = Observations.concatenate(found), Views.of(scene.rig)
    settings = EstimatorConfig(config.observations, config.window_graph, config.refine, config.motion)
    joints = detections.skeleton.joints
    sigmas = observation_sigmas(rows, rows.initial, views, config.observations, joints)
    matches = match_people(frame, rows.initial, scene.keypoints)
    truth = scene.keypoints[matches.frame, matches.person]
    ways: dict[str, tuple[Any, int]] = {SOLVER: (GraphStep(rows, sigmas, scene.rig, settings), ROUNDS)}
    for step_m2 in STEPS_M2[1:3] if quick else STEPS_M2:
        ways[f"one gradient step of {step_m2:.0e} m², N = {ROUNDS}"] = (GradientStep(step_m2), ROUNDS)
    for step_m2 in () if quick else STEPS_M2[:3]:
        ways[f"one gradient step of {step_m2:.0e} m², N = {LONG_ROUNDS}"] = (GradientStep(step_m2), LONG_ROUNDS)
    figures = {}
    fitter = make_fitter(config.body)
    with torch_threads(config.threads):
        best = alternate_with(rows, sigmas, views, fitter, settings, ways[SOLVER][0], ROUNDS)
        for name, (x_step, rounds) in ways.items():
            this = best if name == SOLVER else alternate_with(
                rows, sigmas, views, fitter, settings, x_step, rounds
            )  # fmt: skip
            figures[name] = _figures(this, best, truth, matches.row) | {"steps": rounds, "frames": len(found)}
    return figures


def _figures(this: Alternated, best: Alternated, truth: np.ndarray, rows: NDArray[np.intp]) -> Figures:
    """Against the truth of matched rows, and against the minimum: both in the last energy of `best`."""
    error = np.linalg.norm(this.joints[rows] - truth, axis=-1)
    apart = np.linalg.norm(this.joints - best.joints, axis=-1)
    known = np.isfinite(apart)
    energy = best.energy.value(this.joints) / best.energy.value(best.joints)
    values = {
        "error_mm": 1e3 * np.nanmean(error),
        "apart_mm": 1e3 * apart[known].mean(),
        "apart_99_mm": 1e3 * np.percentile(apart[known], 99),
        "energy_ratio": energy,
        "step_s": this.step_s,
        "body_s": this.body_s,
    }
    arrived = values["apart_mm"] < _DIVERGED_MM
    return {name: float(value) if arrived and np.isfinite(value) else None for name, value in values.items()}


_DIVERGED_MM = 1e3
"""A step that is too large throws joints out of the room."""
