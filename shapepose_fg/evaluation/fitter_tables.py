"""The comparison of body fitters as Markdown tables, and its figure."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter
from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.fitter_comparison import BATCH, LARGE_BATCH, Comparison, first, learned
from shapepose_fg.evaluation.fitting import (
    GROUPS,
    SETTINGS,
    FitErrors,
    fit_calibration,
    sigma_ratios,
)
from shapepose_fg.evaluation.fitting_methods import (
    PLAIN_STEPS,
    fits_per_second,
)
from shapepose_fg.evaluation.fitting_optimum import check_optimum
from shapepose_fg.evaluation.footage import shelf_footage
from shapepose_fg.evaluation.markdown import rule
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.evaluation.shelf import evaluate_shelf, read_shelf_ground_truth
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import simulate
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import SEQUENCES, sequence

STRIDE = 20
"""Every so-many-th frame of the simulated sequences is reconstructed."""
COLOURS = ("black", "#7570b3", "#1b9e77", "#d95f02", "#e7298a")
Table = Callable[[], list[str]]


def tables(motions: Path, shelf: Path | None, images: Path | None) -> dict[str, Table]:
    """The tables by name; `motions` is the recorded motions' file, the figure goes to the folder `images`."""
    all_ = Comparison(motions)
    return {
        "fitter": lambda: error_table(all_),
        "fitter groups": lambda: group_table(all_),
        "fitter time": lambda: time_table(all_, images),
        "fitter speed": lambda: speed_table(all_),
        "fitter optimum": lambda: optimum_lines(all_),
        "fitter covariances": lambda: covariance_table(all_),
        "fitter sigmas": lambda: sigma_table(all_),
        "fitter alternation": lambda: alternation_table(motions, shelf),
    }


def error_table(comparison: Comparison) -> list[str]:
    """Errors and times."""
    rows = []
    for setting, outcomes in comparison.outcomes.items():
        for name, found in outcomes.items():
            e = found.errors
            cells = " | ".join(map(_mm, (e.mean_mm, e.seen_mm, e.missing_mm, e.vertex_mm)))
            without = int((~e.fitted).sum())
            rows.append(
                f"| {setting.name} | {name} | {cells} | {_spread(found.ms_batch)} | {_spread(found.ms_alone)} "
                f"| {without} |"
            )
    head = (
        f"| targets | fitter | all joints, mm | seen | missing | vertices | ms a fit, {BATCH} at a time "
        "| ms alone | no body |"
    )
    return [head, rule(9), *rows]


def group_table(comparison: Comparison) -> list[str]:
    """Salsa and everything else."""
    salsa = comparison.drawn[1]
    rows = []
    for setting, outcomes in comparison.outcomes.items():
        for name, found in outcomes.items():
            cells = []
            for group in (salsa, ~salsa):
                e = FitErrors(found.errors.joints_mm[group], found.errors.missing[group], np.zeros(0))
                cells += [_mm(e.seen_mm), _mm(e.missing_mm)]
            rows.append(f"| {setting.name} | {name} | {' | '.join(cells)} |")
    return ["| mm | fitter | salsa: seen | missing | others: seen | missing |", rule(6), *rows]


def time_table(comparison: Comparison, images: Path | None) -> list[str]:
    """How long until each method is as good as the plain optimiser is in the end."""
    names = [method.name for method in comparison.methods]
    plain = names[1]
    rows = []
    for setting, curves in comparison.curves.items():
        target = curves[plain].error_mm[-1]
        whole = curves[plain].ms[-1]
        cells = []
        for name in names:
            ms = curves[name].time_to(target + 0.1)
            cells.append(
                f"{ms:.2f} ({ms / whole:.3f})"
                if np.isfinite(ms)
                else f"never ({curves[name].error_mm[-1]:.1f} mm)"
            )
        rows.append(f"| {setting.name} | {target:.1f} | {' | '.join(cells)} |")
    if images is not None:
        draw_curves(comparison, images / "fitter_time.png")
    head = f"| ms a fit (share of the time of {PLAIN_STEPS} steps) | error to reach, mm | {' | '.join(names)} |"
    return [head, rule(2 + len(names)), *rows]


