"""Functions over rows, joints and frames, compiled by Numba: once for a machine, then read from its cache.

A kernel takes whole arrays (C-contiguous, float64, intp or bool: every other type is compiled anew) and writes
into arrays that it is given, so that Python is entered once for many rows. It calls kernels of its own file only:
Numba compiles a function anew when *its* file has changed.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numba
from numba.core import event

F = TypeVar("F", bound=Callable[..., Any])


_OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "nogil": True,
    "fastmath": {"contract", "reassoc"},
    "no_cfunc_wrapper": True,
}


def kernel(function: F) -> F:
    """The function, compiled at its first call. Sums may be taken in another order, NaN and infinity are kept."""
    return cast(F, numba.njit(cache=True, **_OPTIONS)(function))


def part(function: F) -> F:
    """A piece of kernels, which Python cannot call: compiled with them, sooner than a kernel is."""
    return cast(F, numba.njit(no_cpython_wrapper=True, **_OPTIONS)(function))


@contextmanager
def told_of_compiling(say: Callable[[], None]) -> Iterator[None]:
    """Call `say` once, when this process first compiles a kernel inside the block."""
    listener = _First(say)
    with event.install_listener("numba:compile", listener):
        yield


class _First(event.Listener):
    """Calls a function at the first event."""

    def __init__(self, say: Callable[[], None]):
        self._say, self._said = say, False

    def on_start(self, event: Any) -> None:
        if not self._said:
            self._said = True
            self._say()

    def on_end(self, event: Any) -> None:
        pass
