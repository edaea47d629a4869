"""Worker processes that find what is visible: same bytes, in order, a bounded way ahead, none left
behind.
"""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.simulation import DetectorConfig, Scene, built_in_scene, simulate
from shapepose_fg.simulation.visibility import (
    AHEAD,
    FramePeople,
    OccludingSurface,
    VisibilityWorker,
)

CONFIG = DetectorConfig().visibility


@pytest.fixture(scope="module")
def scene() -> Scene:
    return built_in_scene(0, people=3, cameras=3, frames=9)


@pytest.fixture(scope="module")
def worker(scene: Scene) -> VisibilityWorker:
    return VisibilityWorker(scene.rig, OccludingSurface.of(scene.body, CONFIG.cell_m), CONFIG)


@pytest.fixture(scope="module")
def people(scene: Scene, worker: VisibilityWorker) -> list[FramePeople]:
    return [
        (scene.truth_at(frame), scene.vertices_at(frame, worker.skin.vertices))
        for frame in range(9)
    ]


def same_bytes(one: object, two: object) -> bool:
    return all(value.tobytes() == vars(two)[name].tobytes() for name, value in vars(one).items())


@pytest.mark.slow
def test_workers_and_the_choice_of_frames_change_no_byte(scene: Scene):
    told: list[tuple[int, int]] = []
    alone = simulate(scene, seed=2)
    helped = simulate(scene, seed=2, workers=2, progress=lambda *done: told.append(done))
    some = simulate(scene, seed=2, frames=[1, 4, 5, 8], workers=3)
    assert len(alone) == len(helped) == 9 and told == [(done, 9) for done in range(1, 10)]
    assert all(same_bytes(one, two) for one, two in zip(alone, helped, strict=True))
    assert all(
        same_bytes(alone[frame], found) for frame, found in zip([1, 4, 5, 8], some, strict=True)
    )
    assert not same_bytes(alone[0], alone[1])  # or the comparison would say nothing


@pytest.mark.slow
def test_scenes_with_nobody_and_without_frames_need_no_special_care():
    empty = built_in_scene(0, people=0, cameras=2, frames=2)
    alone, helped = simulate(empty), simulate(empty, workers=2)
    assert all(same_bytes(one, two) for one, two in zip(alone, helped, strict=True))
    assert len(simulate(built_in_scene(0, people=2, cameras=2, frames=0), workers=2)) == 0


@pytest.mark.slow
def test_frames_are_taken_as_they_are_needed_and_closing_ends_the_processes(
    worker: VisibilityWorker, people: list[FramePeople]
):
    taken = []

    def endless():
        while True:
            taken.append(len(taken))
            yield people[len(taken) % 9]

    with closing(worker.all(endless(), 2)) as seen:
        first, second = next(seen), next(seen)
        assert len(multiprocessing.active_children()) == 2
        assert same_bytes(first, worker.one(people[1])) and same_bytes(
            second, worker.one(people[2])
        )
        assert len(taken) == 2 * AHEAD + 1
    assert multiprocessing.active_children() == []


@pytest.mark.slow
def test_an_error_in_a_worker_is_raised_here(worker: VisibilityWorker, people: list[FramePeople]):
    joints, surfaces = people[0]
    with pytest.raises(ValueError), closing(worker.all([(joints[:, :, :2], surfaces)], 2)) as seen:
        next(seen)
    assert multiprocessing.active_children() == []


@pytest.mark.slow
def test_a_worker_that_dies_is_no_endless_wait(worker: VisibilityWorker, people: list[FramePeople]):
    with closing(worker.all(people * 9, 2)) as seen:
        next(seen)
        os.kill(multiprocessing.active_children()[0].pid or 0, signal.SIGKILL)
        with pytest.raises(RuntimeError, match="worker process was killed"):
            list(seen)


@pytest.mark.parametrize("workers", [0, -1])
def test_no_workers_are_refused(worker: VisibilityWorker, scene: Scene, workers: int):
    with pytest.raises(ValueError, match="workers must be 1"):
        list(worker.all([], workers))
    with pytest.raises(ValueError, match="workers must be 1"):
        simulate(scene, workers=workers)


INTERRUPTED = """
from contextlib import contextmanager
import multiprocessing, signal, sys
from shapepose_fg.cli import main, simulate

signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever runs the tests may ignore it
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})

@contextmanager
def tell(what):
    def tell(done, total):
        print(done, *(child.pid for child in multiprocessing.active_children()), flush=True)
    yield tell

simulate.progress_bar = tell
main.main(["simulate", "demo", "--people", "2", "--cameras", "2", "--frames", ":2000",
           "--workers", "2",
          "--output", sys.argv[1]])
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="asks Linux which processes run")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_ctrl_c_and_the_end_of_the_parent_end_everybody(how: signal.Signals, tmp_path: Path):
    run = subprocess.Popen([sys.executable, "-c", INTERRUPTED, str(tmp_path)],
                           stdout=subprocess.PIPE,
                           stderr=subprocess.PIPE, text=True, start_new_session=True)  # fmt: skip
    assert run.stdout is not None
    children = [int(word) for word in run.stdout.readline().split()[1:]]
    assert len(children) == 2
    if how == signal.SIGINT:
        os.killpg(run.pid, how)  # to all of them, as a terminal does
    else:
        run.kill()
    _, complaint = run.communicate(timeout=120)  # a guard against hanging, not a measure
    if how == signal.SIGINT:  # a killed parent's semaphores are cleaned up by Python, which says so
        assert run.returncode == 130 and complaint == "stopped: no incomplete files are left\n"
    assert not (tmp_path / "detection").exists()
    patience = time.monotonic() + 60
    while any(alive(child) for child in children) and time.monotonic() < patience:
        time.sleep(0.05)
    assert not any(alive(child) for child in children)


def alive(process: int) -> bool:
    """Whether a process runs; one that has ended and that nobody has fetched yet does not."""
    try:
        os.kill(process, 0)
        state = Path(f"/proc/{process}/stat").read_text(encoding="utf-8")
    except (ProcessLookupError, FileNotFoundError):
        return False
    return state.rsplit(")", 1)[1].split()[0] != "Z"


def test_a_worker_uses_the_settings_that_it_is_given(
    worker: VisibilityWorker, people: list[FramePeople]
):
    strict = VisibilityWorker(worker.rig, worker.skin, replace(CONFIG, probe_m=0.0))
    (rays,), (ray,) = worker.all(people[:1]), strict.all(people[:1])
    assert set(np.unique(ray.seen)) <= {0.0, 1.0}  # one ray arrives or not
    assert len(np.unique(rays.seen)) > 2