def draw_curves(comparison: Comparison, path: Path) -> None:
    """Error against time, a panel for each setting."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(SETTINGS), figsize=(4.2 * len(SETTINGS), 3.6), layout="constrained")
    for axis, (setting, curves) in zip(axes, comparison.curves.items(), strict=True):
        for (name, each), colour in zip(curves.items(), COLOURS, strict=False):
            axis.plot(each.ms, each.error_mm, marker="." if len(each.ms) > 1 else "D", color=colour, label=name)
        axis.set(xscale="log", yscale="log", title=setting.name, xlabel=f"milliseconds a fit, {BATCH} at a time")
        _plain_ticks(axis.yaxis, axis.get_ylim(), (3, 5, 7, 10, 15, 20, 30, 40, 50, 70, 100, 200))
        _plain_ticks(axis.xaxis, axis.get_xlim(), (0.2, 0.5, 1, 2, 5, 10, 20, 50))
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0].set(ylabel="mean error of all joints, mm")
    axes[0].legend(fontsize=7)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _plain_ticks(axis, limits: tuple[float, float], values: tuple[float, ...]) -> None:
    """Numbers as one writes them, not powers of ten."""
    inside = [value for value in values if limits[0] <= value <= limits[1]]
    axis.set_ticks(inside, [f"{value:g}" for value in inside])


def speed_table(comparison: Comparison) -> list[str]:
    """Fits a second."""
    targets = comparison.targets[SETTINGS[2]][0]
    rows = []
    for method in comparison.methods:
        fitter = method.make(None)
        asked = ((1, BATCH), (1, LARGE_BATCH), (2, LARGE_BATCH))
        some = first(targets, 4 * LARGE_BATCH)
        cells = [f"{fits_per_second(fitter, some, batch, workers):.0f}" for workers, batch in asked]
        rows.append(f"| {method.name} | {' | '.join(cells)} |")
    head = f"| fits a second | 1 thread, {BATCH} at a time | 1 thread, {LARGE_BATCH} | 2, {LARGE_BATCH} each |"
    return [head, rule(4), *rows]


def optimum_lines(comparison: Comparison, rows: int = 8) -> list[str]:
    """Whether Levenberg-Marquardt's optimum is one."""
    lines = [
        "| L-BFGS, energy lower by | median | largest | joints move, mm | from the closed form: median "
        "| in a worse optimum |",
        rule(6),
    ]
    for setting, (targets, _) in comparison.targets.items():
        some = first(targets, rows)
        found = check_optimum(some, comparison.methods[0].make(None).fit(some))
        gain, elsewhere = found.energy - found.from_there, found.energy - found.from_elsewhere
        worse = int((elsewhere < -0.1).sum())
        lines.append(
            f"| {setting.name} | {np.median(gain):.4f} | {gain.max():.4f} | {found.moved_mm.mean():.2f} "
            f"| {np.median(elsewhere):.4f} | {worse} of {len(gain)} |"
        )
    return lines


def covariance_table(comparison: Comparison) -> list[str]:
    """Whether the truth lies where the bodies' covariances say."""
    rows = ["| if true | | | 50 | 90 | 95 | 2.37 | 3 |"]
    truth = comparison.drawn[0]
    for setting, outcomes in comparison.outcomes.items():
        missing = comparison.targets[setting][1]
        for name, found in list(outcomes.items())[2:]:
            for belief, left_out in (("all targets", False), ("without its own", True)):
                for joints, mask in (("seen", ~missing), ("missing", missing)):
                    if not mask.any():
                        continue
                    c = fit_calibration(found.fit, truth, mask, left_out=left_out)
                    shares = " | ".join(f"{100 * share:.1f}" for share in c.coverage.values())
                    rows.append(
                        f"| {setting.name} | {name} | {joints}, {belief} | {shares} | {c.median_nees:.2f} "
                        f"| {c.mean_nees:.2f} |"
                    )
    head = "| targets | fitter | joints, from | inside the 50 % ellipsoid, % | 90 % | 95 % | median NEES | mean |"
    return [head, rule(8), *rows]


def sigma_table(comparison: Comparison) -> list[str]:
    """Sigma claimed over error found."""
    rows = []
    for setting, outcomes in comparison.outcomes.items():
        missing = comparison.targets[setting][1]
        for name, found in list(outcomes.items())[2:]:
            for joints, mask in (("seen", ~missing), ("missing", missing)):
                if mask.any():
                    ratios = sigma_ratios(found.fit, comparison.drawn[0], mask).values()
                    rows.append(
                        f"| {setting.name} | {name} | {joints} | {' | '.join(f'{r:.2f}' for r in ratios)} |"
                    )
    return [f"| targets | fitter | joints | {' | '.join(GROUPS)} |", rule(3 + len(GROUPS)), *rows]


def alternation_table(motions: Path, shelf: Path | None) -> list[str]:
    """The whole pipeline with each fitter, on the same detections."""
    config = replace(PipelineConfig(), temporal=False)
    fitters = {"Levenberg-Marquardt": LevenbergMarquardtFitter(config=config.body.plain)}
    fitters |= {method.name: method.make(None) for method in learned()[1:]}
    rows = []
    if shelf is not None:
        truth, recording = read_shelf_ground_truth(shelf / "gt_dev.txt"), shelf_footage(shelf)
        for name, fitter in fitters.items():
            people, ms = _reconstructed(recording.detections, recording.rig, config, fitter)
            pcp = evaluate_shelf(people, truth).pcp_average
            rows.append(f"| Shelf | {name} | {pcp:.2f} | | | {ms:.1f} |")
    mocap = Mocap.load(motions)
    for scene_name in SEQUENCES:
        scene = sequence(scene_name, "report", mocap)
        frames = range(0, len(scene), STRIDE)
        seen = simulate(scene, seed=0, frames=frames)
        for name, fitter in fitters.items():
            people, ms = _reconstructed(seen, scene.rig, config, fitter)
            m = joint_metrics(people, scene.keypoints[::STRIDE])
            rows.append(f"| {scene_name} | {name} | | {100 * m.f1:.2f} | {m.mpjpe_mm:.1f} | {ms:.1f} |")
    return ["| recording | fitter | Avg PCP, % | F1, % | MPJPE, mm | ms a frame |", rule(6), *rows]


def _reconstructed(
    detections: DetectionSequence, rig: Rig, config: PipelineConfig, fitter: BodyFitter
) -> tuple[Reconstruction, float]:
    """The people, and the processor's milliseconds a frame."""
    start = time.process_time()
    people = reconstruct(detections, rig, config, fitter=fitter)
    return people, 1e3 * (time.process_time() - start) / len(detections)


def _mm(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else "-"


def _spread(values: NDArray[np.float64]) -> str:
    low, middle, high = np.quantile(values, (0.1, 0.5, 0.9))
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"
