"""What results of other systems are scored by, and where they lie: a folder for each recording."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.experiments.experiment import Figures
from shapepose_fg.evaluation.experiments.scale import Stretch
from shapepose_fg.evaluation.matching import People
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.evaluation.other_results.reading import read_people
from shapepose_fg.evaluation.other_results.skeleton_text import SKEL_19

FILTERED, RAW = "pose2sim", "pose2sim-raw"
"""Pose2Sim with time (gaps interpolated, outliers rejected, low-pass), and frame by frame."""
OTHERS = {
    "Zhang et al. 2020, frame by frame": "4d-association-raw.txt",
    "Zhang et al. 2020, over time": "4d-association.txt",
    "Pose2Sim, frame by frame": RAW,
    "Pose2Sim, over time": FILTERED,
}
"""Other systems, and what their results are called: 4D Association's text, or a folder of TRC files."""
THRESHOLDS_M = (0.2, 0.1, 0.05)
"""A joint is correct if it is at most so far from the true one."""
COMMON = tuple(BODY_25.index(name) for name in SKEL_19)
"""The joints that every system has, that of Zhang et al. 2020 too: no eyes, of the feet the big toes only."""


@dataclass(frozen=True)
class PlainPeople:
    """Joints and nothing else; implements `People`."""

    frame: NDArray[np.integer]
    """(N,) frame of each row."""
    joints: NDArray[np.float64]
    """(N, J, 3) metres; NaN where unknown."""


def folder_name(stretch: Stretch) -> str:
    """The folder of a stretch among those of other systems' results."""
    return f"{stretch.split}-{stretch.name}-{stretch.span.start}-{stretch.span.stop}"


def read_others(others: Path, recording: str) -> dict[str, Reconstruction]:
    """What other systems made of a recording, by the names of `OTHERS`; those with nothing there are left out.

    `others` has a folder for each recording, with what `OTHERS` calls a system's files in it.
    """
    places = {name: others / recording / place for name, place in OTHERS.items()}
    return {name: read_people(place) for name, place in places.items() if place.exists()}


def scored(people: People, truth: NDArray[np.float64]) -> Figures:
    """Precision, recall and F1 at each threshold, per cent, and MPJPE, of the `common` joints and of `all` 25.

    `truth` (T, P, 25, 3), metres. People are matched by the joints that are scored.
    """
    joints = np.asarray(people.joints, dtype=np.float64)
    return {
        name: _figures(PlainPeople(people.frame, joints[:, chosen]), truth[:, :, chosen])
        for name, chosen in (("common", list(COMMON)), ("all", list(range(len(BODY_25)))))
    }


def _figures(people: People, truth: NDArray[np.float64]) -> Figures:
    found = {f"{limit:g}": joint_metrics(people, truth, correct_m=limit) for limit in THRESHOLDS_M}
    first = next(iter(found.values()))
    return {
        "at": {
            limit: {name: _percent(getattr(each, name)) for name in ("precision", "recall", "f1")}
            for limit, each in found.items()
        },
        "mpjpe_mm": first.mpjpe_mm if np.isfinite(first.mpjpe_mm) else None,
        "people": first.people_true,
        "missed": first.people_missed,
        "nobody": first.people_duplicated + first.people_invented,
    }


def _percent(share: float) -> float | None:
    return 100 * share if np.isfinite(share) else None


def mean_of(figures: Sequence[Figures]) -> Figures:
    """The mean of figures of one form, number by number; None where one of them is None."""
    mean: Figures = {}
    for name, value in figures[0].items():
        values = [each[name] for each in figures]
        if isinstance(value, dict):
            mean[name] = mean_of(values)
        else:
            mean[name] = None if None in values else float(np.mean(values))
    return mean
