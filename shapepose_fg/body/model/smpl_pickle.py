"""Reads the official SMPL `.pkl` without running anything that it names.

The few names that SMPL's files need (numpy arrays, scipy sparse matrices, chumpy arrays) stand for records of what
the file says (`pickle_records`); arrays are made from those records here.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.pickle_records import Name, Record, RefusedPickle, read_records
from shapepose_fg.core.storage.files import read_bytes

_MOST_BYTES = 2**30
"""SMPL's own files have 40 to 250 MB."""
_MOST_DENSE = 2**23
"""Entries of a sparse matrix when it is written out: 24 joints from 350,000 vertices."""
_CORES = ("core", "_core")
_RECONSTRUCT = {Name(f"numpy.{core}.multiarray", "_reconstruct") for core in _CORES}
_SCALAR = {Name(f"numpy.{core}.multiarray", "scalar") for core in _CORES}
_FROM_BUFFER = {Name(f"numpy.{core}.numeric", "_frombuffer") for core in _CORES}
_DTYPE = {Name("numpy", "dtype")}
_BYTES = {Name("_codecs", "encode")}
_COLUMNS = {Name(f"scipy.sparse{part}", "csc_matrix") for part in ("", ".csc", "._csc")}
_ROWS = {Name(f"scipy.sparse{part}", "csr_matrix") for part in ("", ".csr", "._csr")}
_OTHERS = {Name("numpy", "ndarray"), Name("__builtin__", "object"), Name("builtins", "object")}
_KNOWN = _RECONSTRUCT | _SCALAR | _FROM_BUFFER | _DTYPE | _BYTES | _COLUMNS | _ROWS | _OTHERS


def _is_chumpy(name: Name) -> bool:
    return name.module == "chumpy" or name.module.startswith("chumpy.")


def read_smpl_pickle(path: Path) -> dict[str, Any]:
    """The entries of a pickled dict; those that are arrays or sparse matrices are undone by `as_array`.

    Raises RefusedPickle where the file asks for anything but data, and whatever a damaged pickle raises.
    """
    content = read_records(read_bytes(path, _MOST_BYTES), lambda name: name in _KNOWN or _is_chumpy(name))
    if not isinstance(content, dict):
        raise RefusedPickle(f"it holds a {type(content).__name__} where SMPL's files hold a dict")
    return {str(name): value for name, value in content.items()}


def as_array(value: Any) -> NDArray[Any]:
    """The array that a record stands for; ValueError or TypeError where it stands for none."""
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
    """The dtype that a record names: plain numbers only, never Python objects."""
    if not isinstance(record, Record) or record.name not in _DTYPE:
        raise TypeError("an array without a dtype")
    name = record.arguments[0]
    if not isinstance(name, str) or name[:1] not in ("f", "i", "u", "b") or not name[1:].isdigit():
        raise TypeError(f"arrays of {str(name)[:20]!r} are not numbers")
    byte_order = record.state[1] if isinstance(record.state, tuple) and len(record.state) > 1 else "="
    return np.dtype(name).newbyteorder(byte_order if byte_order in ("<", ">") else "=")


def _raw_bytes(value: Any) -> bytes:
    """Raw memory as the different pickle protocols write it."""
    if isinstance(value, Record) and value.name in _BYTES:
        text, encoding = value.arguments
        if encoding != "latin1":
            raise TypeError("bytes written in another way than NumPy does")
        return text.encode("latin1")
    if isinstance(value, str):
        return value.encode("latin1")
    if isinstance(value, bytes | bytearray):
        return bytes(value)
    raise TypeError(f"an array made of {type(value).__name__}")


def _sparse_array(value: Record) -> NDArray[np.float64]:
    """The dense form of a compressed sparse matrix."""
    state = value.state
    shape = as_array(state["_shape"] if "_shape" in state else state["shape"]).astype(np.int64)
    content, minor, starts = (as_array(state[name]) for name in ("data", "indices", "indptr"))
    by_column = value.name in _COLUMNS
    if shape.shape != (2,) or not 0 < shape.prod() <= _MOST_DENSE or not (shape > 0).all():
        raise ValueError(f"a sparse matrix of {shape.tolist()} entries")
    across, along = shape.tolist() if by_column else shape.tolist()[::-1]
    steps = np.diff(starts)
    if (
        len(starts) != along + 1
        or (steps < 0).any()
        or starts[0] != 0
        or not starts[-1] == len(content) == len(minor)
    ):
        raise ValueError("a sparse matrix whose entries are not where it says")
    if len(minor) > 0 and not 0 <= minor.min() <= minor.max() < across:
        raise ValueError(f"a sparse matrix with entries outside its {shape.tolist()}")
    major = np.repeat(np.arange(along), steps.astype(np.intp))
    dense = np.zeros(tuple(shape.tolist()))
    where = (minor, major) if by_column else (major, minor)
    np.add.at(dense, tuple(each.astype(np.intp) for each in where), content)
    return dense


def _chumpy_array(value: Record) -> NDArray[Any]:
    """The content of a chumpy array: `x` of a plain one, the chosen entries of `a` of a Select."""
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
