"""Functions over rows, joints and frames, compiled by Numba once per machine and cached
(`core/kept_kernels.py`).

A kernel takes whole arrays of the declared types (C-contiguous; for other types it is compiled
again) and writes its results into arrays that are passed to it, so that one call from Python
processes many rows. Kernels and parts of any file may call each other. Anything else that a kernel
uses from another file, such as a constant, is compiled in: if its value changes, it needs a new
name.
"""

import logging
import shutil
from collections.abc import Callable, Sequence
from functools import update_wrapper
from threading import RLock
from typing import Any, TypeVar, cast

import numba
from numba.extending import typeof_impl

from shapepose_fg.core.compiling import compile_beside
from shapepose_fg.core.kept_kernels import NUMBA, OPTIONS, kept_in, module_folder

F = TypeVar("F", bound=Callable[..., Any])

_NUMBERS = {"f": numba.float64, "i": numba.intp, "b": numba.boolean}
_NUMBERS |= {"s": numba.float32, "w": numba.int32, "u": numba.uint8}

KERNELS: dict[str, "Kernel"] = {}
"""All kernels of the imported modules, by `module:name`."""

_lock = RLock()


def kernel(*kinds: str | type) -> Callable[[F], F]:
    """Compile a function for arguments of these `kinds`. Sums may be reordered; NaN and infinity
    are preserved.

    In a kind, the letter is the type of the numbers (f float64, i intp, b bool, s float32, w int32,
    u uint8) and the digit the number of axes of the array, 0 for a scalar: "f2 i1 f0". A NamedTuple
    class has its own `kinds`.
    """

    def compiled(function: F) -> F:
        made = Kernel(function, kinds)
        KERNELS[made.name] = made
        return cast(F, made)

    return compiled


def part(function: F) -> F:
    """A function that only kernels can call. It is compiled together with them, in less time than a
    kernel.
    """
    return cast(F, _njit(no_cpython_wrapper=True, forceinline=True)(function))


class Kernel:
    """A function that is read from the cache, or compiled, at its first call."""

    def __init__(self, function: Any, kinds: Sequence[str | type]) -> None:
        update_wrapper(self, function)
        self.py_func, self.kinds = function, kinds
        self.name = f"{function.__module__}:{function.__qualname__}"
        self.loaded: Any = None
        """Numba's function; None before the first call."""

    def __call__(self, *arguments: Any) -> Any:
        return (self.loaded or self.load())(*arguments)

    def __reduce__(self) -> str:
        return self.py_func.__qualname__

    def load(self) -> Any:
        """Read the kernel from the cache, or compile it together with all other missing kernels;
        returns `loaded`.
        """
        with _lock:
            if NUMBA.DISABLE_JIT:
                return self.py_func
            if self.loaded is None and not self.is_kept:
                compile_beside([each for each in KERNELS.values() if not each.is_kept])
            if self.loaded is None:
                self.loaded = self._read_or_compile() or self._compile(_njit()(self.py_func))
            return self.loaded

    @property
    def is_kept(self) -> bool:
        """Whether the compiled kernel is in the cache."""
        folder = module_folder(self.py_func.__module__)
        return folder is not None and (folder / self.py_func.__qualname__).exists()

    def _read_or_compile(self) -> Any:
        """Numba's function with its cache; None if the cache cannot be used. A damaged cache is
        removed.
        """
        for _ in range(2):
            folder = module_folder(self.py_func.__module__)
            if folder is None:
                return None
            function: Any = None
            try:
                function = kept_in(folder, self.py_func, _njit(cache=True))
                self._compile(function)
                (folder / self.py_func.__qualname__).touch()
                return function
            except Exception as error:  # of unpickling a damaged file, or a full disk
                logging.getLogger(__name__).debug("%s: %r", folder, error)
                if function is not None and signature(self) in function.overloads:
                    return function  # compiled, but not cached
                shutil.rmtree(folder, ignore_errors=True)
                module_folder.cache_clear()
        return None

    def _compile(self, function: Any) -> Any:
        function.compile(signature(self))
        return function


@typeof_impl.register(Kernel)
def _type_within_kernels(kernel: Kernel, context: Any) -> Any:
    return typeof_impl(kernel.load(), context)


def _njit(**options: Any) -> Any:
    return cast(Any, numba.njit)(**OPTIONS, **options)


def signature(kernel: Any) -> tuple[Any, ...]:
    """The types of a kernel's arguments, as Numba types."""

    def types(kinds: Sequence[str | type]) -> tuple[Any, ...]:
        return tuple(
            one
            for each in kinds
            for one in (map(number, each.split()) if isinstance(each, str) else named(each))
        )

    def named(of: Any) -> tuple[Any, ...]:
        return (numba.types.NamedTuple(types([of.kinds]), of),)

    def number(kind: str) -> Any:
        of, axes = _NUMBERS[kind[0]], int(kind[1:])
        return numba.types.Array(of, axes, "C") if axes > 0 else of

    return types(kernel.kinds)
