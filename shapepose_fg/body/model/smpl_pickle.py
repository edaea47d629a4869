"""Reads the official SMPL `.pkl` without running code from it.

A pickle is a program for a virtual machine: loading an untrusted one can do anything Python can,
and a few bytes can fill the memory or loop forever. Here Python's own virtual machine
(`pickle._Unpickler`) runs with only the instructions that arrays need, and a limit of steps. No
names are imported and nothing is called: names stay `Name` values, objects become a `Record` of
their description in the file. The few names that SMPL's files need (NumPy arrays, SciPy sparse
matrices, chumpy arrays) are then converted to arrays.
"""

import io
import pickle
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.storage.files import read_bytes

_MOST_STEPS = 200_000
"""Maximum number of steps; SMPL's files take a few thousand."""


class RefusedPickle(Exception):
    """The pickle uses something that a body model does not need."""


@dataclass(frozen=True)
class Name:
    """Name of a class or function in the pickle; it is never imported."""

    module: str
    name: str


@dataclass
class Record:
    """Description of an object in the pickle: the name called, its arguments, and the object's
    state.
    """

    name: Name
    arguments: tuple[Any, ...]
    state: Any = None


_CORES = ("core", "_core")
_RECONSTRUCT = {Name(f"numpy.{core}.multiarray", "_reconstruct") for core in _CORES}
_SCALAR = {Name(f"numpy.{core}.multiarray", "scalar") for core in _CORES}
_FROM_BUFFER = {Name(f"numpy.{core}.numeric", "_frombuffer") for core in _CORES}
_DTYPE = {Name("numpy", "dtype")}
_BYTES = {Name("_codecs", "encode")}
_COLUMNS = {Name(f"scipy.sparse{part}", "csc_matrix") for part in ("", ".csc", "._csc")}
_ROWS = {Name(f"scipy.sparse{part}", "csr_matrix") for part in ("", ".csr", "._csr")}
_REBUILDS = {Name("copy_reg", "_reconstructor"), Name("copyreg", "_reconstructor")}
"""Functions that create an object of the class given as their first argument."""
_OTHERS = {
    Name("numpy", "ndarray"),
    Name("__builtin__", "object"),
    Name("builtins", "object"),
} | _REBUILDS
_KNOWN = _RECONSTRUCT | _SCALAR | _FROM_BUFFER | _DTYPE | _BYTES | _COLUMNS | _ROWS | _OTHERS


def _is_chumpy(name: Name) -> bool:
    return name.module == "chumpy" or name.module.startswith("chumpy.")


_INSTRUCTIONS = (
    "PROTO FRAME STOP MARK POP NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 LONG4 "
    "FLOAT BINFLOAT STRING BINSTRING SHORT_BINSTRING UNICODE BINUNICODE SHORT_BINUNICODE "
    "BINUNICODE8 BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8 EMPTY_LIST EMPTY_DICT EMPTY_TUPLE "
    "LIST TUPLE TUPLE1 TUPLE2 TUPLE3 DICT APPEND APPENDS SETITEM SETITEMS PUT BINPUT LONG_BINPUT "
    "MEMOIZE GET BINGET LONG_BINGET GLOBAL STACK_GLOBAL REDUCE NEWOBJ BUILD"
).split()


def _counted(step: Callable[[Any], None]) -> Callable[[Any], None]:
    def run(reader: Any) -> None:
        reader.steps += 1
        if reader.steps > _MOST_STEPS:
            raise RefusedPickle(
                f"it has over {_MOST_STEPS} instructions, but a body model has a few thousand"
            )
        step(reader)

    return run


class _Instructions(dict[int, Callable[[Any], None]]):
    """The instructions that the reader supports."""

    def __missing__(self, code: int) -> None:
        raise RefusedPickle(f"it has the pickle opcode {bytes([code])!r}, which no array needs")


class _Reader(pickle._Unpickler):  # type: ignore[name-defined]
    """Python's unpickler with restricted instructions; Python 2 text is read as Latin-1."""

    dispatch: ClassVar[_Instructions]
    stack: list[Any]
    append: Callable[[Any], None]
    read: Callable[[int], bytes]
    pop_mark: Callable[[], list[Any]]

    def __init__(self, content: bytes):
        super().__init__(io.BytesIO(content), encoding="latin1")
        self.steps = 0

    def find_class(self, module: str, name: str) -> Name:
        found = Name(module, name)
        if found not in _KNOWN and not _is_chumpy(found):
            raise RefusedPickle(f"it asks for {module}.{name}, which no body model needs")
        return found

    def call(self) -> None:
        arguments, made = self.stack.pop(), self.stack.pop()
        if not isinstance(made, Name) or not isinstance(arguments, tuple):
            raise RefusedPickle("it calls something that is not a name")
        if made in _REBUILDS:
            made, arguments = arguments[0], ()
        if not isinstance(made, Name) or made in _REBUILDS:
            raise RefusedPickle("it makes an object of something that is not an array")
        self.append(Record(made, arguments))

    def build(self) -> None:
        state = self.stack.pop()
        if not isinstance(self.stack[-1], Record):
            raise RefusedPickle("it gives a state to something that is not an array")
        self.stack[-1].state = state

    def fill(self, values: list[Any]) -> None:
        """Add entries to a dict; keys other than text could have very slow comparisons."""
        if not isinstance(self.stack[-1], dict) or not all(
            isinstance(key, str | int) for key in values[::2]
        ):
            raise RefusedPickle("it has keys that are not text")
        self.stack[-1].update(zip(values[::2], values[1::2], strict=True))

    def filled(self) -> None:
        values = self.pop_mark()
        self.append({})
        self.fill(values)

    def byte_array(self) -> None:
        (size,) = struct.unpack("<Q", self.read(8))
        self.append(bytearray(self.read(size)))  # at most the rest of the file


