"""Tables of arrays with one row each: shapes and types checked, `.npz` files read."""

import math
import os
import zipfile
from collections.abc import Collection, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import DTypeLike, NDArray

from shapepose_fg.errors import InputError
from shapepose_fg.files import open_regular

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


def read_npz(file: Path, names: Collection[str], cure: str) -> dict[str, NDArray[Any]]:
    """Those arrays of an `.npz` file that are called one of `names`; InputError with the `cure` where that fails.

    Of the file's other members nothing is read. An array takes memory only after its size, as zip and NumPy's
    header say it, was found to be one that the file can hold.
    """
    stream = open_regular(file, cure)
    try:
        with stream, zipfile.ZipFile(stream) as archive:
            members = [each for each in archive.infolist() if each.filename.removesuffix(".npy") in names]
            _check_members(members, os.fstat(stream.fileno()).st_size)
            return {member.filename.removesuffix(".npy"): _array(archive, member) for member in members}
    except Exception as error:  # a damaged file fails inside zipfile, zlib and NumPy in a dozen ways
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{file}: cannot be read as an .npz file without pickled objects ({reason}); {cure}"
        ) from None


_SMALL_BYTES = 2**28
"""Arrays of a small file may be so large together, however well they are packed: columns of NaN pack 1000 to 1."""
_MOST_PACKED = 50
"""Those of a larger one this much larger than the file; measured coordinates hardly pack at all."""
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


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


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """One array, if the zip and its own header agree on its size."""
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"{member.filename} is of NumPy's format {version}, 1.0 and 2.0 are read")
        shape, _, dtype = _HEADERS[version](stream)
        if dtype.kind not in "biufU":
            raise ValueError(f"{member.filename} holds {dtype}, neither numbers nor text")
        if stream.tell() + math.prod(shape) * dtype.itemsize != member.file_size:
            raise ValueError(f"{member.filename} is {shape}, which its {member.file_size} bytes do not hold")
    with archive.open(member) as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False)
    if dtype.kind == "U" and array.size > 0 and dtype.itemsize > 0:
        letters = np.frombuffer(array.tobytes(), dtype=np.dtype(np.uint32).newbyteorder(dtype.byteorder))
        # Python text of such letters crashes where it is printed.
        if np.any((letters > 0x10FFFF) | ((letters >= 0xD800) & (letters < 0xE000))):
            raise ValueError(f"{member.filename} holds letters that there are not")
    return array
