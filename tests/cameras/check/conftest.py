"""Three people who walk and wave before five cameras, seen by a detector that errs by two
pixels.
"""

import numpy as np
import pytest

from shapepose_fg.cameras.check.report import SetupReport, check_setup
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation.scene import ring_of_cameras

FRAMES = 60


def walkers(standing: np.ndarray, frames: int = FRAMES) -> np.ndarray:
    """(T, 3, 25, 3) people who walk on circles of their own at 1 m/s and wave one arm, 25 frames a
    second.
    """
    times = np.arange(frames) / 25.0
    people = []
    for number, (radius, start) in enumerate(((0.9, 0.0), (1.1, 2.1), (0.7, 4.2))):
        angle = start + times / radius
        turn = np.zeros((frames, 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
        turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = np.sin(angle), -np.sin(angle), 1.0
        body = np.repeat(standing[None] * (0.94 + 0.05 * number), frames, axis=0)
        body[:, 4, 2] += 0.4 * (1 + np.sin(5 * times + number))  # the right wrist
        place = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(frames)], axis=1)
        people.append(np.einsum("tij,tkj->tki", turn, body) + place[:, None])
    return np.stack(people, axis=1)


def seen_by(rig: Rig, people: np.ndarray, sigma_px: float = 2.0, seed: int = 0) -> Recording:
    """What a detector sees of people (T, P, 25, 3): every joint in the picture, with noise."""
    rng = np.random.default_rng(seed)
    frames = []
    for joints in people:
        xy, _ = rig.project(joints)
        xy = xy + rng.normal(0.0, sigma_px, xy.shape)
        inside = ((xy >= 0) & (xy < rig.image_sizes[:, None, None])).all(axis=-1)
        view, _, joint = (index[inside] for index in np.indices(xy.shape[:3]))
        place = np.full(inside.shape, -1)
        place[inside] = np.arange(inside.sum())
        first, second = np.array(BODY_25.limbs).T
        pairs = np.stack([place[:, :, first], place[:, :, second]], axis=-1).reshape(-1, 2)
        pairs = pairs[(pairs >= 0).all(axis=1)]
        frames.append(
            Detections(
                view, joint, xy[inside], np.full(len(view), 0.8), pairs, np.full(len(pairs), 0.9)
            )
        )
    return Recording(BODY_25, frames)


@pytest.fixture(scope="session")
def room() -> Rig:
    """Five cameras around the room."""
    return ring_of_cameras(5, np.random.default_rng(3), distance_m=(4.0, 4.6))


@pytest.fixture(scope="session")
def people(two_people) -> np.ndarray:
    """(T, 3, 25, 3) the three."""
    return walkers(two_people[0] + np.array([0.45, 0.0, 0.0]))


@pytest.fixture(scope="session")
def look_at():
    """A function (rig, people) -> Recording: what a detector sees of people (T, P, 25, 3)."""
    return seen_by


@pytest.fixture(scope="session")
def recording(room, people) -> Recording:
    """What the five cameras see of the three."""
    return seen_by(room, people)


@pytest.fixture(scope="session")
def sound(recording, room) -> SetupReport:
    """The check of that recording, in which nothing is wrong."""
    return check_setup(recording, room)
