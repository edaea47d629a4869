"""Shared fixtures: where the real recordings are, cameras around a room, and people seen without
error.
"""

import gc
import os
import pickle
import signal
import sys
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock
from numpy.typing import NDArray

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.smpl_file import SmplArrays
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25, Skeleton
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.mocap import Mocap

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell that starts the tests in the background has programs ignore Ctrl-C, which tests send.
    signal.signal(signal.SIGINT, signal.default_int_handler)


# Some tests import others from this folder, where `factors` is the folder of the library's tests:
# the project goes first, for processes that are begun by a test, too.
sys.path.insert(0, str(Path(__file__).parents[1]))

SEED = int(os.environ.get("SHAPEPOSE_TEST_SEED", "0"))
"""Another number here changes all that tests and the simulator draw: bounds must hold for each."""


def pytest_configure() -> None:
    """Let `SHAPEPOSE_TEST_SEED` change all that is drawn."""
    if SEED != 0:
        np.random.default_rng = _other_generator


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect no garbage while tests are collected, which takes half as long again, and leave what
    is loaded by then out of every later collection.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, Any]:
    """Let every other process of pytest-xdist read the test files from the last one back.

    What pytest makes of a file is kept: each file is done by one process, and the others find it.
    """
    report = yield
    if (
        isinstance(collector, pytest.Directory)
        and os.environ.get("PYTEST_XDIST_WORKER", "gw0")[-1] in "13579"
    ):
        report.result.reverse()
    return report


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Have tests in the same order in all processes, and files with slow tests first: the last
    files are short, and no process waits long for another.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow") is not None}
    items.sort(key=lambda item: (item.path not in slow, item.path))


def pytest_make_parametrize_id(val: object, argname: str) -> str | None:
    """Name contents of files by number: archives contain the time at which they were made, and
    processes with other names cannot share the tests.
    """
    return argname if isinstance(val, bytes) else None


_seeded = np.random.default_rng


def _other_generator(seed: object = None) -> np.random.Generator:
    """The generator of a seed together with `SEED`; what the program itself draws stays as it
    is.
    """
    caller = sys._getframe(1).f_globals.get("__name__", "")
    drawn = caller.startswith("shapepose_fg.simulation") or not caller.startswith(
        ("shapepose_fg", "factors")
    )
    if not drawn or not isinstance(seed, int | np.integer | list | tuple):
        return _seeded(seed)
    return _seeded([SEED, *np.atleast_1d(np.asarray(seed, dtype=np.uint64)).tolist()])


