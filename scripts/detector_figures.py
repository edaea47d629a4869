"""The simulated detector beside the real one, for `reproduce_simulation.py`: a table of distances, and figures.

Both are measured alike (`detector_sample.py`): the Shelf recording, and simulated recordings of the same poses
before the same cameras, with seeds on which nothing was calibrated.
"""

from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import matplotlib
import numpy as np
from detector_misses import is_lost
from detector_sample import Sample, pool, take_sample, twin
from measure_detector import (
    CONFIG,
    FPS,
    GROUP,
    GROUPS,
    autocorrelation,
    false_candidates,
    hits_about_mean,
    joint_states,
    merging,
    normal_scores,
    shelf_people,
    simulated,
    statistics,
    swaps,
    watch,
    whitened,
)
from numpy.typing import NDArray

from shapepose_fg.simulation import DetectorConfig
from shapepose_fg.skeleton import BODY_25

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

UNSEEN = (100, 101, 102, 103, 104, 105)
"""Of the simulated recordings, which are taken together; calibration used 0 and up."""
COLOURS = {"real": "black", "simulated": "#d95f02"}
STATES = ("visible", "hidden by itself", "hidden by another")
LAGS = np.arange(1, 41)


class Measured:
    """One recording, seen through its sample."""

    def __init__(self, sample: Sample, rig) -> None:
        self.sample = sample
        self.expected = sample.expected
        self.state = joint_states(sample.expected)
        self.rig = rig
        self.length_mm = 1e3 * np.linalg.norm(sample.expected["residual_m"], axis=1)

    @cached_property
    def statistics(self) -> dict:
        """As the simulated detector draws from them."""
        return statistics(self.sample, self.rig, FPS)

    def confidences(self, state: int) -> NDArray:
        """Of the joints found in this state."""
        return self.expected["confidence"][self.expected["hit"] & (self.state == state)]

    def errors(self, least: float = 0.0, most: float = 1.0) -> NDArray:
        """Residual lengths of visible joints of a confidence in a range, mm."""
        confidence = self.expected["confidence"]
        return self.length_mm[(self.state == 0) & (confidence >= least) & (confidence <= most)]

    def memories(self) -> dict[str, NDArray]:
        """Autocorrelations of errors, confidences and hits over LAGS."""
        z = whitened(self.expected, self.state, self.statistics)
        return {
            "error": np.mean([autocorrelation(z[:, k], self.expected, LAGS) for k in range(2)], axis=0),
            "confidence": autocorrelation(normal_scores(self.expected, self.state), self.expected, LAGS),
            "found or not": autocorrelation(hits_about_mean(self.expected, self.state), self.expected, LAGS),
        }

    def misses(self, state: int) -> NDArray:
        """(14,) share of the joints missed, by joint; NaN where under 30 were expected."""
        those = self.state == state
        group = GROUP[self.expected["joint"][those]]
        count = np.bincount(group, minlength=len(GROUPS))
        missed = np.bincount(group, ~self.expected["hit"][those], minlength=len(GROUPS))
        return np.where(count >= 30, missed / np.maximum(count, 1), np.nan)

    def counts(self) -> NDArray:
        """Candidates of each joint in each view and frame, people who were not reconstructed left out."""
        c = self.sample.candidates
        ours = ~c["stranger"]
        frames, views = c["frame"].max() + 1, c["view"].max() + 1
        label = (c["frame"] * views + c["view"]) * 25 + c["joint"]
        return np.bincount(label[ours], minlength=frames * views * 25)

    def missed(self, state: int, least: float = 0.0, most: float = 1.0) -> float:
        """Share of the joints missed in this state, where others hide so much of the person, %."""
        buried = self.expected["buried"]
        return 100 * float(
            1 - self.expected["hit"][(self.state == state) & (buried >= least) & (buried <= most)].mean()
        )

    def lost(self) -> float:
        """Share of the people in views of whom half is missed though nobody hides them, %."""
        return 100 * float(is_lost(self.expected, self.state)[1][0])

    def captured(self) -> float:
        """Share of the joints missed behind another person that are found on that person, %."""
        return 100 * float(self.sample.captured["taken"].mean())

    def wrong_listed(self) -> float:
        """Share of the pairs of two people that have an affinity, %."""
        pairs = self.sample.pairs
        return 100 * float((pairs["affinity"] > 0)[~pairs["right"] & ~pairs["nobody"]].mean())

    def affinities(self, right: bool) -> NDArray:
        """Of right pairs, or of those of two people that have one."""
        pairs = self.sample.pairs
        those = pairs["right"] if right else ~pairs["right"] & ~pairs["nobody"] & (pairs["affinity"] > 0)
        return pairs["affinity"][those]


