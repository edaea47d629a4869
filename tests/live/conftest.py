"""A dance as it comes: frame by frame into a live reconstruction that refines within `push`."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.live.online import OnlineReconstructor


@dataclass(frozen=True)
class Played:
    """What was told of 40 frames, 1.3 s."""

    now: Reconstruction
    """The newest people after each frame, by the scene's frames."""
    ahead: Reconstruction
    """What was said of them 0.1 s before, of the frames that it is about."""
    settled: Reconstruction
    """The refined rows."""
    slots: list[int]
    """How many frames were kept after each."""


def rows(parts) -> Reconstruction:
    return Reconstruction.concatenate([replace(part, observations=None) for part in parts])


@pytest.fixture(scope="session")
def played(dance) -> Played:
    now, ahead, settled, slots = [], [], [], []
    with OnlineReconstructor(dance.scene.rig, workers=1) as live:
        for frame, time_s in enumerate(dance.times.frame_s.tolist()):
            live.push(dance.recording[frame], time_s)
            now.append(live.people())
            later = live.people(time_s + 0.1)
            ahead.append(replace(later, frame=later.frame + 3))
            settled.append(live.settled())
            slots.append(len(live._state.slots))
        settled.append(live.finish())
    return Played(rows(now), rows(ahead), rows(settled), slots)


@pytest.fixture
def start(dance):
    """A function (**options) -> a live reconstruction before the dance's cameras; they end with the
    test.
    """
    begun = []

    def make(rig=None, **options):
        begun.append(
            OnlineReconstructor(dance.scene.rig if rig is None else rig, **{"workers": 1} | options)
        )
        return begun[-1]

    yield make
    for each in begun:
        each.close()


def errors_mm(people: Reconstruction, truth) -> tuple[np.ndarray, np.ndarray]:
    """(M, J) errors of rows of `people` that are somebody of the truth (T, P, J, 3), and who
    (M,).
    """
    from shapepose_fg.evaluation.metrics import match_people

    found = match_people(people.frame, people.joints, truth)
    return 1e3 * np.linalg.norm(
        people.joints[found.row] - truth[found.frame, found.person], axis=-1
    ), found
