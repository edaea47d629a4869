"""`.npz` files: written piece by piece, and read within bounds, whole or only some of their rows."""

import math
import os
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike, NDArray

from shapepose_fg.core.arrays import Index
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import PIECE, open_regular

_LEVEL = 1
"""Level of compression: half the time of zlib's usual 6 for files that are 3 % larger."""
_SMALL_BYTES = 2**28
"""Maximum total size of the arrays of a small file, bytes, whatever their compression: NaN compresses 1000 to
1."""
MOST_PACKED = 50
"""Maximum compression ratio of larger files; measured coordinates hardly compress at all."""
_BLOCK_BYTES, _PASSED_BYTES = 2**22, 2**18
"""Bytes of the rows that are unpacked at a time, and of those that are skipped at a time."""
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


@dataclass(frozen=True)
class Pieces:
    """An array that comes in pieces of its first axis."""

    dtype: np.dtype[Any]
    """The type of its values."""
    shape: tuple[int, ...]
    """Shape of the whole array."""
    pieces: Callable[[], Iterable[NDArray[Any]]]
    """The pieces in order; can be asked for several times."""

    @classmethod
    def of(cls, array: NDArray[Any], dtype: DTypeLike | None = None) -> "Pieces":
        """An array in one piece, as values of `dtype` where that is given."""
        return cls(np.dtype(array.dtype if dtype is None else dtype), array.shape, lambda: (array,))

    def array(self) -> NDArray[Any]:
        """All of it."""
        pieces = [np.asarray(piece, dtype=self.dtype) for piece in self.pieces()]
        return np.concatenate(pieces) if len(pieces) > 0 else np.zeros(self.shape, dtype=self.dtype)

    def blocks(self) -> Iterator[bytes]:
        """Bytes of the array in C order; ValueError where the pieces do not make up the shape."""
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
    """Write `arrays` as a compressed `.npz` that NumPy alone reads; the same values give the same bytes.

    They are taken in order, each when the one before it is written, and need not be in memory.
    """
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=_LEVEL) as archive:
        for name, each in arrays.items():
            array = each if isinstance(each, Pieces) else Pieces.of(np.asarray(each))
            # A name instead of a file gives every member the same date.
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                header = {"descr": npy.dtype_to_descr(array.dtype), "fortran_order": False, "shape": array.shape}
                npy.write_array_header_1_0(member, header)
                for block in array.blocks():
                    member.write(block)


def read_npz(file: Path, names: Collection[str], cure: str) -> dict[str, NDArray[Any]]:
    """Read the arrays of an `.npz` file whose names are among `names`; InputError with the `cure` where that
    fails.

    Other members of the file are not read. An array takes memory only after its size, from the headers of zip and
    NumPy, was found to be one that the file can hold.
    """
    with NpzFile(file, names, cure) as opened:
        return {name: opened.array(name) for name in opened.names}


@dataclass
class _Member:
    """An array of a file: its bytes, where the first row begins, and whether rows lie in Fortran's order."""

    stream: IO[bytes]
    begin: int
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran: bool

    @property
    def row_bytes(self) -> int:
        return self.dtype.itemsize * math.prod(self.shape[1:])


class NpzFile(ExitStack):
    """An `.npz` file that is open, until it is closed or the block is left of which it is the context.

    Rows are packed: those in front of the wanted ones are unpacked and passed over. Who asks for rows in rising
    order, as `rows` of one call after the other, unpacks each once.
    """

    def __init__(self, file: Path, names: Collection[str], cure: str) -> None:
        """Only arrays that are called one of `names` are looked at. InputError with the `cure` where it fails."""
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
        """The arrays that are there."""
        return list(self._members)

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of an array."""
        with self._telling():
            return self._member(name).shape

    def row_bytes(self, name: str) -> int:
        """Size of a row of an array in memory, bytes."""
        with self._telling():
            return self._member(name).row_bytes

    def array(self, name: str) -> NDArray[Any]:
        """All of an array."""
        with self._telling():
            self._member(name)
            with self._archive.open(self._members[name]) as stream:
                return _with_letters(name, npy.read_array(stream, allow_pickle=False))

    def rows(self, name: str, index: Index) -> NDArray[Any]:
        """The rows `index` (R,), rising, of an array."""
        with self._telling():
            member = self._member(name)
            if member.fortran:
                return self.array(name)[index]
            array = np.empty((len(index), *member.shape[1:]), dtype=member.dtype)
            if len(index) == 0:
                return array
            if index[-1] >= member.shape[0]:
                raise ValueError(f"{name} has {member.shape[0]} rows, but row {index[-1]} was requested")
            step = max(1, _BLOCK_BYTES // max(member.row_bytes, 1))
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
        """An array's stream, behind its header; ValueError where zip and header disagree on its size."""
        if name not in self._open:
            info = self._members[name]
            stream = self.enter_context(self._archive.open(info))
            shape, fortran, dtype = read_npy_header(stream)
            if dtype.kind not in "biufU":
                raise ValueError(f"{info.filename} holds {dtype}, neither numbers nor text")
            if stream.tell() + math.prod(shape) * dtype.itemsize != info.file_size:
                raise ValueError(f"{info.filename} is {shape}, which does not fit its {info.file_size} bytes")
            self._open[name] = _Member(stream, stream.tell(), shape, dtype, fortran and len(shape) > 1)
        return self._open[name]

    @contextmanager
    def _telling(self) -> Iterator[None]:
        """Whatever is wrong with the file is an InputError: zipfile, zlib and NumPy fail in a dozen ways."""
        try:
            yield
        except InputError:
            raise
        except Exception as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(
                f"{self.file}: cannot be read as an .npz file without pickled objects ({reason}); {self._cure}"
            ) from None


def read_npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether in Fortran's order, and type of an array in NumPy's format; its numbers follow in the stream.

    ValueError for other versions of the format than 1.0 and 2.0; NumPy raises many others for a damaged header.
    """
    version = npy.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"its NumPy format is {version}, but only 1.0 and 2.0 are supported")
    return _HEADERS[version](stream)


def _go_to(stream: IO[bytes], place: int) -> None:
    """Pass over what is in front of `place`, a little at a time: `seek` would unpack 16 MB at once."""
    if place < stream.tell():
        stream.seek(0)
    while stream.tell() < place:
        if len(stream.read(min(_PASSED_BYTES, place - stream.tell()))) == 0:
            raise ValueError("the file ends too early")


def _check_members(members: Sequence[zipfile.ZipInfo], size: int) -> None:
    """ValueError for members of a zip that `np.savez` does not write, or too large for a file of `size` bytes."""
    for member in members:
        if member.flag_bits & 1:
            raise ValueError(f"{member.filename} is encrypted")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"{member.filename} has a compression that NumPy does not use")
    if len({member.filename for member in members}) < len(members):
        raise ValueError("an array occurs twice")
    total = sum(member.file_size for member in members)
    if total > max(_SMALL_BYTES, MOST_PACKED * size):
        raise ValueError(f"its arrays would be {total >> 20} MiB large, {total // max(size, 1)} times the file")


def _with_letters(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """The array, if its text is of letters that there are: Python text of others crashes where it is printed."""
    if array.dtype.kind == "U" and array.size > 0 and array.dtype.itemsize > 0:
        letters = np.frombuffer(array.tobytes(), np.dtype(np.uint32).newbyteorder(array.dtype.byteorder))
        if np.any((letters > 0x10FFFF) | ((letters >= 0xD800) & (letters < 0xE000))):
            raise ValueError(f"{name}.npy holds invalid characters")
    return array
