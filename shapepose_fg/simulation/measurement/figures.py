"""Figures of the simulated detector beside the real one."""

from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation.measurement.classes import GROUPS
from shapepose_fg.simulation.measurement.comparison import LAGS, STATES, Measured
from shapepose_fg.simulation.measurement.errors import whitened

COLOURS = {"real": "black", "simulated": "#d95f02"}


def draw_figures(images: Path, both: dict[str, Measured]) -> None:
    """The three figures of docs/simulation.md, into the folder `images`."""
    plt.switch_backend("Agg")
    draw(images / "detector_joints.png", both, [confidences, errors, misses])
    draw(images / "detector_time.png", both, [memories, counts, tails])
    draw(images / "detector_affinities.png", both, [right_pairs, wrong_pairs, wrong_shares])


def draw(path: Path, both: dict[str, Measured], panels: list[Callable[[Axes, dict[str, Measured]], None]]) -> None:
    """A row of panels as an image."""
    figure, axes = plt.subplots(1, len(panels), figsize=(4.2 * len(panels), 3.6), layout="constrained")
    for axis, panel in zip(axes, panels, strict=True):
        panel(axis, both)
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _cumulative(axis: Axes, values: NDArray, **style) -> None:
    axis.plot(np.quantile(values, np.linspace(0, 1, 200)), np.linspace(0, 1, 200), **style)


def confidences(axis: Axes, both: dict[str, Measured]) -> None:
    """Distribution of the confidence, by state."""
    for state, dash in enumerate(("-", "--", ":")):
        for name, measured in both.items():
            _cumulative(
                axis, measured.confidences(state), color=COLOURS[name], ls=dash, label=f"{name}, {STATES[state]}"
            )
    axis.set(xlabel="confidence", ylabel="share of joints below", title="Confidence of joints found")
    axis.legend(fontsize=7)


def errors(axis: Axes, both: dict[str, Measured]) -> None:
    """Residual quantiles against confidence."""
    edges = np.array([0.15, 0.3, 0.45, 0.55, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 1.0])
    middle = (edges[:-1] + edges[1:]) / 2
    for name, measured in both.items():
        found = measured.expected["hit"] & (measured.state == 0)
        which = np.searchsorted(edges, measured.expected["confidence"][found], side="right") - 1
        length = measured.length_mm[found]
        for level, dash in ((0.5, "-"), (0.9, "--")):
            rows = [np.quantile(length[which == k], level) for k in range(len(middle))]
            axis.plot(middle, rows, color=COLOURS[name], ls=dash, marker=".", label=f"{name}, {level:.0%} below")
    axis.set(
        xlabel="confidence", ylabel="distance, mm", title="Visible joints, from where other views put them", ylim=0
    )
    axis.legend(fontsize=7)


def misses(axis: Axes, both: dict[str, Measured]) -> None:
    """Share missed, by joint."""
    names = [BODY_25.joints[j].removeprefix("R").removeprefix("L") for j in GROUPS]
    for state, marker in ((0, "o"), (1, "s"), (2, "^")):
        for name, measured in both.items():
            shift = 0.12 if name == "simulated" else -0.12
            axis.plot(np.arange(len(GROUPS)) + shift, measured.misses(state), marker, ms=4, color=COLOURS[name],
                      mfc=COLOURS[name] if state == 0 else "none", label=f"{name}, {STATES[state]}")  # fmt: skip
    axis.set_xticks(np.arange(len(GROUPS)), names, rotation=60, ha="right", fontsize=7)
    axis.set(ylabel="share missed", title="Misses", ylim=(-0.02, 1.02))
    axis.legend(fontsize=6, loc="upper center", bbox_to_anchor=(0.5, -0.28), ncols=3)


def memories(axis: Axes, both: dict[str, Measured]) -> None:
    """Autocorrelations."""
    for name, measured in both.items():
        for (what, values), dash in zip(measured.memories().items(), ("-", "--", ":"), strict=True):
            axis.plot(LAGS, values, color=COLOURS[name], ls=dash, label=f"{name}, {what}")
    axis.set(xlabel="frames apart", ylabel="autocorrelation", title="How long errors last", ylim=(0, 1))
    axis.legend(fontsize=7)


def counts(axis: Axes, both: dict[str, Measured]) -> None:
    """Histogram of candidates per joint and view."""
    for name, measured in both.items():
        share = np.bincount(np.minimum(measured.counts(), 5), minlength=6) / len(measured.counts())
        axis.bar(
            np.arange(6) + (0.2 if name == "simulated" else -0.2), share, 0.4, color=COLOURS[name], label=name
        )
    axis.set_xticks(range(6), ["0", "1", "2", "3", "4", "5+"])
    axis.set(xlabel="candidates of a joint in a view", ylabel="share", title="Candidates")
    axis.legend(fontsize=7)


def tails(axis: Axes, both: dict[str, Measured]) -> None:
    """Distribution of the residual by what is expected."""
    for name, measured in both.items():
        length = np.linalg.norm(whitened(measured.expected, measured.state, both["real"].statistics), axis=1)
        length = length[np.isfinite(length)]
        axis.semilogy(np.quantile(length, np.linspace(0, 0.9995, 400)), 1 - np.linspace(0, 0.9995, 400),
                      color=COLOURS[name], label=name)  # fmt: skip
    r = np.linspace(0, 4, 100)
    axis.semilogy(r, np.exp(-(r**2) / 2), color="grey", ls=":", label="Gaussian")
    axis.set(xlabel="residual / its expected sigma", ylabel="share beyond", title="Tails", ylim=(1e-3, 1))
    axis.legend(fontsize=7)


def right_pairs(axis: Axes, both: dict[str, Measured]) -> None:
    """Affinities of right pairs."""
    for name, measured in both.items():
        _cumulative(axis, measured.affinities(True), color=COLOURS[name], label=name)
    axis.set(xlabel="affinity", ylabel="share of pairs below", title="Right pairs")
    axis.legend(fontsize=7)


def wrong_pairs(axis: Axes, both: dict[str, Measured]) -> None:
    """Affinities of wrong pairs."""
    for name, measured in both.items():
        _cumulative(axis, measured.affinities(False), color=COLOURS[name], label=name)
    axis.set(xlabel="affinity", ylabel="share of pairs below", title="Pairs of two people that have one")
    axis.legend(fontsize=7)


def wrong_shares(axis: Axes, both: dict[str, Measured]) -> None:
    """Share of wrong pairs with an affinity."""
    for name, measured in both.items():
        found = measured.statistics["affinity"]
        for key, dash in (("wrong", "-"), ("nobody", "--")):
            label = f"{name}, {'two people' if key == 'wrong' else 'with a false candidate'}"
            axis.step([*found["detours"], 7.0], [*found[f"{key}_share"], found[f"{key}_share"][-1]], where="post",
                      color=COLOURS[name], ls=dash, label=label)  # fmt: skip
    axis.set(
        xlabel="distance from the right end, limb lengths", ylabel="share with an affinity", title="Wrong pairs"
    )
    axis.legend(fontsize=7)
