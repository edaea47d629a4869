"""Functions over rows, joints and frames, compiled by Numba: once for a machine, then read from its cache.

A kernel takes whole arrays (C-contiguous, float64, intp or bool: every other type is compiled anew) and writes
into arrays that it is given, so that Python is entered once for many rows. Kernels and parts of any file may call
each other; what else a kernel has from another file, a number say, must not change (or changes its name).
"""

import gc
import hashlib
import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher
from numba.core.runtime.nrt import rtsys

F = TypeVar("F", bound=Callable[..., Any])


_OPTIONS = {"error_model": "numpy", "nogil": True, "fastmath": {"contract", "reassoc"}, "no_cfunc_wrapper": True}


def kernel(function: F) -> F:
    """The function, compiled at its first call. Sums may be taken in another order, NaN and infinity are kept."""
    compiled = cast(Any, numba.njit)(**_OPTIONS)(function)
    compiled._cache = _Cache(function)  # what `cache=True` does, with Numba's own class
    return cast(F, compiled)


def part(function: F) -> F:
    """A piece of kernels, which Python cannot call: compiled with them, sooner than a kernel is."""
    return cast(F, cast(Any, numba.njit)(no_cpython_wrapper=True, forceinline=True, **_OPTIONS)(function))


class _Cache(FunctionCache):
    """Numba compiles a function anew when its own file has changed; here also when one has that it calls into.

    What is compiled is loaded without what only compiling needs, which takes a fifth of a second.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)  # for kernels that make arrays
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return (*super()._index_key(sig, codegen), *(_digest(path) for path in sorted(_files(self._py_func))))


def _files(function: Any) -> set[str]:
    """The files of all kernels and parts that a function calls, or these do, its own and this one."""
    known, waiting = {function}, [function]
    while waiting:
        one = waiting.pop()
        for other in map(one.__globals__.get, one.__code__.co_names):
            if isinstance(other, Dispatcher) and other.py_func not in known:
                known.add(other.py_func)
                waiting.append(other.py_func)
    return {__file__, *(each.__code__.co_filename for each in known)}


@cache
def _digest(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


class _Compiling(event.Listener):
    """Logs once that this process compiles: it takes seconds, and not again. Nothing is collected meanwhile, which
    would take another tenth.
    """

    def __init__(self) -> None:
        self._told, self._collects = False, list[bool]()

    def on_start(self, event: Any) -> None:
        self._collects.append(gc.isenabled())
        gc.disable()
        ours = str(event.data["dispatcher"].py_func.__module__).startswith("shapepose_fg.")
        if ours and not self._told:
            self._told = True
            logging.getLogger(__name__).info("compiling for this machine, once: about half a minute")

    def on_end(self, event: Any) -> None:
        if self._collects.pop():
            gc.enable()


event.register("numba:compile", _Compiling())