def tables_and_figures(shelf: Path, images: Path | None) -> list[str]:
    """Measure the recording in the folder `shelf` and its simulation, compare; draw into `images` if given."""
    detections, rig, people = shelf_people(shelf)
    scene = twin(people, rig, FPS)
    samples = simulated(scene, watch(scene), DetectorConfig(), UNSEEN)
    both = {
        "real": Measured(take_sample(detections, rig, people, CONFIG), rig),
        "simulated": Measured(pool(samples), rig),
    }
    if images is not None:
        draw(images / "detector_joints.png", both, [confidences, errors, misses])
        draw(images / "detector_time.png", both, [memories, counts, tails])
        draw(images / "detector_affinities.png", both, [right_pairs, wrong_pairs, wrong_shares])
    return table(both, [Measured(sample, rig) for sample in samples])


def table(both: dict[str, Measured], each: list[Measured]) -> list[str]:
    """Real, simulated (together, and `each` by itself), and their distance, as Markdown."""
    real, simulated = both.values()
    rows = []

    def distribution(name: str, of: Callable[[Measured], NDArray], unit: str = "", digits: int = 2) -> None:
        a, b = of(real), of(simulated)
        cells = [" / ".join(f"{q:.{digits}f}" for q in np.quantile(x, [0.1, 0.5, 0.9])) for x in (a, b)]
        rows.append(f"| {name}{unit} | {cells[0]} | {cells[1]} | KS {kolmogorov_smirnov(a, b):.3f} | |")

    def number(name: str, of: Callable[[Measured], float], digits: int = 1) -> None:
        a, b = of(real), of(simulated)
        spread = np.std([of(one) for one in each], ddof=1)
        rows.append(f"| {name} | {a:.{digits}f} | {b:.{digits}f} | {b - a:+.{digits}f} | {spread:.{digits}f} |")

    for state, name in enumerate(STATES):
        distribution(f"confidence, {name}", lambda m, s=state: m.confidences(s))
    for state, name in enumerate(STATES):
        number(f"missed, {name}, %", lambda m, s=state: m.missed(s))
    number("missed, visible, others hide half the person or more, %", lambda m: m.missed(0, 0.5))
    number("missed, hidden by another who hides a third or less, %", lambda m: m.missed(2, 0.0, 0.33))
    number("missed, hidden by another who hides half or more, %", lambda m: m.missed(2, 0.5))
    number("people in views half missed though nobody hides them, %", Measured.lost)
    distribution("residual, visible", Measured.errors, ", mm", 0)
    for low, high in ((0.15, 0.4), (0.4, 0.6), (0.6, 0.75), (0.75, 0.85), (0.85, 1.0)):
        distribution(
            f"residual, confidence {low:.2f} to {high:.2f}", lambda m, r=(low, high): m.errors(*r), ", mm", 0
        )
    for name in ("error", "confidence", "found or not"):
        cells = [" / ".join(f"{m.memories()[name][lag - 1]:.2f}" for lag in (1, 5, 25)) for m in (real, simulated)]
        gap = np.abs(real.memories()[name] - simulated.memories()[name]).mean()
        rows.append(
            f"| autocorrelation after 1 / 5 / 25 frames, {name} | {cells[0]} | {cells[1]} | mean {gap:.3f} | |"
        )
    rows.append(_distance_of_counts(real, simulated))
    for name, digits, of in NUMBERS:
        number(name, of, digits)
    number("captured, of those missed behind another, %", Measured.captured)
    distribution("affinity of right pairs", lambda m: m.affinities(True))
    distribution("affinity of wrong pairs that have one", lambda m: m.affinities(False))
    number("wrong pairs that have one, %", Measured.wrong_listed)
    head = "| 10 / 50 / 90 % quantiles, or a number | real | simulated | distance | seed to seed |"
    return [head, "|---" * 5 + "|", *rows]


def kolmogorov_smirnov(a: NDArray, b: NDArray) -> float:
    """The largest distance between two samples' cumulative distributions."""
    at = np.concatenate([a, b])
    below = [np.searchsorted(np.sort(x), at, side="right") / len(x) for x in (a, b)]
    return float(np.abs(below[0] - below[1]).max())


def _false(m: Measured, which: str) -> float:
    return false_candidates(m.sample, m.rig, FPS)[which]


NUMBERS: tuple[tuple[str, int, Callable[[Measured], float]], ...] = (
    ("false candidates, a person and view", 2, lambda m: _false(m, "near_per_person")),
    ("false candidates far from people, a view", 2, lambda m: _false(m, "far_per_view")),
    ("found only under the mirror's name, %", 2, lambda m: 100 * swaps(m.expected)["instead"]),
    ("also found under the mirror's name, %", 2, lambda m: 100 * swaps(m.expected)["besides"]),
    ("two people's joints are one below, px", 1, lambda m: merging(m.sample, m.rig)["half_px"]),
)
"""Name, digits, and how it is measured."""


def _distance_of_counts(real: Measured, simulated: Measured) -> str:
    a, b = real.counts(), simulated.counts()
    shares = [np.bincount(np.minimum(x, 5), minlength=6) / len(x) for x in (a, b)]
    distance = 0.5 * np.abs(shares[0] - shares[1]).sum()
    means = f"{a.mean():.2f} | {b.mean():.2f}"
    return f"| candidates of a joint in a view, mean | {means} | total variation {distance:.3f} | |"


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
