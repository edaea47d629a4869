"""Compiles kernels in several processes, and logs that it does."""

import gc
import logging
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from importlib import import_module
from threading import Thread, Timer
from typing import Any

from shapepose_fg.core.kept_kernels import kept_folder, wanted_folder

_BYTES_S = 540
"""Bytes of Python bytecode of kernels that an average machine compiles in a second, with the parts
that they call."""

_spent_s = 0.0
"""Time that `compile_beside` took in this process, s."""

_tried = False
"""Whether this process has compiled the missing kernels once; other missing kernels are compiled
when they are called."""


def compile_beside(kernels: Sequence[Any]) -> None:
    """Compile those of the kernels that are not cached, in as many processes as there are cores;
    once per process.

    If another process is compiling, waits for it.
    """
    global _tried, _spent_s
    if _tried:
        return
    _tried, start = True, time.monotonic()
    place = kept_folder()
    with _alone():
        missing = [each for each in kernels if not each.is_kept]
        lasts_s = _work(missing) / _BYTES_S
        # Compile time below which kernels are compiled in this process, s: starting a
        # process takes a second.
        # Maximum number of processes: the longest kernel takes an eighth of the total
        # time, so more processes give no speed-up.
        count = min(cores(), 8, len(missing)) if lasts_s > 3.0 and place is not None else 1
        what = (
            f"compiling {len(missing)} function{'s' * (len(missing) > 1)} for this machine, which"
            f" takes about {max(lasts_s / count, 1):.0f} s"
        )
        if place != wanted_folder():
            cure = "set NUMBA_CACHE_DIR to a writable folder"
            what += f" at each start, because {wanted_folder()} cannot be written; {cure}"
        with saying(what):
            if count > 1:
                _share_out(missing, count)
            else:
                for each in missing:
                    each.load()
    _spent_s = time.monotonic() - start


def compiled_for_s() -> float:
    """Time that this process has spent on compiling, seconds."""
    return _spent_s


def _share_out(kernels: Sequence[Any], count: int) -> None:
    """Compile with `count` processes. Each repeatedly takes the largest remaining group: the
    kernels of a module, which share parts, or a single kernel of a large module.
    """
    modules: dict[str, list[Any]] = {}
    for each in kernels:
        modules.setdefault(each.py_func.__module__, []).append(each)
    bound = _work(kernels) / (2 * count)
    groups = [
        p for m in modules.values() for p in ([m] if _work(m) < bound else [[each] for each in m])
    ]
    groups.sort(key=_work, reverse=True)
    from loky import ProcessPoolExecutor  # its import takes time that other runs need not spend

    pool = ProcessPoolExecutor(count, initializer=_begin, initargs=(os.getpid(),))
    try:
        waiting = [pool.submit(_load, [each.name for each in group]) for group in groups]
        for each in waiting:
            each.result()
    except (OSError, BrokenProcessPool) as error:  # kernels are compiled when they are called
        logging.getLogger(__name__).debug("%r", error)
    finally:
        pool.shutdown(kill_workers=True)


def end_with(parent: int) -> None:
    """End this process, even if busy, when its parent has ended or was killed."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    Thread(target=watch, daemon=True).start()


def _begin(parent: int) -> None:
    """Initialise a process of `compile_beside`, which compiles kernels and prints nothing."""
    global _tried
    _tried = True
    end_with(parent)
    gc.disable()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)


def _load(names: Sequence[str]) -> None:
    """Compile kernels, by `module:name`."""
    for module, _, function in (name.partition(":") for name in names):
        getattr(import_module(module), function).load()


@contextmanager
def saying(what: str) -> Iterator[None]:
    """Log `what` if the block takes more than a second; as a warning, which Python prints even if
    logging is not configured.
    """
    timer = Timer(1.0, logging.getLogger(__name__).warning, [what])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def _alone() -> Iterator[None]:
    """Wait until no other process is compiling."""
    from filelock import FileLock

    place = kept_folder()
    lock = None if place is None else FileLock(place / "compiling.lock")
    waiting = saying("waiting for another process that compiles the functions for this machine")
    with (
        waiting,
        suppress(OSError, NotImplementedError),
    ):  # some file systems have no locks, or are full
        if lock is not None:
            lock.acquire()
    try:
        yield
    finally:
        if lock is not None:
            lock.release()


def _work(kernels: Sequence[Any]) -> int:
    """A measure of the time that kernels take to compile: bytes of their own bytecode."""
    return sum(len(each.py_func.__code__.co_code) for each in kernels)


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
