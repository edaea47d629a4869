"""The simulated detector beside the real one, both measured alike: a table of their distances."""

from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.simulation import DetectorConfig
from shapepose_fg.simulation.measurement.calibration import simulated, watch
from shapepose_fg.simulation.measurement.classes import (
    GROUP,
    GROUPS,
    joint_states,
)
from shapepose_fg.simulation.measurement.confusions import false_candidates, merging, swaps
from shapepose_fg.simulation.measurement.errors import whitened
from shapepose_fg.simulation.measurement.memories import autocorrelation, hits_about_mean, normal_scores
from shapepose_fg.simulation.measurement.misses import is_lost
from shapepose_fg.simulation.measurement.people import CONFIG, FPS, shelf_people, twin
from shapepose_fg.simulation.measurement.sample import Sample, pool, take_sample
from shapepose_fg.simulation.measurement.statistics import statistics

UNSEEN = (100, 101, 102, 103, 104, 105)
"""Of the simulated recordings, which are taken together; calibration used 0 and up."""
STATES = ("visible", "hidden by itself", "hidden by another")
"""Names of `joint_states`."""
LAGS = np.arange(1, 41)
"""Frames over which memories are compared."""


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


def compare(shelf: Path) -> tuple[dict[str, Measured], list[Measured]]:
    """The recording in the folder `shelf` and its simulation ("real", "simulated"); and each seed alone."""
    detections, rig, people = shelf_people(shelf)
    scene = twin(people, rig, FPS)
    samples = simulated(scene, watch(scene), DetectorConfig(), UNSEEN)
    both = {
        "real": Measured(take_sample(detections, rig, people, CONFIG), rig),
        "simulated": Measured(pool(samples), rig),
    }
    return both, [Measured(sample, rig) for sample in samples]


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
