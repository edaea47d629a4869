"""Compressed `.npz` files, written piece by piece: columns need not be in memory, and the bytes do not show it."""

import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike, NDArray

_BLOCK = 1 << 20
"""Bytes that the compressor is given at a time, whatever pieces a column comes in."""


@dataclass(frozen=True)
class Column:
    """An array that comes in pieces of its first axis."""

    dtype: np.dtype[Any]
    """The type of its values."""
    shape: tuple[int, ...]
    """Its whole shape."""
    pieces: Callable[[], Iterable[NDArray[Any]]]
    """The pieces in order; can be asked for several times."""

    @classmethod
    def of(cls, array: NDArray[Any], dtype: DTypeLike | None = None) -> "Column":
        """An array in one piece, as values of `dtype` where that is given."""
        return cls(np.dtype(array.dtype if dtype is None else dtype), array.shape, lambda: (array,))

    def array(self) -> NDArray[Any]:
        """All of it."""
        pieces = [np.asarray(piece, dtype=self.dtype) for piece in self.pieces()]
        return np.concatenate(pieces) if len(pieces) > 0 else np.zeros(self.shape, dtype=self.dtype)

    def blocks(self) -> Iterator[bytes]:
        """Its bytes in C order; ValueError where the pieces do not make up the shape."""
        length, waiting = 0, b""
        for piece in self.pieces():
            if piece.shape[1:] != self.shape[1:]:
                raise ValueError(f"a piece of {self.shape} must not be {piece.shape}")
            length += len(piece) if piece.ndim > 0 else 1
            if piece.size > 0:
                raw = np.ascontiguousarray(piece, dtype=self.dtype).reshape(-1).view(np.uint8)
                at = 0
                while len(waiting) + len(raw) - at >= _BLOCK:
                    stop = at + _BLOCK - len(waiting)
                    yield waiting + raw[at:stop].tobytes()
                    at, waiting = stop, b""
                waiting += raw[at:].tobytes()
        if length != (self.shape[0] if self.shape else 1):
            raise ValueError(f"the pieces of {self.shape} make up {length} rows")
        yield waiting


def write_npz(stream: BinaryIO, columns: Mapping[str, Column | NDArray[Any]]) -> None:
    """Write `columns` as a compressed `.npz` that NumPy alone reads; the same values give the same bytes.

    Columns are taken in order, each when the one before it is written.
    """
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, each in columns.items():
            column = each if isinstance(each, Column) else Column.of(np.asarray(each))
            # A name instead of a file gives every member the same date.
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                header = {"descr": npy.dtype_to_descr(column.dtype), "fortran_order": False}
                npy.write_array_header_1_0(member, header | {"shape": column.shape})
                for block in column.blocks():
                    member.write(block)
