"""Three people who walk and wave before four cameras; what may be wrong with these."""

import pickle
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.cameras import people as calibration_people
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Recording
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.timestamps import write_timestamps
from shapepose_fg.io.write_detections import write_association
from shapepose_fg.simulation.scene import ring_of_cameras
from tests.cameras.check.conftest import seen_by, walkers

FPS = 25.0


def disturbed(
    rig: Rig, seed: int, degrees: float = 1.0, metres: float = 0.02, focal: float = 0.0
) -> Rig:
    """The rig with every camera turned and moved by so much, in a random way, and its focal length
    off.
    """
    rng, cameras = np.random.default_rng(seed), []
    for camera in rig.cameras:
        axis, way = rng.normal(size=(2, 3))
        wTc, K = camera.wTc.copy(), camera.K.copy()
        turn = np.radians(degrees) * axis / np.linalg.norm(axis)
        wTc[:3, :3] = wTc[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
        wTc[:3, 3] += metres * way / np.linalg.norm(way)
        K[:2, :2] *= 1 + focal * rng.choice([-1, 1])
        cameras.append(replace(camera, wTc=wTc, K=K))
    return replace(rig, cameras=tuple(cameras))


def off_by(rig: Rig, truth: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Degrees and metres (V,) by which cameras are off, once the rig as a whole is laid on the true
    one.
    """
    a, b = rig.centres - rig.centres.mean(axis=0), truth.centres - truth.centres.mean(axis=0)
    near, far = (np.stack([each.wTc[:3, :3] for each in one.cameras]) for one in (rig, truth))
    size = np.linalg.norm(a) * np.linalg.norm(b) / len(rig)
    U, _, Vt = np.linalg.svd(b.T @ a / size + np.einsum("vij,vkj->ik", far, near))
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    turns = [
        Rotation.from_matrix((R @ one).T @ other).magnitude()
        for one, other in zip(near, far, strict=True)
    ]
    return np.degrees(turns), np.linalg.norm(a @ R.T - b, axis=1)


@pytest.fixture(scope="module")
def few_frames():
    """Thirty frames say as much of these cameras as bounds ask, in half the time."""
    before, calibration_people.MOST_FRAMES = calibration_people.MOST_FRAMES, 30
    yield
    calibration_people.MOST_FRAMES = before


@pytest.fixture(scope="session")
def rig() -> Rig:
    return ring_of_cameras(4, np.random.default_rng(3), distance_m=(4.0, 4.6))


@pytest.fixture(scope="session")
def people(two_people) -> np.ndarray:
    """(T, 3, 25, 3), ten seconds of them."""
    return walkers(two_people[0] + np.array([0.45, 0.0, 0.0]), 250)


@pytest.fixture(scope="session")
def recording(rig, people) -> Recording:
    """Seen by a detector whose errors of 2 px do not last."""
    return seen_by(rig, people)


@pytest.fixture(scope="module")
def once() -> Callable[[Callable], Callable]:
    """Wraps a function of detections and cameras so that it is computed once for each input:
    commands that must come to the same result do so by giving it the same.
    """
    results = dict[bytes, Any]()

    def wrap(function: Callable) -> Callable:
        def known(detections: Sequence, rig: Rig, *more: object, **named: object) -> Any:
            others = [each for each in (*more, *named.items()) if not _is_progress(each)]
            frames = [vars(frame) for frame in detections]
            key = pickle.dumps((function.__name__, frames, rig, others))
            if key not in results:
                results[key] = function(detections, rig, *more, **named)
            return results[key]

        return known

    return wrap


def _is_progress(argument: object) -> bool:
    return callable(argument[-1] if isinstance(argument, tuple) and argument else argument)


LATE_S = np.array([0.0, 2.513, -1.22, 4.0])
"""When the four cameras began."""


@pytest.fixture(scope="session")
def late(rig, two_people) -> Recording:
    """Twelve seconds of each camera, of people whom the others saw earlier or later."""
    return merged(rig, [filmed(two_people[0], offset) for offset in LATE_S])


def filmed(body: np.ndarray, offset: float, drift: float = 0.0) -> np.ndarray:
    """(300, 3, 25, 3) people before a camera that began so late, and falls behind."""
    times = np.arange(300) / FPS
    return np.stack(
        [moving(body + np.array([0.45, 0.0, 0.0]), t) for t in offset + times * (1 + drift)]
    )


def moving(body: np.ndarray, time: float) -> np.ndarray:
    """(3, 25, 3) three people on ways that never come again, waving at rates of their own."""
    people = []
    for number in range(3):
        place = [
            np.sin(0.31 * time + 2 * number) + 0.4 * np.sin(0.83 * time),
            np.cos(0.23 * time + number),
            0.0,
        ]
        turn = 0.5 * time + 0.7 * np.sin(0.6 * time + number)
        R = np.array(
            [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]]
        )
        one = body * (0.94 + 0.05 * number)
        one = one.copy()
        one[4, 2] += 0.3 * (1 + np.sin(4.1 * time + number + np.sin(0.9 * time)))
        one[7, 1] += 0.25 * np.sin(3.3 * time + 2 * number)
        people.append(one @ R.T + place)
    return np.stack(people)


def merged(rig: Rig, parts: list[np.ndarray]) -> Recording:
    """Each camera's own recording of its people (T, 3, 25, 3) as one."""
    seen = [seen_by(rig, people, seed=view) for view, people in enumerate(parts)]
    frames = []
    for each in zip(*(one.frames for one in seen), strict=True):
        chosen = [part.only(part.view == view) for view, part in enumerate(each)]
        begin = np.cumsum([0, *(len(part) for part in chosen)])[:-1]
        columns = [
            np.concatenate([getattr(p, n) for p in chosen])
            for n in ("view", "joint", "xy", "confidence")
        ]
        pairs = np.concatenate([part.pairs + at for part, at in zip(chosen, begin, strict=True)])
        frames.append(
            type(chosen[0])(*columns, pairs, np.concatenate([part.affinity for part in chosen]))
        )
    return Recording(seen[0].skeleton, frames)


@pytest.fixture(scope="session")
def late_files(rig, late, tmp_path_factory) -> Path:
    """The folder of `late` and its cameras: rig.json, calibration.json and detection/."""
    folder = tmp_path_factory.mktemp("late")
    write_rig(rig, folder / "rig.json")
    write_association(late, rig, folder)
    return folder


@pytest.fixture(scope="session")
def detected_files(rig, late, tmp_path_factory) -> Path:
    """The folder that `detect` leaves of phones that were started and stopped by hand: detections
    under their own numbers, and times that say which frames each has.
    """
    folder = tmp_path_factory.mktemp("detected")
    shown = np.arange(300)[:, None] < [300, 250, 240, 220]
    own = Recording(
        BODY_25, [frame.only(has[frame.view]) for frame, has in zip(late, shown, strict=True)]
    )
    write_rig(rig, folder / "rig.json")
    write_association(own, rig, folder)
    time_s = np.repeat(np.arange(300)[:, None] / FPS, 4, axis=1)
    write_timestamps(folder / "detection" / "times.csv", rig.names, np.where(shown, time_s, np.nan))
    return folder


@pytest.fixture
def in_late_files(late_files, tmp_path, monkeypatch) -> None:
    """The working directory is a copy of `late_files`."""
    shutil.copytree(late_files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def in_detected_files(detected_files, tmp_path, monkeypatch) -> None:
    """The working directory is a copy of `detected_files`."""
    shutil.copytree(detected_files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)


COMMON = round((8.38 - 4.0) * FPS)
"""Frames in which all four run: the last began at 4 s, the first ended at 8.38 s."""
