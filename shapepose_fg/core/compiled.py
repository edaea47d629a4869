"""Functions over rows, joints and frames, compiled by Numba: once for a machine, then read from its cache.

A kernel takes whole arrays of the types that it names (C-contiguous; for others it is compiled anew) and writes
into arrays that it is given, so that Python is entered once for many rows. Kernels and parts of any file may call
each other; what else a kernel has from another file, a number say, must not change (or changes its name).
"""

import gc
import hashlib
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from threading import Lock, Thread
from typing import Any, TypeVar, cast

import numba
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, InTreeCacheLocator, UserWideCacheLocator
from numba.core.dispatcher import Dispatcher
from numba.core.runtime.nrt import rtsys
from numba.misc.appdirs import AppDirs

F = TypeVar("F", bound=Callable[..., Any])


_OPTIONS = {"error_model": "numpy", "nogil": True, "fastmath": {"contract", "reassoc"}, "no_cfunc_wrapper": True}
_NUMBERS = {"f": numba.float64, "i": numba.intp, "b": numba.boolean}
_NUMBERS |= {"s": numba.float32, "w": numba.int32, "u": numba.uint8}

KERNELS: dict[str, Any] = {}
"""All kernels of what is imported, by `module.name`."""


def kernel(*kinds: str | type) -> Callable[[F], F]:
    """The function, compiled for arguments of these `kinds`. Sums may be taken in another order, NaN and infinity
    are kept.

    A letter is the type of numbers (f float64, i intp, b bool, s float32, w int32, u uint8) and a digit how many
    axes the array has, 0 for a number: "f2 i1 f0". A NamedTuple class has `kinds` of its own.
    """

    def compiled(function: F) -> F:
        made = cast(Any, numba.njit)(**_OPTIONS)(function)
        made._cache = _Cache(function)  # what `cache=True` does, with Numba's own class
        made.kinds = kinds
        KERNELS[f"{function.__module__}.{function.__qualname__}"] = made
        return cast(F, made)

    return compiled


def part(function: F) -> F:
    """A piece of kernels, which Python cannot call: compiled with them, sooner than a kernel is."""
    return cast(F, cast(Any, numba.njit)(no_cpython_wrapper=True, forceinline=True, **_OPTIONS)(function))


def signature(kernel: Any) -> tuple[Any, ...]:
    """The types of a kernel's arguments, as Numba has them."""

    def types(kinds: Sequence[str | type]) -> tuple[Any, ...]:
        return tuple(
            one for each in kinds for one in (map(number, each.split()) if isinstance(each, str) else named(each))
        )

    def named(of: Any) -> tuple[Any, ...]:
        return (numba.types.NamedTuple(types([of.kinds]), of),)

    def number(kind: str) -> Any:
        of, axes = _NUMBERS[kind[0]], int(kind[1:])
        return numba.types.Array(of, axes, "C") if axes > 0 else of

    return types(kernel.kinds)


def is_kept(kernel: Any) -> bool:
    """Whether a kernel is compiled, for what it is meant to be given."""
    return kernel._cache.keeps(signature(kernel), kernel.targetctx.codegen())


class _Shared(UserWideCacheLocator):
    """A user's folder for all installations and checkouts: what is in files decides, not where they are."""

    def __init__(self, py_func: Any, py_file: str):
        super().__init__(py_func, py_file)
        folder = os.environ.get("NUMBA_CACHE_DIR") or AppDirs("shapepose-fg", appauthor=False).user_cache_dir
        self._module, self._cache_path = py_func.__module__, str(Path(folder) / "kernels")

    def get_source_stamp(self) -> str:
        """None: `_Cache` has the files in its keys."""
        return ""

    def get_disambiguator(self) -> str:
        """Numba names a file by the last part of the module."""
        return self._module


class _Place(CompileResultCacheImpl):
    """Where compiled kernels are kept: beside the bytecode if the user has no folder for such things."""

    _locator_classes = (_Shared, InTreeCacheLocator)


class _Cache(FunctionCache):
    """Numba compiles a function anew when its own file has changed; here also when one has that it calls into.

    What is compiled is loaded without what only compiling needs, which takes a fifth of a second. What is not sets
    off that all kernels which are not are compiled, side by side.
    """

    _impl_class = _Place

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)  # for kernels that make arrays
        found = self._load(sig, target_context)
        if found is None:
            _compile_kernels()
            found = self._load(sig, target_context)
        return found

    def keeps(self, sig: Any, codegen: Any) -> bool:
        """Whether it is compiled for such arguments."""
        return self._index_key(sig, codegen) in self._cache_file._load_index()

    def _load(self, sig: Any, target_context: Any) -> Any:
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return (*super()._index_key(sig, codegen), *(_digest(path) for path in sorted(files(self._py_func))))


