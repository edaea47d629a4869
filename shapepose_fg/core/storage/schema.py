"""Tables of arrays. The type of each field declares its column; every new table is checked against
these declarations.

For example `place: Annotated[Array, Column("N 3", unit="m", most=1e6)]`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache, cached_property
from typing import Any, ClassVar, Self, cast, get_type_hints

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.rows import Rows
from shapepose_fg.core.storage.npz import Pieces

_ALLOWED = {"i": "iu", "u": "iu", "f": "f", "U": "U", "b": "b"}
"""NumPy type kinds that are accepted for each kind of a column: integers, floats, text,
booleans."""


@dataclass(frozen=True)
class Column:
    """Axes, type, unit and bounds of a column."""

    axes: str
    """Axes, separated by spaces: a letter stands for a length that is the same in all columns of a
    table; N is the number of rows."""
    dtype: Any = np.float64
    """Type of the column's values."""
    unit: str = ""
    """Unit of the column's values; empty if they have none."""
    most: float = np.inf
    """Maximum magnitude in a file; real results are smaller, and products of larger numbers could
    overflow."""
    least: float = -np.inf
    """Minimum in a file; integers with a maximum are not negative."""
    finite: bool = False
    """Whether every value is known: not NaN."""
    missing: Any = None
    """Default value of a column, for example for files of earlier versions; None if the column is
    required."""
    codes: type[Enum] | None = None
    """Meanings of the codes, numbered from 0."""
    stored: Any = None
    """Type in files, if it differs from `dtype`."""

    @property
    def has_rows(self) -> bool:
        """Whether the first axis of the array counts the rows of the table."""
        return self._lengths[0] == "N"

    @cached_property
    def _lengths(self) -> tuple[int | str, ...]:
        """For each axis, its length or its letter."""
        return tuple(int(axis) if axis.isdecimal() else axis for axis in self.axes.split())

    def shape(self, sizes: dict[str, int]) -> tuple[int, ...]:
        """Shape of the array for given lengths of the letters."""
        return tuple(
            sizes.get(each, 0) if isinstance(each, str) else each for each in self._lengths
        )

    def checked(self, name: str, value: Any, sizes: dict[str, int]) -> NDArray[Any]:
        """Convert `value` to an array of the column's type; ValueError naming the column if shape
        or type do not match.

        Lengths that are not yet in `sizes` are added to it. Numbers of another size are converted,
        but floats are not truncated to integers, and integers that do not fit are refused. Text
        keeps its own width.
        """
        wanted = np.dtype(self.dtype)
        if value is None:
            if self.missing is None:
                raise ValueError(f"column {name} is missing")
            value = np.full(self.shape(sizes), self.missing, dtype=wanted)
        array = np.asarray(value)
        for axis, length in zip(self._lengths, array.shape, strict=False):
            if isinstance(axis, str):
                sizes.setdefault(axis, length)
        if array.shape != self.shape(sizes):
            raise ValueError(f"{name} must be {self.shape(sizes)}, got {array.shape}")
        if array.dtype == wanted and self.codes is None:
            return array
        if array.dtype.kind not in _ALLOWED[wanted.kind] and array.size > 0:
            raise ValueError(f"{name} must hold {wanted} values, got {array.dtype}")
        if wanted.kind in "iu" and array.size > 0 and array.dtype != wanted:
            limits = np.iinfo(cast(Any, wanted))
            if array.min() < limits.min or array.max() > limits.max:
                got = f"{array.min()} to {array.max()}"
                raise ValueError(f"{name} must hold {limits.min} to {limits.max}, got {got}")
        array = array.astype(str if wanted.kind == "U" else wanted, copy=False)
        if self.codes is not None and array.size > 0 and array.max() >= len(self.codes):
            raise ValueError(f"{name} must hold codes below {len(self.codes)}, got {array.max()}")
        return array

    def check_range(self, name: str, array: NDArray[Any]) -> None:
        """Raise ValueError if a value is outside the column's bounds, or unknown where it must not
        be.
        """
        if array.size == 0 or array.dtype.kind not in "iuf":
            return
        if self.finite and not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite")
        least = 0 if array.dtype.kind == "i" and np.isfinite(self.most) else self.least
        low, high = (float(each.reduce(array, axis=None)) for each in (np.fmin, np.fmax))
        if low < least:
            words = "not be negative" if least == 0 else f"be at least {least:g}"
            raise ValueError(f"{name} must {words}, got {low:g}")
        if (largest := max(high, -low)) > self.most:
            raise ValueError(
                f"{name} must be at most {self.most:g} or unknown (NaN), got {largest:g}"
            )


