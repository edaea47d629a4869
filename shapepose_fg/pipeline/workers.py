"""Worker processes: run one function on many items, here or in parallel, in order, with the same
result.

All use `concurrent.futures.Executor`: this process (`Here`), processes of this machine
(`Processes`, by loky, which needs no importable `__main__`), or those of a Dask cluster
(`pipeline/cluster.py`).
"""

import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from typing import Any, Generic, TypeVar

import cloudpickle

from shapepose_fg.core.compiling import cores, end_with
from shapepose_fg.core.errors import WorkLost

Shared = TypeVar("Shared")
Item = TypeVar("Item")
Result = TypeVar("Result")

_ENVIRONMENT = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
) | {"LOKY_MAX_MEMORY_LEAK_SIZE": "1e18"}
"""Environment of worker processes: one thread each for linear algebra; loky must not restart a
worker whose memory grows, because recordings differ in size."""


@dataclass(frozen=True)
class Pool(Generic[Shared]):
    """Runs one function on many items in an executor, each time with `shared`."""

    executor: Executor
    """The executor."""
    call: tuple[Any, ...]
    """A function and its first arguments; the last two arguments are the work and the item."""
    under_way: Callable[[], float]
    """Maximum number of submitted items: enough to keep all processes busy, few enough to bound
    memory."""

    def submit(self, work: Callable[[Shared, Item], Result], item: Item) -> Future[Result]:
        """Submit `work(shared, item)`; without further processes it is done on return."""
        with naming_lost_work():
            return self.executor.submit(*self.call, work, item)

    def map(
        self, work: Callable[[Shared, Item], Result], items: Iterable[Item]
    ) -> Iterator[Result]:
        """Yield `work(shared, item)` for each item, in order; `items` are consumed on demand.

        Raises `WorkLost` if a process dies.
        """
        waiting: deque[Future[Result]] = deque()
        with naming_lost_work():
            for item in items:
                waiting.append(self.submit(work, item))
                if len(waiting) >= self.under_way():
                    yield waiting.popleft().result()
            while len(waiting) > 0:
                yield waiting.popleft().result()


@contextmanager
def workers(count: int, shared: Shared, ahead: int = 2) -> Iterator[Pool[Shared]]:
    """Start `count` processes, each with `shared`; for a count of 1 the work is done in this
    process.

    They start when the block is entered and always end when it is left. `ahead` items per worker
    are submitted. Raises ValueError for a count below 1, and if `shared` cannot be sent to another
    process; functions and classes of a script or notebook can.
    """
    if count < 1:
        raise ValueError(f"workers must be 1 (no further process) or more, got {count}")
    if count == 1:
        yield Pool(Here(), (_call, shared), lambda: 1)
        return
    with Processes(count, _unpack_shared, packed(shared)) as executor:
        yield Pool(executor, (_with_shared,), lambda: ahead * count)


class Here(Executor):
    """An executor that does the work when it is submitted, in this process."""

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        """`fn(*args, **kwargs)`, done on return; its exceptions are raised here."""
        done: Future[Result] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class Processes(Executor):
    """An executor of further processes, which start at once, ignore Ctrl-C, and end with this
    process.
    """

    def __init__(self, count: int, initializer: Callable[..., object], *arguments: Any) -> None:
        """Each of `count` processes calls `initializer(*arguments)` first; it must be in an
        importable module.
        """
        from loky import ProcessPoolExecutor  # not imported by runs in one process

        given = (os.getpid(), initializer, *arguments)
        self._pool = ProcessPoolExecutor(
            count, initializer=_begin, initargs=given, env=_ENVIRONMENT
        )
        with _ctrl_c_blocked(), naming_lost_work():
            self._pool.submit(nothing)  # the first job starts all processes

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        """Submit `fn(*args, **kwargs)` to one of the processes."""
        return self._pool.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:
        """End the processes, including busy ones."""
        self._pool.shutdown(wait=wait, kill_workers=True)


@contextmanager
def naming_lost_work() -> Iterator[None]:
    """Raise `WorkLost` if a process ends in the block."""
    try:
        yield
    except BrokenProcessPool as error:
        raise WorkLost(
            "a worker process was killed, probably because there is too little memory for so "
            "many workers"
        ) from error


def packed(shared: object) -> bytes:
    """An object as bytes for other processes; raises ValueError if that is impossible."""
    try:
        return cloudpickle.dumps(shared)
    except Exception as error:  # of the user's own objects
        reason = " ".join(str(error).split())[:300]
        raise ValueError(
            f"this cannot be sent to worker processes ({type(error).__name__}: {reason}); leave "
            "out objects of this process, such as open files and locks, or use workers=1"
        ) from error


def suitable_workers(items: int, per_worker: int) -> int:
    """Number of workers for this many items: at most one per usable core, and one per `per_worker`
    items.
    """
    return max(1, min(cores(), items // per_worker))


@contextmanager
def _ctrl_c_blocked() -> Iterator[None]:
    """Processes started in the block ignore Ctrl-C, which a terminal sends to all: this process
    ends them.
    """
    # Python's helper process unblocks the signal when it starts, so it must be running already.
    resource_tracker.ensure_running()
    can_block = hasattr(signal, "pthread_sigmask")
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if can_block else set()
    try:
        yield
    finally:
        if can_block:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


_shared: Any = None
"""The shared data of a worker process, or the reason why it is missing."""


def _begin(parent: int, initializer: Callable[..., object], *arguments: Any) -> None:
    """Initialise a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with(parent)
    initializer(*arguments)


def _unpack_shared(content: bytes) -> None:
    """Unpack the shared data, which this program packed."""
    global _shared
    try:
        _shared = cloudpickle.loads(content)
    except Exception as error:
        _shared = error
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)


def _with_shared(work: Callable[[Any, Item], Result], item: Item) -> Result:
    """Process one item, in a worker."""
    if isinstance(_shared, Exception):
        raise _shared
    return work(_shared, item)


def _call(shared: Any, work: Callable[[Any, Item], Result], item: Item) -> Result:
    """Process one item, in this process."""
    return work(shared, item)


def nothing() -> None:
    """Do nothing: the first job of a process, which starts it, and the default initialiser."""
