"""Tables of arrays with one row each: shapes and types checked."""

from enum import IntEnum
from typing import Any, cast

import numpy as np
from numpy.typing import DTypeLike, NDArray

_ALLOWED = {"i": "iu", "u": "iu", "f": "f", "U": "U"}
"""Kinds of NumPy types that may stand for a column's own kind: whole numbers, real numbers, text."""


def checked(name: str, value: object, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """`value` as an array of `shape` and `dtype`; ValueError naming the column where it is anything else.

    Whole numbers of another size are converted, and so are real ones; real numbers are not cut to whole ones,
    and a whole number that the column's type cannot hold is refused. Text keeps its own width.
    """
    array, wanted = np.asarray(value), np.dtype(dtype)
    if array.shape != shape:
        raise ValueError(f"{name} must be {shape}, got {array.shape}")
    if array.dtype.kind not in _ALLOWED[wanted.kind] and array.size > 0:
        raise ValueError(f"{name} must hold {wanted} values, got {array.dtype}")
    if wanted.kind in "iu" and array.size > 0:
        bounds = np.iinfo(cast(Any, wanted))
        if array.min() < bounds.min or array.max() > bounds.max:
            raise ValueError(f"{name} must hold {bounds.min} to {bounds.max}, got {array.min()} to {array.max()}")
    return array.astype(str if wanted.kind == "U" else wanted, copy=False)


def check_codes(name: str, codes: NDArray[np.uint8], kinds: type[IntEnum]) -> None:
    """ValueError where a code of the column `name` is none of `kinds`, which count from 0."""
    if codes.size > 0 and codes.max() >= len(kinds):
        raise ValueError(f"{name} must hold codes below {len(kinds)}, got {codes.max()}")


def code_names(kinds: type[IntEnum]) -> NDArray[np.str_]:
    """(K,) what each code of `kinds` means, in words: the array that makes a file of codes readable."""
    return np.array([kind.name.lower().replace("_", " ") for kind in kinds])
