"""Functions over rows, joints and frames, compiled by Numba: once for a machine, then read from its cache.

A kernel takes whole arrays (C-contiguous, float64, intp or bool: every other type is compiled anew) and writes
into arrays that it is given, so that Python is entered once for many rows. It calls kernels of its own file only:
Numba compiles a function anew when *its* file has changed.
"""

import gc
import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.runtime import rtsys

F = TypeVar("F", bound=Callable[..., Any])


_OPTIONS = {"error_model": "numpy", "nogil": True, "fastmath": {"contract", "reassoc"}, "no_cfunc_wrapper": True}


def kernel(function: F) -> F:
    """The function, compiled at its first call. Sums may be taken in another order, NaN and infinity are kept."""
    compiled = cast(Any, numba.njit)(**_OPTIONS)(function)
    compiled._cache = _Cache(function)  # what `cache=True` does, with Numba's own class
    return cast(F, compiled)


def part(function: F) -> F:
    """A piece of kernels, which Python cannot call: compiled with them, sooner than a kernel is."""
    return cast(F, cast(Any, numba.njit)(no_cpython_wrapper=True, **_OPTIONS)(function))


class _Cache(FunctionCache):
    """Loads what is compiled without what only compiling needs, which takes a fifth of a second."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)  # for kernels that make arrays
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


class _Compiling(event.Listener):
    """Logs once that this process compiles: it takes seconds, and not again. Nothing is collected meanwhile, which
    would take another tenth.
    """

    def __init__(self) -> None:
        self._told, self._collects = False, list[bool]()

    def on_start(self, event: Any) -> None:
        self._collects.append(gc.isenabled())
        gc.disable()
        ours = event.data["dispatcher"].py_func.__module__.startswith("shapepose_fg.")
        if ours and not self._told:
            self._told = True
            logging.getLogger(__name__).info("compiling for this machine, once: some twenty seconds")

    def on_end(self, event: Any) -> None:
        if self._collects.pop():
            gc.enable()


event.register("numba:compile", _Compiling())