def files(function: Any) -> set[str]:
    """The files of all kernels and parts that a function calls, or these do, its own and this one."""
    return {__file__, *(each.__code__.co_filename for each in pieces(function))}


def pieces(function: Any) -> set[Any]:
    """A function and all kernels and parts that it calls, or these do."""
    known, waiting = {function}, [function]
    while waiting:
        one = waiting.pop()
        for other in map(one.__globals__.get, one.__code__.co_names):
            if isinstance(other, Dispatcher) and other.py_func not in known:
                known.add(other.py_func)
                waiting.append(other.py_func)
    return known


@cache
def _digest(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


class _Compiling(event.Listener):
    """Nothing is collected while Numba compiles: it would take another tenth."""

    def __init__(self) -> None:
        self._collects = list[bool]()

    def on_start(self, event: Any) -> None:
        self._collects.append(gc.isenabled())
        gc.disable()

    def on_end(self, event: Any) -> None:
        if self._collects.pop():
            gc.enable()


event.register("numba:compile", _Compiling())


_BYTES_S = 3000
"""So much of Python's code is compiled in a second, on a machine that is neither fast nor slow."""
_WORTH_S = 3.0
"""Less than this is compiled here, one after the other: a process takes a second to start."""
_MOST = 8
"""Processes: the longest kernel takes an eighth of all."""

_once = Lock()
"""Held from the first call on: what is missing then is compiled where it is called."""


def _compile_kernels() -> None:
    """Have the kernels of all modules that are imported compiled, once a process; who comes second waits."""
    if not _once.acquire(blocking=False):
        return
    from filelock import FileLock

    cache = Path(next(iter(KERNELS.values()))._cache.cache_path)
    cache.mkdir(parents=True, exist_ok=True)
    with FileLock(cache / "compiling.lock"):
        missing = {name: each for name, each in KERNELS.items() if not is_kept(each)}
        if len(missing) == 0:
            return
        lasts_s = sum(map(_work, missing.values())) / _BYTES_S
        count = min(_cores(), _MOST, len(missing)) if lasts_s > _WORTH_S else 1
        told = f"compiling {len(missing)} functions for this machine, once: about {max(lasts_s / count, 1):.0f} s"
        logging.getLogger(__name__).info(told)
        if count > 1:
            waiting = _Waiting(missing)
            threads = [Thread(target=_feed, args=(waiting,)) for _ in range(count)]
            for each in threads:
                each.start()
            for each in threads:
                each.join()


class _Waiting:
    """Kernels that wait to be compiled, those first that take longest."""

    def __init__(self, kernels: dict[str, Any]) -> None:
        self._work = {name: _work(each) for name, each in kernels.items()}
        self._lock = Lock()

    def next(self, last: str) -> str | None:
        """One of the module of the `last`, whose parts are compiled there; else of the module with most to do."""
        with self._lock:
            if len(self._work) == 0:
                return None
            left = dict.fromkeys(map(_module, self._work), 0)
            for name, work in self._work.items():
                left[_module(name)] += work
            module = _module(last) if _module(last) in left else max(left, key=left.__getitem__)
            name = max((name for name in self._work if _module(name) == module), key=self._work.__getitem__)
            del self._work[name]
            return name


def _feed(waiting: _Waiting) -> None:
    """Let a process compile what waits, until nothing does. What it leaves is compiled where it is called."""
    with _compiler() as process:
        name = waiting.next("")
        while name is not None:
            try:
                print(name, file=process.stdin, flush=True)
            except BrokenPipeError:
                return
            if process.stdout.readline() == "":
                return
            name = waiting.next(name)


@contextmanager
def _compiler() -> Iterator[Any]:
    """A process that compiles the kernels that it is told of, line by line, and says when one is done."""
    program = "import sys; from shapepose_fg.core.compiled import main; main()"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    process: Any = subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=environment,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def main() -> None:
    """What such a process does (`_compiler`)."""
    _once.acquire()
    for line in sys.stdin:
        module, _, name = line.strip().rpartition(".")
        kernel = getattr(import_module(module), name)
        kernel.compile(signature(kernel))
        print("done", flush=True)


def _work(kernel: Any) -> int:
    """How long compiling takes, in bytes of Python's code."""
    return sum(len(each.__code__.co_code) for each in pieces(kernel.py_func))


def _module(kernel: str) -> str:
    return kernel.rpartition(".")[0]


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
