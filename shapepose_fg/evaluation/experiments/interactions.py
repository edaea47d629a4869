"""People in close contact: what each method makes of the same detections, scored alike.

The paper's table of the Association Dataset.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from shapepose_fg.evaluation.alternation import before_refinement
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.others import (
    OTHERS,
    THRESHOLDS_M,
    PlainPeople,
    folder_name,
    mean_of,
    read_others,
    scored,
)
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch, shorter
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.opponent.opponent import find_everybody
from shapepose_fg.evaluation.opponent.over_time import over_time
from shapepose_fg.evaluation.smpl_only import SamePeople
from shapepose_fg.evaluation.stage_two import solve_alone
from shapepose_fg.evaluation.true_candidates import true_observations
from shapepose_fg.pipeline.pipeline import PipelineConfig, estimate_offsets

ROWS = {
    **dict.fromkeys(OTHERS),
    "opponent, frame by frame": (71.0, 80.2, 75.3),
    "opponent, over time": None,
    "paper's settings": (90.1, 89.0, 89.2),
    "initial proposals": (83.7, 82.8, 83.4),
    "SMPL-only": (78.3, 77.4, 77.8),
    "**frame by frame**": None,
    "**over time**": None,
    "true candidates, frame by frame": None,
}
"""The methods, and precision, recall and F1 at 0.2 m that the paper has for them on its own recording; for the
opponent, those of Dong et al. 2019."""
FRAMES = 100
"""Of each stretch."""
_FRAME_BY_FRAME = replace(PipelineConfig(), temporal=False)


def interactions(scale: Scale, others: Path | None = None) -> Experiment | None:
    """All methods on all stretches; results of other systems are read from `others`."""
    if not scale.has_scenes:
        return None
    cases = []
    for stretch in contacts(scale):
        made: dict[str, Callable[[], Figures]] = {name: partial(make, stretch) for name, make in _MEASURES.items()}
        if others is not None and (others / folder_name(stretch)).is_dir():
            made["others"] = partial(_others, stretch, others)
        cases += [Case(f"{stretch.label} {name}", measure) for name, measure in made.items()]
    return Experiment("interactions", cases, _table)


def contacts(scale: Scale) -> list[Stretch]:
    """The frames that all methods are given."""
    return [shorter(stretch, FRAMES) for stretch in scale.stretches]


def _stage_one(stretch: Stretch) -> Figures:
    """The initial proposals: stage I of every frame, triangulated."""
    began = time.process_time()
    before = before_refinement(stretch.detections, stretch.scene.rig, _FRAME_BY_FRAME)
    return {"initial proposals": _with_time(scored(before, stretch.scene.keypoints), began, stretch)}


def _alone(stretch: Stretch) -> Figures:
    """Ours frame by frame, and SMPL-only on the same people and detections."""
    rig, truth, _ = stretch.scene.rig, stretch.scene.keypoints, stretch.detections
    began = time.process_time()
    people = stretch.reconstruct(_FRAME_BY_FRAME)
    ours = _with_time(scored(people, truth), began, stretch)
    bodies, _ = SamePeople.of(people, rig, _FRAME_BY_FRAME).smpl_only(rig)
    return {"**frame by frame**": ours, "SMPL-only": scored(bodies, truth) | {"cpu_ms": None}}


def _over_time(stretch: Stretch) -> Figures:
    _ = stretch.detections
    began = time.process_time()
    people = stretch.reconstruct(PipelineConfig())
    return {"**over time**": _with_time(scored(people, stretch.scene.keypoints), began, stretch)}


def _paper(stretch: Stretch) -> Figures:
    """The method as the paper has it."""
    _ = stretch.detections
    began = time.process_time()
    people = stretch.reconstruct(PipelineConfig.paper())
    return {"paper's settings": _with_time(scored(people, stretch.scene.keypoints), began, stretch)}


def _ceiling(stretch: Stretch) -> Figures:
    """The truth's own choice of detections, solved by our stage II without time."""
    scene, detections = stretch.scene, stretch.detections
    rows = true_observations(detections, scene.rig, scene.keypoints, range(len(scene)))
    offsets = estimate_offsets(detections, scene.rig, _FRAME_BY_FRAME)
    solved = solve_alone(rows, scene.rig, _FRAME_BY_FRAME, offsets)
    people = PlainPeople(rows.frame, solved.estimates.joints)
    return {"true candidates, frame by frame": scored(people, scene.keypoints) | {"cpu_ms": None}}


def _opponent(stretch: Stretch) -> Figures:
    scene, detections = stretch.scene, stretch.detections
    began = time.process_time()
    people = find_everybody(detections, scene.rig)
    alone = _with_time(scored(people, scene.keypoints), began, stretch)
    followed = scored(over_time(people, scene.fps), scene.keypoints)
    return {"opponent, frame by frame": alone, "opponent, over time": followed | {"cpu_ms": alone["cpu_ms"]}}


def _others(stretch: Stretch, others: Path) -> Figures:
    found = read_others(others, folder_name(stretch))
    return {name: scored(people, stretch.scene.keypoints) | {"cpu_ms": None} for name, people in found.items()}


_MEASURES: dict[str, Callable[[Stretch], Figures]] = {
    "initial proposals": _stage_one,
    "opponent": _opponent,
    "frame by frame, SMPL-only": _alone,
    "over time": _over_time,
    "paper's settings": _paper,
    "true candidates": _ceiling,
}
"""What a case is called, and what it measures."""


def _with_time(figures: Figures, began: float, stretch: Stretch) -> Figures:
    return figures | {"cpu_ms": 1e3 * (time.process_time() - began) / len(stretch.span)}


def _table(found: Mapping[str, Figures]) -> list[str]:
    """The mean over the stretches, of the joints that all have, and of all joints at 0.2 m."""
    columns = " | ".join(f"P | R | F1 at {limit:g} m" for limit in THRESHOLDS_M)
    head = (
        f"| mean over stretches, % | {columns} | MPJPE, mm | least F1 | F1, 25 joints | missed | nobody | ms |"
        " the paper: P | R | F1 |"
    )
    measured = {name: [each[name] for each in found.values() if name in each] for name in ROWS}
    stretches, rows = max(map(len, measured.values())), []
    for name, parts in measured.items():
        if len(parts) == 0:
            continue
        mean, paper = mean_of(parts), ROWS[name]
        few = f" ({len(parts)} stretches)" if len(parts) < stretches else ""
        shares = [mean["common"]["at"][f"{t:g}"][f] for t in THRESHOLDS_M for f in ("precision", "recall", "f1")]
        cells = [*(_cell(share, 1) for share in shares), _cell(mean["common"]["mpjpe_mm"], 1)]
        cells += [_cell(min(each["common"]["at"]["0.2"]["f1"] for each in parts), 1)]
        cells += [_cell(mean["all"]["at"]["0.2"]["f1"], 1), _cell(mean["common"]["missed"], 0)]
        cells += [_cell(mean["common"]["nobody"], 0), _cell(mean["cpu_ms"], 0)]
        cells += ["-"] * 3 if paper is None else [f"{value:.1f}" for value in paper]
        rows.append(f"| {name}{few} | {' | '.join(cells)} |")
    return [head, rule(19), *rows]


def _cell(value: float | None, decimals: int) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.{decimals}f}"