_OWN: dict[str, Callable[[Any], None]] = {
    "REDUCE": _Reader.call,
    "NEWOBJ": _Reader.call,
    "BUILD": _Reader.build,
    "DICT": _Reader.filled,
    "SETITEM": lambda reader: reader.fill([reader.stack.pop() for _ in range(2)][::-1]),
    "SETITEMS": lambda reader: reader.fill(reader.pop_mark()),
    "BYTEARRAY8": _Reader.byte_array,
}
_Reader.dispatch = _Instructions(
    (code, _counted(_OWN.get(name, pickle._Unpickler.dispatch[code])))  # type: ignore[attr-defined]
    for name in _INSTRUCTIONS
    for code in getattr(pickle, name)
)


def read_smpl_pickle(path: Path) -> dict[str, Any]:
    """The entries of a pickled dict; `as_array` converts those that are arrays or sparse matrices.

    Raises RefusedPickle if the file needs anything but data; a damaged pickle can raise any error.
    """
    # Maximum size of a file, bytes; SMPL's own have 40 to 250 MB.
    content = _Reader(read_bytes(path, 2**30)).load()
    if not isinstance(content, dict):
        raise RefusedPickle(f"it holds a {type(content).__name__}, but SMPL's files hold a dict")
    return {str(name): value for name, value in content.items()}


def as_array(value: Any) -> NDArray[Any]:
    """The array described by a record; raises ValueError or TypeError if it is not an array."""
    if isinstance(value, list | tuple):
        if not all(isinstance(each, int | float) for each in value):
            raise TypeError("a list of anything but numbers is not an array")
        return np.asarray(value, dtype=np.float64)
    if isinstance(value, int | float):
        return np.asarray(value, dtype=np.float64)
    if not isinstance(value, Record):
        raise TypeError(f"{type(value).__name__} is not an array")
    if _is_chumpy(value.name):
        return _chumpy_array(value)
    if value.name in _COLUMNS | _ROWS:
        return _sparse_array(value)
    if value.name in _FROM_BUFFER:
        buffer, dtype, shape, order = value.arguments
        return _shaped(_raw_bytes(buffer), dtype, shape, order)
    if value.name in _SCALAR:
        return _shaped(_raw_bytes(value.arguments[1]), value.arguments[0], (), "C")
    if value.name in _RECONSTRUCT and value.state is not None:
        _, shape, dtype, fortran, content = value.state
        return _shaped(_raw_bytes(content), dtype, shape, "F" if fortran else "C")
    raise TypeError(f"{value.name.module}.{value.name.name} is not an array")


def _shaped(content: bytes, dtype: Any, shape: Any, order: str) -> NDArray[Any]:
    return np.frombuffer(content, dtype=_number_type(dtype)).reshape(shape, order=order)  # type: ignore[call-overload]


def _number_type(record: Any) -> np.dtype[Any]:
    """The dtype named by a record: only plain numbers, never Python objects."""
    if not isinstance(record, Record) or record.name not in _DTYPE:
        raise TypeError("an array without a dtype")
    name = record.arguments[0]
    if not isinstance(name, str) or name[:1] not in ("f", "i", "u", "b") or not name[1:].isdigit():
        raise TypeError(f"arrays of {str(name)[:20]!r} are not numbers")
    byte_order = (
        record.state[1] if isinstance(record.state, tuple) and len(record.state) > 1 else "="
    )
    return np.dtype(name).newbyteorder(byte_order if byte_order in ("<", ">") else "=")


def _raw_bytes(value: Any) -> bytes:
    """Raw bytes, as written by the different pickle protocols."""
    if isinstance(value, Record) and value.name in _BYTES:
        text, encoding = value.arguments
        if encoding != "latin1":
            raise TypeError("bytes in an encoding that NumPy does not use")
        return text.encode("latin1")
    if isinstance(value, str):
        return value.encode("latin1")
    if isinstance(value, bytes | bytearray):
        return bytes(value)
    raise TypeError(f"an array made of {type(value).__name__}")


def _sparse_array(value: Record) -> Array:
    """The dense form of a compressed sparse matrix."""
    from scipy import sparse

    state = value.state
    shape = as_array(state["_shape"] if "_shape" in state else state["shape"]).astype(np.int64)
    parts = [as_array(state[name]) for name in ("data", "indices", "indptr")]
    # Maximum number of entries of a dense matrix: 24 joints from 350,000 vertices.
    if shape.shape != (2,) or not 0 < shape.prod() <= 2**23 or not (shape > 0).all():
        raise ValueError(f"a sparse matrix of {shape.tolist()} entries")
    kind = sparse.csc_array if value.name in _COLUMNS else sparse.csr_array
    matrix = kind((parts[0], *(each.astype(np.intp) for each in parts[1:])), tuple(shape.tolist()))
    matrix.check_format(full_check=True)
    return matrix.toarray().astype(np.float64)


def _chumpy_array(value: Record) -> NDArray[Any]:
    """Content of a chumpy array: `x` of a plain one, the selected entries of `a` for a Select."""
    if not isinstance(value.state, dict):
        raise TypeError("a chumpy object without content")
    if "x" in value.state:
        return as_array(value.state["x"])
    if "a" in value.state and "idxs" in value.state:
        indices = as_array(value.state["idxs"]).astype(np.intp)
        if (indices < 0).any():
            raise ValueError("a chumpy object that chooses entries below 0")
        chosen = as_array(value.state["a"]).ravel()[indices]
        shape = value.state.get("preferred_shape")
        return chosen if shape is None else chosen.reshape(as_array(shape).astype(np.intp))
    raise TypeError(f"a chumpy object that is computed from {' '.join(map(str, value.state))[:80]}")
