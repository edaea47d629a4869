"""Which frames are shown: by a rule, so that nobody picks the ones that look well."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.alternation import before_refinement
from shapepose_fg.evaluation.experiments.scale import Stretch
from shapepose_fg.evaluation.matching import People, match_people
from shapepose_fg.evaluation.trajectories import LIMB_ENDS
from shapepose_fg.pipeline.pipeline import PipelineConfig

Array = NDArray[np.float64]

WRONG_M = 0.2
"""A joint farther from the truth than this is wrong."""
ODD_SHARE = 0.3
"""A limb whose length is off by more than this share is no human one's."""
_APART_S = 1.0
"""Two frames of one person are two examples when they are this far apart."""
_CORE = list(BODY_25.core)


@dataclass(frozen=True)
class Rows:
    """M people in frames of a stretch who are found, and where their joints are."""

    stretch: Stretch
    """Of which scene."""
    frame: NDArray[np.intp]
    """(M,) frame of the stretch."""
    person: NDArray[np.intp]
    """(M,) person of the scene."""
    joints: dict[str, Array]
    """(M, 25, 3) for each step of the method, first to last, metres; NaN where a step does not place one."""

    @cached_property
    def truth(self) -> Array:
        """(M, 25, 3) metres."""
        return self.stretch.scene.keypoints[self.frame, self.person]

    @cached_property
    def first(self) -> Array:
        """(M, 25, 3) of the first step."""
        return next(iter(self.joints.values()))


@dataclass(frozen=True)
class Beside:
    """What several methods make of one frame."""

    stretch: Stretch
    """Of which scene."""
    frame: int
    """Of the stretch."""
    pair: tuple[int, int]
    """Two people of the scene."""
    people: dict[str, People]
    """Everybody whom each method finds, in all frames."""

    def here(self, name: str) -> Array:
        """(N, 25, 3) joints of a method's people in the frame, metres."""
        found = self.people[name]
        return np.asarray(found.joints, dtype=np.float64)[np.asarray(found.frame) == self.frame]

    def of_the_pair(self, name: str) -> Array:
        """(2, 25, 3) joints of the two, by who is who in that frame; NaN for somebody who is not found."""
        here = self.here(name)
        truth = self.stretch.scene.keypoints[[self.frame]]
        matches = match_people(np.zeros(len(here), dtype=np.intp), here, truth)
        joints = np.full((len(truth[0]), *truth.shape[2:]), np.nan)
        joints[matches.person] = here[matches.row]
        return joints[list(self.pair)]


def closest_contact(stretch: Stretch) -> tuple[int, tuple[int, int]]:
    """The frame in which two people are closest, in the median distance between their own joints, and the two."""
    joints = stretch.scene.keypoints
    apart = np.full((len(joints), joints.shape[1], joints.shape[1]), np.inf)
    for first, second in combinations(range(joints.shape[1]), 2):
        apart[:, first, second] = np.median(np.linalg.norm(joints[:, first] - joints[:, second], axis=-1), axis=-1)
    frame, first, second = (int(each) for each in np.unravel_index(apart.argmin(), apart.shape))
    return frame, (first, second)


def before_and_after(stretch: Stretch, config: PipelineConfig) -> Rows:
    """People whom stage I finds and whom the final result has, too."""
    scene, detections = stretch.scene, stretch.detections
    before, after = before_refinement(detections, scene.rig, config), stretch.reconstruct(config)
    table = np.full((2, len(scene), scene.people), -1)
    for step, people in enumerate((before, after)):
        matches = match_people(people.frame, people.joints, scene.keypoints)
        table[step, matches.frame, matches.person] = matches.row
    frame, person = np.nonzero((table >= 0).all(axis=0))
    initial, final = (table[step, frame, person] for step in (0, 1))
    return Rows(stretch, frame, person, {"initial": before.joints[initial], "final": after.joints[final]})


def found(stretch: Stretch, people: Reconstruction) -> Rows:
    """The rows of a result that are somebody."""
    matches = match_people(people.frame, people.joints, stretch.scene.keypoints)
    return Rows(stretch, matches.frame, matches.person, {"final": people.joints[matches.row]})


def missing(rows: Rows) -> NDArray[np.float64]:
    """(M,) how many joints of trunk, arms and legs the first step lacks."""
    return np.isnan(rows.first[:, _CORE]).any(axis=-1).sum(axis=1).astype(np.float64)


def farthest(rows: Rows) -> NDArray[np.float64]:
    """(M,) how far the first step's worst joint is from the truth, metres."""
    return np.nan_to_num(np.linalg.norm(rows.first - rows.truth, axis=-1)).max(axis=1)


def oddest(rows: Rows) -> NDArray[np.float64]:
    """(M,) by which share the first step's most abnormal arm or leg is too long or too short."""
    return np.nan_to_num(np.abs(odd_limbs(rows.first, rows.truth))).max(axis=1)


def mean_error(rows: Rows) -> NDArray[np.float64]:
    """(M,) mean distance of the first step's joints from the truth, metres."""
    return np.nanmean(np.linalg.norm(rows.first - rows.truth, axis=-1), axis=1)


def odd_limbs(joints: Array, truth: Array) -> Array:
    """(..., 8) length of arms and legs against the true one, less 1; NaN where an end is not placed."""
    ends = np.array(LIMB_ENDS)
    length, true = (
        np.linalg.norm(each[..., ends[:, 0], :] - each[..., ends[:, 1], :], axis=-1) for each in (joints, truth)
    )
    return length / true - 1


def most(rows: Rows, by: Callable[[Rows], Array], count: int = 1, without: Sequence[int] = ()) -> list[int]:
    """The `count` rows with the largest value of `by`, of other people or moments, nor those of `without`."""
    chosen = list(without)
    apart = _APART_S * rows.stretch.scene.fps
    for row in np.argsort(-by(rows), kind="stable").tolist():
        near = [
            other
            for other in chosen
            if rows.person[other] == rows.person[row] and abs(rows.frame[other] - rows.frame[row]) < apart
        ]
        if len(near) == 0:
            chosen.append(row)
        if len(chosen) == len(without) + count:
            break
    return chosen[len(without) :]
