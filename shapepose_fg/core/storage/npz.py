"""`.npz` files: written piece by piece, and read within limits, completely or only some of their
rows.
"""

import math
import os
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike, NDArray

from shapepose_fg.core.arrays import Index
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.storage.files import BIG, PIECE, open_regular

MOST_PACKED = 50
"""Maximum ratio of the size of arrays to that of their file, if the arrays have more than `BIG`
bytes; measured coordinates hardly compress at all."""
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


@dataclass(frozen=True)
class Pieces:
    """An array that is produced in pieces along its first axis."""

    dtype: np.dtype[Any]
    """Type of the array's values."""
    shape: tuple[int, ...]
    """Shape of the whole array."""
    pieces: Callable[[], Iterable[NDArray[Any]]]
    """Function that yields the pieces in order; may be called several times."""

    @classmethod
    def of(cls, array: NDArray[Any], dtype: DTypeLike | None = None) -> "Pieces":
        """An array in one piece, converted to `dtype` if given."""
        return cls(np.dtype(array.dtype if dtype is None else dtype), array.shape, lambda: (array,))

    def array(self) -> NDArray[Any]:
        """The whole array."""
        pieces = [np.asarray(piece, dtype=self.dtype) for piece in self.pieces()]
        return np.concatenate(pieces) if len(pieces) > 0 else np.zeros(self.shape, dtype=self.dtype)

    def blocks(self) -> Iterator[bytes]:
        """Bytes of the array in C order; ValueError if the pieces do not have the total shape."""
        length, waiting = 0, b""
        for piece in self.pieces():
            if piece.shape[1:] != self.shape[1:]:
                raise ValueError(f"a piece of {self.shape} must not be {piece.shape}")
            length += len(piece) if piece.ndim > 0 else 1
            if piece.size > 0:
                raw = np.ascontiguousarray(piece, dtype=self.dtype).reshape(-1).view(np.uint8)
                at = 0
                while len(waiting) + len(raw) - at >= PIECE:
                    stop = at + PIECE - len(waiting)
                    yield waiting + raw[at:stop].tobytes()
                    at, waiting = stop, b""
                waiting += raw[at:].tobytes()
        if length != (self.shape[0] if self.shape else 1):
            raise ValueError(f"the pieces of {self.shape} make up {length} rows")
        yield waiting


def write_npz(stream: BinaryIO, arrays: Mapping[str, Pieces | NDArray[Any]]) -> None:
    """Write `arrays` as a compressed `.npz`, readable with NumPy without this package; equal values
    give equal bytes.

    Arrays are requested in order, one after the other is written, and need not be in memory.
    """
    # Compression level: half the time of zlib's default 6, for files that are 3 % larger.
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, each in arrays.items():
            array = each if isinstance(each, Pieces) else Pieces.of(np.asarray(each))
            # With a name instead of a file, all members get the same date.
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                header = {
                    "descr": npy.dtype_to_descr(array.dtype),
                    "fortran_order": False,
                    "shape": array.shape,
                }
                npy.write_array_header_1_0(member, header)
                for block in array.blocks():
                    member.write(block)


def read_npz(file: Path, names: Collection[str], cure: str) -> dict[str, NDArray[Any]]:
    """Read the arrays of an `.npz` file that are in `names`; InputError with the `cure` if that
    fails.

    Other members of the file are not read. Memory is allocated only after the size in the headers
    of zip and NumPy was found plausible for the size of the file.
    """
    with NpzFile(file, names, cure) as opened:
        return {name: opened.array(name) for name in opened.names}


@dataclass
class _Member:
    """An array of a file: its stream, the position of the first row, and whether it is in Fortran
    order.
    """

    stream: IO[bytes]
    begin: int
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran: bool

    @property
    def row_bytes(self) -> int:
        return self.dtype.itemsize * math.prod(self.shape[1:])