def checked_columns(
    columns: Mapping[str, Column], arrays: Mapping[str, Any], sizes: dict[str, int]
) -> dict[str, NDArray[Any]]:
    """Arrays as described by their `columns`, and in range; ValueError that names the first that is
    not, or that is missing.
    """
    found = {
        name: column.checked(name, arrays.get(name), sizes) for name, column in columns.items()
    }
    for name, column in columns.items():
        column.check_range(name, found[name])
    return found


@cache
def columns_of(kind: type) -> dict[str, Column]:
    """The columns of a table class, by the names of its fields, in their order."""
    hints = get_type_hints(kind, include_extras=True)
    marks = {name: getattr(hint, "__metadata__", ()) for name, hint in hints.items()}
    return {
        name: mark for name, found in marks.items() for mark in found if isinstance(mark, Column)
    }


class Table(Rows):
    """Base of frozen dataclasses whose fields are arrays, each annotated with its `Column`.

    ValueError that names the column if its shape or type does not match.
    """

    ROWS: ClassVar[Sequence[str]] = ()
    """The columns with one entry per row, in the order of files; by default the order of the
    fields."""

    def __post_init__(self) -> None:
        sizes: dict[str, int] = {}
        for name, column in columns_of(type(self)).items():
            object.__setattr__(self, name, column.checked(name, getattr(self, name), sizes))

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if len(cls.ROWS) == 0:
            cls.ROWS = [name for name, column in columns_of(cls).items() if column.has_rows]

    def _columns(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.ROWS}

    @classmethod
    def shared(cls) -> list[str]:
        """Names of the columns that all rows share, such as the names of joints."""
        return [name for name, column in columns_of(cls).items() if not column.has_rows]

    @classmethod
    def without_rows(cls, **shared: Any) -> Self:
        """A table without rows; `shared` are the columns that rows share."""
        sizes: dict[str, int] = {}
        columns = columns_of(cls)
        values = {name: columns[name].checked(name, value, sizes) for name, value in shared.items()}
        sizes["N"] = 0
        rows = {
            name: np.zeros(columns[name].shape(sizes), columns[name].dtype) for name in cls.ROWS
        }
        return cls(**values, **rows)

    @classmethod
    def concatenate(cls, parts: Sequence[Self], **others: Any) -> Self:
        """Concatenate the rows of one or more parts; shared columns, and `others`, are taken
        unchanged.

        ValueError if two parts differ in shared columns.
        """
        for part in parts[1:]:
            for name in cls.shared():
                if not np.array_equal(getattr(part, name), getattr(parts[0], name)):
                    raise ValueError(f"parts must have the same {name}")
        return super().concatenate(parts, **others)

    def check_ranges(self) -> None:
        """Raise ValueError for impossible values, such as negative frames, or joints thousands of
        kilometres away.
        """
        for name, column in columns_of(type(self)).items():
            column.check_range(name, getattr(self, name))

    def columns(self) -> dict[str, Pieces]:
        """The arrays of a file: columns with rows, shared columns, and meanings of codes."""
        stored = {name: column.stored for name, column in columns_of(type(self)).items()}
        own = {
            name: Pieces.of(getattr(self, name), stored[name])
            for name in (*self.ROWS, *self.shared())
        }
        return own | {name: Pieces.of(words) for name, words in self.meanings().items()}

    @classmethod
    def meanings(cls) -> dict[str, NDArray[np.str_]]:
        """Meanings of codes, as arrays for readers of the file: `gate_names` for the column
        `gate`.
        """
        coded = {
            name: column.codes
            for name, column in columns_of(cls).items()
            if column.codes is not None
        }
        return {f"{name}_names": code_names(codes) for name, codes in coded.items()}


def code_names(kinds: type[Enum]) -> NDArray[np.str_]:
    """(K,) the meaning of each code of `kinds`, in words."""
    return np.array([kind.name.lower().replace("_", " ") for kind in kinds])
