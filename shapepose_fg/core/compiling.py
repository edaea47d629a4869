"""Compiles kernels in several processes, and logs that it does."""

import gc
import logging
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from threading import Timer
from typing import Any

from shapepose_fg.core.kept_kernels import kept_folder, wanted_folder

_BYTES_S = 1300
"""Bytes of Python bytecode that an average machine compiles in a second."""

_tried = False
"""Whether this process has compiled the missing kernels; kernels that are missing later are
compiled when they are called."""


def compile_beside(kernels: Sequence[Any]) -> None:
    """Compile those of the kernels that are not cached, in as many processes as there are cores;
    once per process.

    If another process is compiling, waits for it.
    """
    global _tried
    if _tried:
        return
    _tried = True
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
            f"compiling {len(missing)} functions for this machine, which takes about"
            f" {max(lasts_s / count, 1):.0f} s"
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
    words = [",".join(each.name for each in group) for group in groups]
    # The same packages as in this process, whatever is in the working directory.
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(each or str(Path.cwd()) for each in sys.path)
    }
    command = [sys.executable, "-P", "-c", f"from {__name__} import main; main()", *words]
    started = list[subprocess.Popen[Any]]()
    numbers, to = os.pipe()  # pipe of group numbers, two bytes each, from which all processes read
    try:
        os.write(to, b"".join(n.to_bytes(2) for n in range(len(groups))))
        os.close(to)
        for _ in range(count):
            quiet: Any = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL)
            started.append(subprocess.Popen(command, env=environment, stdin=numbers, **quiet))
        for each in started:
            each.wait()
    except OSError as error:  # without processes, kernels are compiled when they are called
        logging.getLogger(__name__).debug("%r", error)
    finally:
        os.close(numbers)
        for each in started:
            each.kill()
            each.wait()


def main() -> None:
    """Entry point of a process of `compile_beside`: the command line names groups of kernels, and
    standard input has the numbers of the groups that this process compiles.
    """
    global _tried
    _tried = True
    gc.disable()
    while number := os.read(0, 2):
        for name in sys.argv[1 + int.from_bytes(number)].split(","):
            module, _, function = name.partition(":")
            getattr(import_module(module), function).load()


@contextmanager
def saying(what: str) -> Iterator[None]:
    """Log `what` if the block takes more than a second; as a warning, which Python prints even if
    logging is not configured.
    """
    timer = Timer(1.0, logging.getLogger(__name__).warning, [what])
    timer.daemon = True
    if what:
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
    """Bytes of bytecode of the kernels and all that they call: a measure of the compile time."""
    return sum(len(each.__code__.co_code) for kernel in kernels for each in _pieces(kernel.py_func))


def _pieces(function: Any) -> set[Any]:
    """A function and all kernels and parts that it calls, directly or indirectly."""
    known, waiting = {function}, [function]
    while waiting:
        one = waiting.pop()
        called = (
            getattr(one.__globals__.get(name), "py_func", None) for name in one.__code__.co_names
        )
        waiting += (new := [each for each in called if each is not None and each not in known])
        known.update(new)
    return known


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
