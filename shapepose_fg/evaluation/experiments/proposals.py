"""The paper's table of human proposals, and its figure of how robust they are to hips that few views see."""

from collections.abc import Mapping
from pathlib import Path

from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.hips import (
    BY_THE_PAPER,
    HIP,
    METHODS,
    precision_recall_f1,
    proposed_by_the_paper,
    score_hips,
    with_hips_in_views,
)
from shapepose_fg.evaluation.experiments.scale import Scale, Stretch, shorter
from shapepose_fg.evaluation.markdown import rule

VIEWS = (2, 3, 4, 5, 6)
"""The views that may see a person's hips."""
FRAMES, FRAMES_OF_VIEWS = 300, 50
"""Of each stretch; and for each count of views."""
PAPER = {
    "VoxelPose (Tu et al. 2020)": (68.8, 77.3, 72.8),
    "Zhang et al. 2020": (99.6, 51.2, 67.6),
    "the paper": (98.8, 94.2, 96.4),
}
"""Precision, recall, F1 in % of the paper's table, on the Association Dataset."""
PAPER_VIEWS, PAPER_PRECISION = 4.8, 97.8
"""Mean count of views that see a hip there, and the precision that the figure's caption gives for it."""


def proposals(scale: Scale) -> Experiment | None:
    """Precision, recall and F1 of proposals: stage I alone, the paper's and ours; without time, over time."""
    if not scale.has_scenes:
        return None
    stretches = [shorter(stretch, FRAMES) for stretch in scale.one_each]
    methods = (BY_THE_PAPER, *METHODS)
    cases = {(method, stretch): f"{method}, {stretch.label}" for method in methods for stretch in stretches}

    def case(method: str, stretch: Stretch, name: str) -> Case:
        return Case(name, lambda: _measure(method, stretch))

    def table(figures: Mapping[str, Figures]) -> list[str]:
        rows = ["| human proposals | precision, % | recall, % | F1, % |", "|---|---|---|---|"]
        for method in methods:
            found = precision_recall_f1(figures[name] for (other, _), name in cases.items() if other == method)
            name = method if method == BY_THE_PAPER else f"**ours, {method}**"
            rows.append(f"| {name} | {' | '.join(f'{share:.1f}' for share in found)} |")
        return rows + [
            f"| {name}: Association Dataset | {' | '.join(map(str, those))} |" for name, those in PAPER.items()
        ]

    return Experiment("proposals", [case(*key, name) for key, name in cases.items()], table)


def hip_views(scale: Scale, images: Path | None = None) -> Experiment | None:
    """The same with hips that are seen by two views only, up to six; drawn into the folder `images`, if given."""
    if not scale.has_scenes:
        return None
    stretches = [shorter(stretch, FRAMES_OF_VIEWS) for stretch in scale.one_each]
    counts = VIEWS[::4] if scale.quick else VIEWS
    cases = {(views, stretch): f"{views} views, {stretch.label}" for views in counts for stretch in stretches}

    def case(views: int, stretch: Stretch, name: str) -> Case:
        return Case(name, lambda: _measure_views(views, stretch))

    def table(figures: Mapping[str, Figures]) -> list[str]:
        head = " | ".join(f"{method}: precision, recall, %" for method in METHODS)
        rows = [f"| hips are seen by at most | mean of views | {head} |", rule(2 + len(METHODS))]
        for views, mean, found in curves(figures):
            cells = (f"{precision:.1f}, {recall:.1f}" for precision, recall in found.values())
            rows.append(f"| {views} | {mean:.1f} | {' | '.join(cells)} |")
        if images is not None:
            draw_hip_views(figures, images / "hip_views.png")
        return rows

    return Experiment("hip_views", [case(*key, name) for key, name in cases.items()], table)


def curves(figures: Mapping[str, Figures]) -> list[tuple[int, float, dict[str, tuple[float, float]]]]:
    """From the figures of `hip_views`: views, the mean of views, and precision and recall of each method in %."""
    points = []
    for views in VIEWS:
        those = [found for name, found in figures.items() if name.startswith(f"{views} views")]
        if len(those) == 0:
            continue
        mean = sum(found["views"] * found["people"] for found in those) / sum(found["people"] for found in those)
        shares = {method: precision_recall_f1(found[method] for found in those)[:2] for method in METHODS}
        points.append((views, mean, shares))
    return points


def draw_hip_views(figures: Mapping[str, Figures], file: Path) -> None:
    """The picture that goes with the table of `hip_views`, in the manner of the paper's."""
    from matplotlib.figure import Figure

    points = curves(figures)
    figure = Figure(figsize=(7.2, 2.9), layout="constrained")
    for axes, which, name, paper in zip(
        figure.subplots(1, 2),
        (0, 1),
        ("precision", "recall"),
        (PAPER_PRECISION, PAPER["the paper"][1]),
        strict=True,
    ):
        for method, style in zip(METHODS, ("o:", "s--", "D-"), strict=True):
            axes.plot(
                [mean for _, mean, _ in points],
                [found[method][which] for *_, found in points],
                style,
                label=method,
                markersize=4,
            )
        axes.plot(PAPER_VIEWS, paper, "k*", markersize=10, label="the paper, its data")
        axes.set_xlabel("views that see a person's hips, mean")
        axes.set_ylabel(f"{name}, %")
        axes.grid(alpha=0.3)
    figure.axes[1].legend(fontsize=8, loc="lower right")
    figure.savefig(file, dpi=130)


def _measure(method: str, stretch: Stretch) -> Figures:
    """One method on a stretch as it is."""
    scene, propose = stretch.scene, METHODS.get(method, proposed_by_the_paper)
    return score_hips(propose(stretch.detections, scene), scene.keypoints[:, :, HIP])


def _measure_views(views: int, stretch: Stretch) -> Figures:
    """All methods on a stretch whose hips so many views see at most."""
    scene = stretch.scene
    seen = with_hips_in_views(stretch.detections, scene, views, stretch.seed)
    truth = scene.keypoints[:, :, HIP]
    found = {method: score_hips(propose(seen.detections, scene), truth) for method, propose in METHODS.items()}
    return {"views": seen.views, "people": int(truth.shape[0] * truth.shape[1]), **found}
