"""SMPL-only beside ours, on the same people and the same 2D (the paper's comparison with multi-view SMPLify)."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.others import PlainPeople, mean_of, scored
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch, shorter
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.smpl_only import SamePeople
from shapepose_fg.pipeline.pipeline import PipelineConfig

FRAMES = 60
"""Of each stretch."""
ROWS = {
    "triangulated, before stage II": "-",
    "SMPL-only": "78.3 / 77.4 / 77.8, 100 steps",
    "**ours, after stage II**": "90.1 / 89.0 / 89.2, 14 steps",
}
"""The rows, and what the paper has for them: precision / recall / F1, per cent, and steps."""
_CONFIG = replace(PipelineConfig(), temporal=False)


def smpl_only(scale: Scale) -> Experiment | None:
    """One stretch of each sequence."""
    if not scale.has_scenes:
        return None
    stretches = [shorter(stretch, FRAMES) for stretch in scale.one_each]
    return Experiment("smpl only", [Case(each.label, partial(_measure, each)) for each in stretches], _table)


def _measure(stretch: Stretch) -> Figures:
    """Who is there, and from which detections, is the same in all rows: that of ours without time."""
    scene = stretch.scene
    same = SamePeople.of(stretch.reconstruct(_CONFIG), scene.rig, _CONFIG)
    bodies, spent = same.smpl_only(scene.rig)
    ours = same.stage_two(scene.rig, _CONFIG)
    frame, rows = same.observations.frame, max(len(same.observations), 1)
    found = {
        "triangulated, before stage II": (same.triangulated, None, None),
        "SMPL-only": (bodies.joints, spent, bodies.iterations),
        "**ours, after stage II**": (ours.estimates.joints, ours.cpu_s, ours.body_steps),
    }
    return {
        name: scored(PlainPeople(frame, joints), scene.keypoints)["all"]
        | {"cpu_ms": None if cpu_s is None else 1e3 * cpu_s / rows}
        | {"steps": None if steps is None or not np.isfinite(steps) else float(steps)}
        for name, (joints, cpu_s, steps) in found.items()
    }


def _table(found: Mapping[str, Figures]) -> list[str]:
    head = (
        "| mean over stretches | precision, % | recall, % | F1, % | F1 at 0.1 m, % | MPJPE, mm | ms a person |"
        " steps of the body | the paper |"
    )
    rows = []
    for name, paper in ROWS.items():
        mean = mean_of([each[name] for each in found.values()])
        at = mean["at"]
        figures = [(at["0.2"][which], 1) for which in ("precision", "recall", "f1")]
        figures += [(at["0.1"]["f1"], 1), (mean["mpjpe_mm"], 1), (mean["cpu_ms"], 1), (mean["steps"], 1)]
        cells = ["-" if value is None else f"{value:.{decimals}f}" for value, decimals in figures]
        rows.append(f"| {name} | {' | '.join(cells)} | {paper} |")
    return [head, rule(9), *rows]
