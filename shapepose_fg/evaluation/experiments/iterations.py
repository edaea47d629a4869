"""Precision, F1 and error against the number of alternations."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch, shorter
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people

FRAMES = 30
"""Of each stretch."""
COUNTS = (0, 1, 2, 3, 5, 10, 15)
"""Alternations; 0 are the proposals of stage I."""
CONFIGS = {"ours": replace(PipelineConfig(), temporal=False), "the paper's preset": PipelineConfig.paper()}
PAPER = {0: 83.7, 10: 90.1}
"""Precision in % of initial and final poses on the Association Dataset: it converges after about 10."""


def iterations(scale: Scale, images: Path | None = None) -> Experiment | None:
    """Every frame by itself, ours and the paper's preset, each for exactly so many rounds.

    Drawn into the folder `images`, if given.
    """
    if not scale.has_scenes:
        return None
    stretches = [shorter(stretch, FRAMES) for stretch in scale.one_each]
    counts = COUNTS[:3] if scale.quick else COUNTS
    cases = [
        Case(_case_name(name, count, stretch), partial(_measure, stretch, config, count))
        for stretch in stretches
        for name, config in CONFIGS.items()
        for count in counts
    ]

    def table(figures: Mapping[str, Figures]) -> list[str]:
        if images is not None:
            draw_iterations(figures, images / "iterations.png")
        head = " | ".join(f"{name}: precision | F1 | MPJPE, mm" for name in CONFIGS)
        rows = [
            f"| alternations | {head} | the paper, its data: precision |",
            rule(2 + 3 * len(CONFIGS)),
        ]
        for count in counts:
            cells = [f"{value:.1f}" for name in CONFIGS for value in _mean(figures, name, count)]
            rows.append(f"| {count} | {' | '.join(cells)} | {PAPER.get(count, '')} |")
        return rows

    return Experiment("iterations", cases, table)


def draw_iterations(figures: Mapping[str, Figures], file: Path) -> None:
    """The picture that goes with the table."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 2.6), layout="constrained")
    counts = [count for count in COUNTS if any(f", {count} alternations," in name for name in figures)]
    for n, (axes, label) in enumerate(
        zip(figure.subplots(1, 3), ("precision, %", "F1, %", "MPJPE, mm"), strict=True)
    ):
        for name, style in zip(CONFIGS, ("D-", "s--"), strict=True):
            axes.plot(
                counts, [_mean(figures, name, count)[n] for count in counts], style, label=name, markersize=4
            )
        axes.set_ylabel(label)
        axes.set_xlabel("alternations")
        axes.grid(alpha=0.3)
    figure.axes[0].plot(list(PAPER), list(PAPER.values()), "k*", label="the paper, its data")
    figure.axes[0].legend(fontsize=7, loc=(0.28, 0.22))
    figure.savefig(file, dpi=130)


def _case_name(name: str, count: int, stretch: Stretch) -> str:
    return f"{name}, {count} alternations, {stretch.label}"


def _mean(figures: Mapping[str, Figures], name: str, count: int) -> tuple[float, float, float]:
    """Precision and F1 in %, and MPJPE in mm, over all stretches."""
    those = [each for case, each in figures.items() if case.startswith(f"{name}, {count} alternations,")]
    precision, f1, error = (
        float(np.mean([each[key] for each in those])) for key in ("precision", "f1", "mpjpe_mm")
    )
    return 100 * precision, 100 * f1, error


def _measure(stretch: Stretch, config: PipelineConfig, count: int) -> Figures:
    truth = stretch.scene.keypoints
    if count == 0:
        seen, rig = stretch.detections, stretch.scene.rig
        found = [find_people(seen[t], rig, seen.skeleton, config).initial for t in range(len(seen))]
        return joint_metrics(found, truth).as_dict()
    refine = replace(config.refine, alternations=count, settled_m=0.0)
    return joint_metrics(stretch.reconstruct(replace(config, refine=refine)), truth).as_dict()
