"""`.npz` files, read within bounds: arrays whole, or some of their rows without the others in memory."""

import math
import os
import zipfile
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import open_regular


def read_npz(file: Path, names: Collection[str], cure: str) -> dict[str, NDArray[Any]]:
    """Those arrays of an `.npz` file that are called one of `names`; InputError with the `cure` where that fails.

    Of the file's other members nothing is read. An array takes memory only after its size, as zip and NumPy's
    header say it, was found to be one that the file can hold.
    """
    with NpzFile(file, names, cure) as opened:
        return {name: opened.array(name) for name in opened.names}


@dataclass
class _Member:
    """An array of a file, and how far it has been read."""

    stream: IO[bytes]
    """Its bytes."""
    begin: int
    """Where the first row is among these."""
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran: bool
    """Whether its rows are not one after the other."""


class NpzFile:
    """An `.npz` file that stays open, until it is closed or the block is left of which it is the context.

    Rows are packed: those in front of the wanted ones are unpacked and passed over. Who asks for rows in rising
    order, as `rows` of one call after the other, unpacks each once.
    """

    def __init__(self, file: Path, names: Collection[str], cure: str) -> None:
        """Only arrays that are called one of `names` are looked at. InputError with the `cure` where it fails."""
        self.file, self._cure = file, cure
        self._open: dict[str, _Member] = {}
        self._stream = open_regular(file, cure)
        try:
            with self._telling():
                self._archive = zipfile.ZipFile(self._stream)
                every = self._archive.infolist()
                members = [each for each in every if each.filename.removesuffix(".npy") in names]
                _check_members(members, os.fstat(self._stream.fileno()).st_size)
                self._members = {each.filename.removesuffix(".npy"): each for each in members}
        except InputError:
            self._stream.close()
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
        """What a row of an array takes in memory."""
        with self._telling():
            member = self._member(name)
            return member.dtype.itemsize * math.prod(member.shape[1:])

    def array(self, name: str) -> NDArray[Any]:
        """All of an array."""
        with self._telling():
            self._member(name)
            with self._archive.open(self._members[name]) as stream:
                array = np.lib.format.read_array(stream, allow_pickle=False)
            return _with_letters(name, array)

    def rows(self, name: str, index: NDArray[np.intp]) -> NDArray[Any]:
        """The rows `index` (R,), rising, of an array; ValueError where it has no so many."""
        with self._telling():
            member = self._member(name)
            if member.fortran:
                return self.array(name)[index]
            array = np.empty((len(index), *member.shape[1:]), dtype=member.dtype)
            if len(index) == 0:
                return array
            if index[-1] >= member.shape[0]:
                raise ValueError(f"{name} has {member.shape[0]} rows, and row {index[-1]} is asked for")
            width = member.dtype.itemsize * math.prod(member.shape[1:])
            step = max(1, _BLOCK_BYTES // max(width, 1))
            for first in range(int(index[0]), int(index[-1]) + 1, step):
                count = min(step, int(index[-1]) + 1 - first)
                begin, end = np.searchsorted(index, (first, first + count))
                if begin == end:
                    continue
                _go_to(member.stream, member.begin + first * width)
                content = member.stream.read(count * width)
                block = np.frombuffer(content, dtype=member.dtype).reshape(count, *member.shape[1:])
                array[begin:end] = block[index[begin:end] - first]
            return _with_letters(name, array)

    def close(self) -> None:
        """Nothing can be read any more."""
        for member in self._open.values():
            member.stream.close()
        self._archive.close()
        self._stream.close()

    def __enter__(self) -> "NpzFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _member(self, name: str) -> _Member:
        """An array's stream, behind its header; ValueError where zip and header disagree on its size."""
        if name not in self._open:
            info = self._members[name]
            stream = self._archive.open(info)
            version = np.lib.format.read_magic(stream)
            if version not in _HEADERS:
                raise ValueError(f"{info.filename} is of NumPy's format {version}, 1.0 and 2.0 are read")
            shape, fortran, dtype = _HEADERS[version](stream)
            if dtype.kind not in "biufU":
                raise ValueError(f"{info.filename} holds {dtype}, neither numbers nor text")
            if stream.tell() + math.prod(shape) * dtype.itemsize != info.file_size:
                raise ValueError(f"{info.filename} is {shape}, which its {info.file_size} bytes do not hold")
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


_SMALL_BYTES = 2**28
"""Arrays of a small file may be so large together, however well they are packed: columns of NaN pack 1000 to 1."""
_MOST_PACKED = 50
"""Those of a larger one this much larger than the file; measured coordinates hardly pack at all."""
_BLOCK_BYTES = 2**22
"""Of rows that are unpacked at a time."""
_PASSED_BYTES = 2**18
"""Of rows that are passed over."""
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


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
            raise ValueError(f"{member.filename} is packed in another way than NumPy does")
    if len({member.filename for member in members}) < len(members):
        raise ValueError("an array is there twice")
    total, most = sum(member.file_size for member in members), max(_SMALL_BYTES, _MOST_PACKED * size)
    if total > most:
        raise ValueError(f"its arrays would be {total >> 20} MiB large, {total // max(size, 1)} times the file")


def _with_letters(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """The array, if its text is of letters that there are: Python text of others crashes where it is printed."""
    if array.dtype.kind == "U" and array.size > 0 and array.dtype.itemsize > 0:
        order = array.dtype.byteorder
        letters = np.frombuffer(array.tobytes(), dtype=np.dtype(np.uint32).newbyteorder(order))
        if np.any((letters > 0x10FFFF) | ((letters >= 0xD800) & (letters < 0xE000))):
            raise ValueError(f"{name}.npy holds letters that there are not")
    return array
