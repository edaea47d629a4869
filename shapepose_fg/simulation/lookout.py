"""What cameras see of many frames: found here or in worker processes, in order, with the same result."""

import os
import signal
import threading
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context, parent_process

import cv2
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.camera import Rig
from shapepose_fg.simulation.visibility import Skin, Visibility, VisibilityConfig, see

People = tuple[NDArray[np.float64], NDArray[np.float32]]
"""One frame: BODY_25 joints (P, 25, 3) and surfaces (P, M, 3) of everybody, metres."""

_AHEAD = 4
"""Frames a worker that are under way: enough that none waits, and memory stays bounded."""
_FRAMES_WORTH_A_WORKER = 100
"""A recording must have this many for each worker, or starting them takes longer than it saves."""
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Lookout:
    """Who looks: the same for all frames of a recording."""

    rig: Rig
    """The cameras."""
    skin: Skin
    """The surface that is drawn."""
    config: VisibilityConfig
    """How it is drawn and read."""

    def look(self, people: People) -> Visibility:
        """What the cameras see of one frame."""
        joints, surfaces = people
        return see(self.rig, joints, surfaces, self.skin, self.config)

    def watch(self, frames: Iterable[People], workers: int = 1) -> Generator[Visibility, None, None]:
        """What the cameras see, frame after frame; in `workers` processes, or here if that is 1.

        Frames are taken from `frames` as they are needed. Close the iterator (`contextlib.closing`) to end the
        processes early. RuntimeError where one of them dies.
        """
        if workers < 1:
            raise ValueError(f"workers must be 1 (no further process) or more, got {workers}")
        if workers == 1:
            yield from map(self.look, frames)
            return
        pool = ProcessPoolExecutor(workers, get_context("spawn"), initializer=_begin, initargs=(self,))
        try:
            yield from _in_order(pool, frames, workers)
        except BrokenProcessPool as error:
            raise RuntimeError(
                "a worker process ended before its work: there may be too little memory for so many; in a script,"
                " call simulate(..., workers=...) below `if __name__ == '__main__':`"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


def suitable_workers(frames: int) -> int:
    """One for each core that this process may use, but not more than pay for recordings of `frames` frames."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, frames // _FRAMES_WORTH_A_WORKER))


def _in_order(pool: ProcessPoolExecutor, frames: Iterable[People], workers: int) -> Iterator[Visibility]:
    """Results in the order of `frames`, some of which are always under way."""
    with _what_workers_inherit():
        for _ in range(workers):  # the pool starts a process for each of its first jobs
            pool.submit(_nothing)
    waiting: deque[Future[Visibility]] = deque()
    for people in frames:
        waiting.append(pool.submit(_look, people))
        if len(waiting) >= _AHEAD * workers:
            yield waiting.popleft().result()
    while len(waiting) > 0:
        yield waiting.popleft().result()


@contextmanager
def _what_workers_inherit() -> Iterator[None]:
    """Processes that start now have one thread each for linear algebra, and are deaf to ctrl-C.

    The terminal sends it to all of them; it is this process that ends them.
    """
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    can_block = hasattr(signal, "pthread_sigmask")
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if can_block else set()
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        if can_block:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


_lookout: Lookout | None = None
"""In a worker process: who looks."""


def _begin(lookout: Lookout) -> None:
    """What a worker does first."""
    global _lookout
    _lookout = lookout
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when the one that started it has been killed: nobody else would."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _look(people: People) -> Visibility:
    """One frame, in a worker."""
    if _lookout is None:
        raise RuntimeError("_begin is to be called first")
    return _lookout.look(people)


def _nothing() -> None:
    """The job that starts a worker."""