# A person who stands with the arms a little out: BODY_25, metres, x to their left, z up, facing -y.
STANDING = np.array(
    [
        [0, -0.1, 1.55], [0, 0, 1.42], [-0.18, 0, 1.40], [-0.35, 0, 1.15], [-0.45, -0.1, 0.95],
        [0.18, 0, 1.40], [0.35, 0, 1.15], [0.45, -0.1, 0.95], [0, 0, 0.92], [-0.1, 0, 0.92],
        [-0.11, -0.02, 0.5], [-0.12, 0.03, 0.08], [0.1, 0, 0.92], [0.11, -0.02, 0.5],
        [0.12, 0.03, 0.08], [-0.03, -0.09, 1.59], [0.03, -0.09, 1.59], [-0.07, 0, 1.57],
        [0.07, 0, 1.57], [0.14, -0.15, 0.02], [0.19, -0.12, 0.02], [0.12, 0.08, 0.03],
        [-0.14, -0.15, 0.02], [-0.19, -0.12, 0.02], [-0.12, 0.08, 0.03],
    ]
)  # fmt: skip


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings (`SHAPEPOSE_DATA`, else ../shared); skips where there is
    none.
    """
    root = Path(os.environ.get("SHAPEPOSE_DATA", Path(__file__).parents[2] / "shared"))
    if not (root / "data").is_dir():
        pytest.skip(
            f"no real recordings at {root}: set SHAPEPOSE_DATA to their folder to run this test"
        )
    return root / "data"


@pytest.fixture(scope="session")
def real_mocap(shared_data: Path) -> Mocap:
    """The recordings of CMU; skips where they are not."""
    path = shared_data / "cmu_mocap" / "cmu_smpl24.npz"
    if not path.is_file():
        pytest.skip(f"no recorded motions at {path}")
    return Mocap.load(path)


@pytest.fixture(scope="session")
def shared_cases(shared_data) -> Path:
    """The folder of files that other programs wrote, and of what people reported; skips where there
    is none.
    """
    cases = shared_data.parent / "cases"
    if not cases.is_dir():
        pytest.skip(f"no cases at {cases}")
    return cases


@dataclass(frozen=True)
class Dance:
    """Four people in close motion before six cameras, 1.6 s, and their reconstruction by
    default.
    """

    scene: Scene
    recording: Recording
    times: FrameTimes
    people: Reconstruction


@pytest.fixture(scope="session")
def dance(tmp_path_factory) -> Dance:
    """The reconstruction that tests share: pytest-xdist's first process makes it, the others read
    it.
    """
    scene = built_in_scene(seed=0, frames=40)
    recording, times = simulate(scene, seed=0), FrameTimes.from_fps(scene.fps, len(scene))
    folder = tmp_path_factory.getbasetemp()
    file = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "dance.pickle"
    with FileLock(f"{file}.lock"):
        if not file.exists():
            file.write_bytes(pickle.dumps(reconstruct(recording, scene.rig, times=times)))
        return Dance(scene, recording, times, pickle.loads(file.read_bytes()))


@pytest.fixture(scope="session")
def five_cameras() -> Rig:
    """Five cameras around the origin, 3 to 4 m away."""
    from shapepose_fg.simulation.scene import ring_of_cameras

    return ring_of_cameras(5, np.random.default_rng(0))


@pytest.fixture(scope="session")
def two_people() -> NDArray[np.float64]:
    """(2, 25, 3) two people 0.9 m apart, who face different ways."""
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return np.stack(
        [STANDING - np.array([0.45, 0.0, 0.0]), STANDING @ turn + np.array([0.45, 0.1, 0.0])]
    )


@pytest.fixture(scope="session")
def seen_exactly():
    """A function (rig, people (P, J, 3)) -> Detections: every joint in every view, affinities 0.9
    and 0.
    """
    return detect_exactly


def detect_exactly(
    rig: Rig, people: NDArray[np.float64], skeleton: Skeleton = BODY_25
) -> Detections:
    """Every joint of every person in every view where it is, confidence 0.8; candidates in random
    order.
    """
    xy, _ = rig.project(people)
    view, _, joint = (index.ravel() for index in np.indices(xy.shape[:3]))
    order = np.random.default_rng(0).permutation(len(view))
    place = np.argsort(order).reshape(xy.shape[:3])
    first, second = np.array(skeleton.limbs).T
    pairs = np.stack([place[:, :, first], place[:, :, second]], axis=-1).reshape(-1, 2)
    return Detections(
        view[order],
        joint[order],
        xy.reshape(-1, 2)[order],
        np.full(len(view), 0.8),
        pairs,
        np.full(len(pairs), 0.9),
    )


@pytest.fixture(scope="session")
def crowded(five_cameras, two_people) -> Detections:
    """Four people close to each other: 4 px of noise, a fifth missed, a false candidate for every
    third joint.
    """
    rng = np.random.default_rng(5)
    people = np.concatenate([two_people, two_people[::-1] + np.array([0.1, 0.5, 0.0])])
    xy, _ = five_cameras.project(people)
    view, person, joint = (index.ravel() for index in np.indices(xy.shape[:3]))
    xy = xy.reshape(-1, 2) + rng.normal(0, 4, (len(view), 2))
    seen = rng.random(len(view)) > 0.2
    false = rng.random(len(view)) < 1 / 3
    view, joint = (np.concatenate([each[seen], each[false]]) for each in (view, joint))
    person = np.concatenate([person[seen], np.full(false.sum(), -1)])
    xy = np.concatenate([xy[seen], xy[false] + rng.normal(0, 80, (false.sum(), 2))])
    order = rng.permutation(len(view))
    view, joint, person, xy = view[order], joint[order], person[order], xy[order]
    pairs, affinity = [], []
    for first, second in BODY_25.limbs:
        heads, tails = np.flatnonzero(joint == first), np.flatnonzero(joint == second)
        for head in heads:
            for tail in tails[view[tails] == view[head]]:
                own = person[head] == person[tail] >= 0
                if own or rng.random() < 0.3:
                    pairs.append((head, tail))
                    affinity.append(rng.uniform(0.3, 1.0) if own else rng.uniform(0.0, 0.5))
    confidence = np.where(
        person >= 0, rng.uniform(0.3, 1.0, len(view)), rng.uniform(0.1, 0.6, len(view))
    )
    return Detections(view, joint, xy, confidence, np.array(pairs), np.array(affinity))


def read_body() -> SmplArrays:
    """The arrays of the open body."""
    return BodyModel.default().arrays
