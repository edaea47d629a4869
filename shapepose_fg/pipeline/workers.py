"""Worker processes: the same work for many items, here or side by side, in order, with the same result."""

import os
import pickle
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing import forkserver, get_context, resource_tracker
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from shapepose_fg.core.errors import WorkLost

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext, SpawnContext

Shared = TypeVar("Shared")
Item = TypeVar("Item")
Result = TypeVar("Result")

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Workers(Generic[Shared]):
    """So many processes, each of which has `shared`; a count of 1 is none but this one.

    A context: the processes start when it is entered and end when it is left, whatever happens in between.
    """

    def __init__(self, count: int, shared: Shared, ahead: int = 2) -> None:
        """`ahead` items a worker are under way, so that none waits and memory stays bounded.

        ValueError for a count under 1, and for something shared that cannot be sent to another process.
        """
        if count < 1:
            raise ValueError(f"workers must be 1 (no further process) or more, got {count}")
        self.count, self._shared, self._ahead = count, shared, ahead
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> "Workers[Shared]":
        if self.count > 1:
            try:
                content = pickle.dumps(self._shared)
            except (pickle.PicklingError, AttributeError, TypeError) as error:
                raise ValueError(
                    f"this cannot be sent to worker processes ({error}): define functions and classes of your own"
                    " at the top of a module, or use workers=1"
                ) from error
            context = processes(type(self._shared).__module__)
            held, lifeline = context.Pipe(duplex=False)
            self._lifeline: Any = lifeline
            given: tuple[Any, ...] = (content, held)  # one end of a pipe, of one class or another by the system
            self._pool = ProcessPoolExecutor(self.count, context, initializer=_begin, initargs=given)
            with what_workers_inherit(), _telling_of_lost_ones():
                for _ in range(self.count):  # the pool starts a process for each of its first jobs
                    self._pool.submit(_nothing)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._pool is not None:
            if kind is not None:
                self._lifeline.close()  # what they are at is not wanted any more
            self._pool.shutdown(cancel_futures=True)
            self._lifeline.close()
            self._pool = None

    def submit(self, work: Callable[[Shared, Item], Result], item: Item) -> Future[Result]:
        """`work(shared, item)`, which is done on return where there are no further processes."""
        if self._pool is not None:
            with _telling_of_lost_ones():
                return self._pool.submit(_work, work, item)
        done: Future[Result] = Future()
        done.set_result(work(self._shared, item))
        return done

    def map(self, work: Callable[[Shared, Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """`work(shared, item)` for each item, in order; `items` are taken as they are needed.

        `WorkLost` where a process dies.
        """
        if self._pool is None:
            yield from (work(self._shared, item) for item in items)
            return
        pool: Any = self._pool
        with _telling_of_lost_ones():
            yield from in_order(partial(pool.submit, _work, work), items, lambda: self._ahead * self.count)


@contextmanager
def _telling_of_lost_ones() -> Iterator[None]:
    """`WorkLost` where a process dies in the block, or the one that processes are forked off."""
    try:
        yield
    except (BrokenProcessPool, EOFError, ConnectionError) as error:
        raise WorkLost(
            "a worker process was killed, as the system does where there is too little memory for so many (in a"
            " script, call what takes `workers` below `if __name__ == '__main__':`)"
        ) from error


def in_order(
    submit: Callable[[Item], Future[Result]],
    items: Iterable[Item],
    most: Callable[[], float],
    forget: Callable[[list[Future[Result]]], object] | None = None,
) -> Iterator[Result]:
    """What comes of each item, in order; of those that were submitted `most` are under way at a time.

    `forget` is given those that are not wanted any more. A pool of processes ends them by itself: to cancel them
    while its processes end stops the thread that waits for these, and then the program waits for ever.
    """
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(submit(item))
            if len(waiting) >= most():
                yield waiting.popleft().result()
        while len(waiting) > 0:
            yield waiting.popleft().result()
    finally:
        if forget is not None:
            forget(list(waiting))


def processes(*modules: str) -> "SpawnContext | ForkServerContext":
    """How further processes of this program start.

    On Linux each is forked off a process that has imported `modules` and done nothing else, so that loading takes
    its seconds and its memory once; what was asked for first counts, as long as this process lives. Elsewhere,
    where forks of loaded libraries are not safe, each imports what it needs.
    """
    if sys.platform != "linux":
        return get_context("spawn")
    context = get_context("forkserver")
    context.set_forkserver_preload(list(modules))
    return context


def get_ready(*modules: str) -> None:
    """Have `modules` imported where `processes` start, while this one does something else."""
    if processes(*modules).get_start_method() == "forkserver":
        with what_workers_inherit():
            forkserver.ensure_running()


def suitable_workers(items: int, worth: int) -> int:
    """One for each core that this process may use, but no more than pay: `worth` items each."""
    return max(1, min(cores(), items // worth))


def cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def what_workers_inherit() -> Iterator[None]:
    """Processes that start now have one thread each for linear algebra, and ignore Ctrl-C.

    The terminal sends it to all of them; it is this process that ends them.
    """
    before = {name: os.environ[name] for name in _ONE_THREAD if name in os.environ}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    can_block = hasattr(signal, "pthread_sigmask")
    # Python's own helper of spawned processes lets the signal through again when it starts: it has to run by then.
    resource_tracker.ensure_running()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if can_block else set()
    try:
        yield
    finally:
        for name in _ONE_THREAD:
            del os.environ[name]
        os.environ.update(before)
        if can_block:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


_shared: Any = None
"""In a worker process: what all its work shares."""


def _begin(content: bytes, lifeline: Any) -> None:
    """What a worker does first."""
    global _shared
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with, args=(lifeline,), daemon=True).start()
    _shared = pickle.loads(content)  # made by this program a moment ago
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)


def end_with(lifeline: Any) -> None:
    """End this process, whatever it is at, when the one that started it lets go of the other end, or is killed.

    A pipe and no event: a process that is killed while it waits for an event keeps the lock for ever.
    """
    try:
        lifeline.recv_bytes()
    except (EOFError, OSError):
        os._exit(1)


def _work(work: Callable[[Any, Item], Result], item: Item) -> Result:
    """One item, in a worker."""
    return work(_shared, item)


def _nothing() -> None:
    """The job that starts a worker."""