class NpzFile(ExitStack):
    """An open `.npz` file; a context manager that closes it.

    Rows are compressed: those before the requested ones are decompressed and skipped. If rows are
    requested in increasing order, over all calls of `rows`, each is decompressed only once.
    """

    def __init__(self, file: Path, names: Collection[str], cure: str) -> None:
        """Only arrays in `names` are read. InputError with the `cure` if the file cannot be
        opened.
        """
        super().__init__()
        self.file, self._cure = file, cure
        self._open: dict[str, _Member] = {}
        stream = self.enter_context(open_regular(file, cure))
        try:
            with self._telling():
                self._archive = self.enter_context(zipfile.ZipFile(stream))
                every = self._archive.infolist()
                members = [each for each in every if each.filename.removesuffix(".npy") in names]
                _check_members(members, os.fstat(stream.fileno()).st_size)
                self._members = {each.filename.removesuffix(".npy"): each for each in members}
        except InputError:
            self.close()
            raise

    @property
    def names(self) -> list[str]:
        """Names of the arrays that exist."""
        return list(self._members)

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of an array."""
        with self._telling():
            return self._member(name).shape

    def row_bytes(self, name: str) -> int:
        """Size of one row of an array in memory, bytes."""
        with self._telling():
            return self._member(name).row_bytes

    def array(self, name: str) -> NDArray[Any]:
        """A whole array."""
        with self._telling():
            self._member(name)
            with self._archive.open(self._members[name]) as stream:
                return _with_letters(name, npy.read_array(stream, allow_pickle=False))

    def rows(self, name: str, index: Index) -> NDArray[Any]:
        """The rows `index` (R,), increasing, of an array."""
        with self._telling():
            member = self._member(name)
            if member.fortran:
                return self.array(name)[index]
            array = np.empty((len(index), *member.shape[1:]), dtype=member.dtype)
            if len(index) == 0:
                return array
            if index[-1] >= member.shape[0]:
                raise ValueError(
                    f"{name} has {member.shape[0]} rows, but row {index[-1]} was requested"
                )
            step = max(1, PIECE // max(member.row_bytes, 1))
            for first in range(int(index[0]), int(index[-1]) + 1, step):
                count = min(step, int(index[-1]) + 1 - first)
                begin, end = np.searchsorted(index, (first, first + count))
                if begin == end:
                    continue
                _go_to(member.stream, member.begin + first * member.row_bytes)
                content = member.stream.read(count * member.row_bytes)
                block = np.frombuffer(content, dtype=member.dtype).reshape(count, *member.shape[1:])
                array[begin:end] = block[index[begin:end] - first]
            return _with_letters(name, array)

    def _member(self, name: str) -> _Member:
        """The stream of an array, positioned after its header; ValueError if the headers of zip and
        NumPy disagree on its size.
        """
        if name not in self._open:
            info = self._members[name]
            stream = self.enter_context(self._archive.open(info))
            shape, fortran, dtype = read_npy_header(stream)
            if dtype.kind not in "biufU":
                raise ValueError(f"{info.filename} holds {dtype}, neither numbers nor text")
            if stream.tell() + math.prod(shape) * dtype.itemsize != info.file_size:
                raise ValueError(
                    f"{info.filename} is {shape}, which does not fit its {info.file_size} bytes"
                )
            self._open[name] = _Member(
                stream, stream.tell(), shape, dtype, fortran and len(shape) > 1
            )
        return self._open[name]

    def _telling(self) -> AbstractContextManager[None]:
        """Convert any error of zipfile, zlib or NumPy about the file to an InputError."""
        words = "cannot be read as an .npz file without pickled objects ({})"
        return naming(self.file, self._cure, words, Exception)


def read_npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether in Fortran order, and type of an array in NumPy's format; its values follow in
    the stream.

    ValueError for other versions of the format than 1.0 and 2.0; NumPy raises many others for a
    damaged header.
    """
    version = npy.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"its NumPy format is {version}, but only 1.0 and 2.0 are supported")
    return _HEADERS[version](stream)


def _go_to(stream: IO[bytes], place: int) -> None:
    """Skip to the position `place` in small steps: `seek` would decompress 16 MB at once."""
    if place < stream.tell():
        stream.seek(0)
    while stream.tell() < place:
        if len(stream.read(min(PIECE, place - stream.tell()))) == 0:
            raise ValueError("the file ends too early")


def _check_members(members: Sequence[zipfile.ZipInfo], size: int) -> None:
    """Raise ValueError for members of a zip file that `np.savez` would not write, or that are too
    large for a file of `size` bytes.
    """
    for member in members:
        if member.flag_bits & 1:
            raise ValueError(f"{member.filename} is encrypted")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"{member.filename} has a compression that NumPy does not use")
    if len({member.filename for member in members}) < len(members):
        raise ValueError("an array occurs twice")
    total = sum(member.file_size for member in members)
    if total > max(BIG, MOST_PACKED * size):
        raise ValueError(
            f"its arrays would be {total >> 20} MiB large, {total // max(size, 1)} times the file"
        )


def _with_letters(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Return the array; ValueError if its text has invalid code points, with which Python fails on
    printing.
    """
    if array.dtype.kind == "U" and array.size > 0 and array.dtype.itemsize > 0:
        letters = np.frombuffer(
            array.tobytes(), np.dtype(np.uint32).newbyteorder(array.dtype.byteorder)
        )
        if np.any((letters > 0x10FFFF) | ((letters >= 0xD800) & (letters < 0xE000))):
            raise ValueError(f"{name}.npy holds invalid characters")
    return array
