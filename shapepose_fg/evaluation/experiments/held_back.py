"""People over time whom nothing was learnt from, in sequences that were made when every setting had been chosen.

The dancers are the same takes as in the reported stretches, which nobody trains on; who stands and walks around
them is of test subjects only; places, bodies, cameras and the detector's errors are drawn anew.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.over_time import COLUMNS, cells, measure, with_mean
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import SEQUENCES
from shapepose_fg.simulation.training.split import split_of

SEED = 1001
"""Of the sequences, and of the detector."""
STRETCHES = {"salsa": range(0, 300), "crossing": range(108, 408), "crowd": range(0, 300)}
"""The first 300 frames without a cut of each."""
TOLD = ("F1", "recall", "IDF1", "MPJPE", "accel", "nobody", "missed", "wrist", "body", "50 %", "95 %", "ms")
"""Columns of the table of people over time."""
_MODES = {"with time": PipelineConfig(), "without time": replace(PipelineConfig(), temporal=False)}


def held_back(scale: Scale) -> Experiment | None:
    """Each stretch with time, and every frame by itself."""
    if scale.mocap is None or scale.quick:
        return None
    stretches = stretches_of(scale.mocap)
    cases = [
        Case(f"{stretch.label}, {name}", partial(measure, stretch, config))
        for name, config in _MODES.items()
        for stretch in stretches
    ]
    return Experiment("held back", cases, _table)


def stretches_of(mocap: Path) -> list[Stretch]:
    """The stretches, of the recorded motions in a file."""
    learnt_from = frozenset(subject for subject in Mocap.load(mocap).subjects if split_of(subject) != "test")
    return [
        Stretch(
            name,
            span,
            seed=SEED,
            made=replace(SEQUENCES[name], seed=SEED, without=learnt_from),
            mocap=mocap,
        )
        for name, span in STRETCHES.items()
    ]


def _table(found: Mapping[str, Figures]) -> list[str]:
    """A row for each stretch, and the mean of each mode."""
    columns, rows = [COLUMNS[name] for name in TOLD], []
    for mode in _MODES:
        those = {name: figures for name, figures in found.items() if name.endswith(f", {mode}")}
        for name, figures in with_mean(those).items():
            label = f"**mean, {mode}**" if name == "mean" else name
            rows.append(f"| {label} | {' | '.join(cells(figures, columns))} |")
    return [f"| | {' | '.join(TOLD)} |", rule(1 + len(TOLD)), *rows]
