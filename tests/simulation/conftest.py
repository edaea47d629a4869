"""Recorded motions for the tests: the real file where it is, and a tiny one of the same format."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.simulation.mocap import Mocap

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
LEG_M = 0.8


@pytest.fixture(scope="session")
def tiny_arrays() -> dict[str, NDArray]:
    """Two pairs who hold hands and sway (takes 1 and 9), one who walks 3.4 m, one who stands and
    waves.
    """
    clips = [
        ("60_01", "60", "salsa dance", *dancer(90, 0.0)),
        ("61_01", "61", "salsa dance", *dancer(90, np.pi)),
        ("60_09#1", "60", "salsa dance", *dancer(75, 0.0)),
        ("61_09#1", "61", "salsa dance", *dancer(75, np.pi)),
        ("05_01", "05", "walk", *walker(80)),
        ("u_traffic", "?", "directing traffic", *waver(100)),
    ]
    names, subjects, actions, poses, places = zip(*clips, strict=True)
    lengths = np.array([len(pose) for pose in poses])
    flags = np.ones(len(clips), dtype=bool)
    return {
        "poses": np.concatenate(poses).astype(np.float16),
        "trans": np.concatenate(places).astype(np.float32),
        "seq_start": np.concatenate([[0], np.cumsum(lengths)[:-1]]),
        "seq_len": lengths,
        "fps": np.full(len(clips), 30.0, dtype=np.float32),
        "names": np.array(names),
        "subject": np.array(subjects),
        "action": np.array(actions),
        "tier": np.array([1, 1, 1, 1, 0, 0], dtype=np.int8),
        "wrist_valid": flags & [False, False, False, False, True, True],
        "toe_valid": flags & [False, False, False, False, True, True],
        "leg_m": np.full(len(clips), LEG_M, dtype=np.float32),
        "floor_y": np.full(len(clips), 0.02, dtype=np.float32),
        "pairs": np.array([[0, 1], [2, 3]]),
        "parents": np.array(PARENTS),
        "joint_names": np.array(SMPL_24),
    }


@pytest.fixture(scope="session")
def tiny_mocap_file(
    tiny_arrays: dict[str, NDArray], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The tiny file."""
    path = tmp_path_factory.mktemp("mocap") / "tiny.npz"
    np.savez(path, **tiny_arrays)
    return path


@pytest.fixture(scope="session")
def tiny_mocap(tiny_mocap_file: Path) -> Mocap:
    """The tiny file, read."""
    return Mocap.load(tiny_mocap_file)


def standing(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Arms hang, knees are straight, the pelvis is a leg above the ankles (which are 8 cm high)."""
    poses, places = np.zeros((count, 24, 3)), np.zeros((count, 3))
    poses[:, 16, 2], poses[:, 17, 2] = -1.3, 1.3
    places[:, 1] = LEG_M + 0.08 + 0.09 + 0.02
    return poses, places


def dancer(count: int, facing: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """One of two who face each other 0.5 m apart, sway together, both arms forward and up and
    down.
    """
    poses, places = standing(count)
    time = np.arange(count) / 30.0
    poses[:, 0, 1] = facing
    # Arms forward (about y, after which the T-pose's arm points at +z), and up and down from there.
    lift = 0.5 * np.sin(2 * np.pi * time / 2.0)
    poses[:, 16, 1], poses[:, 17, 1] = -1.5, 1.5
    poses[:, 16, 2] = poses[:, 17, 2] = 0.0
    poses[:, 18, 1], poses[:, 19, 1] = -0.5 - 0.3 * lift, 0.5 + 0.3 * lift
    places[:, 2] = -0.25 * np.cos(facing)
    places[:, 0] = 0.3 * np.sin(2 * np.pi * time / 3.0)
    return poses, places


def walker(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Walks along +z at 1.3 m/s, legs and arms in turn, a double step a second."""
    poses, places = standing(count)
    phase = 2 * np.pi * np.arange(count) / 30.0
    for hip, knee, sign in ((1, 4, 1.0), (2, 5, -1.0)):
        poses[:, hip, 0] = -0.4 * sign * np.sin(phase) - 0.1
        poses[:, knee, 0] = 0.35 - 0.3 * sign * np.cos(phase)
    places[:, 2] = 1.3 * np.arange(count) / 30.0
    places[:, 1] -= 0.04
    return poses, places


def waver(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Stands; the right arm goes from hanging to overhead and back."""
    poses, places = standing(count)
    poses[:, 17, 2] = 1.3 - 1.35 * (1 - np.cos(2 * np.pi * np.arange(count) / count))
    return poses, places
