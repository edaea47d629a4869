"""Reads the official SMPL `.pkl` without running anything that it names.

A pickle is a program: loading one from the internet can do whatever Python can. Here no class or function
of the outside is ever looked up. The few names that SMPL's files need (numpy arrays, scipy sparse matrices, chumpy
arrays) stand for records that only remember what the file says; arrays are made from those records afterwards.
"""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


class RefusedPickle(Exception):
    """The pickle asks for something that a body model does not need."""


class _Record:
    """What the pickle says of one object: the arguments it was called with and its state."""

    kind = "object"

    def __init__(self, *arguments: Any):
        self.arguments = arguments
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Record):
    kind = "array"


class _Dtype(_Record):
    kind = "dtype"


class _Scalar(_Record):
    kind = "scalar"


class _FromBuffer(_Record):
    kind = "buffer"


class _Bytes(_Record):
    kind = "bytes"


class _Sparse(_Record):
    kind = "sparse"


class _Columns(_Sparse):
    """A compressed sparse column matrix."""


class _Rows(_Sparse):
    """A compressed sparse row matrix."""


class _Chumpy(_Record):
    kind = "chumpy"


class _Plain(_Record):
    """Python's own `object`, which old pickles name as a base class."""


class _Rebuilt:
    """`copy_reg._reconstructor(cls, object, None)`: an empty record of that kind."""

    def __new__(cls, made: Any, *_: Any) -> Any:
        if not (isinstance(made, type) and issubclass(made, _Record)):
            raise RefusedPickle("copy_reg._reconstructor of something that is not an array")
        return made()


_NAMES: dict[tuple[str, str], type] = {
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _Array for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _Scalar for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _FromBuffer for core in ("core", "_core")},
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _Bytes,
    **{(f"scipy.sparse{part}", "csc_matrix"): _Columns for part in ("", ".csc", "._csc")},
    **{(f"scipy.sparse{part}", "csr_matrix"): _Rows for part in ("", ".csr", "._csr")},
    **{(module, "_reconstructor"): _Rebuilt for module in ("copy_reg", "copyreg")},
    **{(module, "object"): _Plain for module in ("__builtin__", "builtins")},
}


class _Unpickler(pickle.Unpickler):
    """Knows the names above and chumpy's, and looks none of them up."""

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        if module_name == "chumpy" or module_name.startswith("chumpy."):
            return _Chumpy
        if (module_name, global_name) not in _NAMES:
            raise RefusedPickle(f"it asks for {module_name}.{global_name}, which no body model needs")
        return _NAMES[module_name, global_name]


def read_smpl_pickle(path: Path) -> dict[str, Any]:
    """The entries of a pickled dict; those that are arrays or sparse matrices are undone by `as_array`.

    Raises RefusedPickle where the file asks for anything but data, and whatever a damaged pickle raises.
    """
    with path.open("rb") as file:
        content = _Unpickler(file, encoding="latin1").load()  # Python 2 wrote the official files
    if not isinstance(content, dict):
        raise RefusedPickle(f"it holds a {type(content).__name__} where SMPL's files hold a dict")
    return {str(name): value for name, value in content.items()}


def as_array(value: Any) -> NDArray[Any]:
    """The array that a record stands for; ValueError or TypeError where it stands for none."""
    if isinstance(value, _Chumpy):
        return _chumpy_array(value)
    if isinstance(value, _Sparse):
        return _sparse_array(value)
    if isinstance(value, _FromBuffer):
        buffer, dtype, shape, order = value.arguments
        return _shaped(_raw_bytes(buffer), dtype, shape, order)
    if isinstance(value, _Scalar):
        return _shaped(_raw_bytes(value.arguments[1]), value.arguments[0], (), "C")
    if isinstance(value, _Array):
        _, shape, dtype, fortran, content = value.state
        return _shaped(_raw_bytes(content), dtype, shape, "F" if fortran else "C")
    if isinstance(value, list | tuple | int | float):
        return np.asarray(value, dtype=np.float64)
    raise TypeError(f"{type(value).__name__} is not an array")


def _shaped(content: bytes, dtype: Any, shape: Any, order: str) -> NDArray[Any]:
    return np.frombuffer(content, dtype=_number_type(dtype)).reshape(shape, order=order)  # type: ignore[call-overload]


def _number_type(record: Any) -> np.dtype[Any]:
    """The dtype that a record names: plain numbers only, never Python objects."""
    if not isinstance(record, _Dtype):
        raise TypeError("an array without a dtype")
    name = record.arguments[0]
    if not isinstance(name, str) or name[:1] not in ("f", "i", "u", "b") or not name[1:].isdigit():
        raise TypeError(f"arrays of {name!r} are not numbers")
    byte_order = record.state[1] if isinstance(record.state, tuple) and len(record.state) > 1 else "="
    return np.dtype(name).newbyteorder(byte_order if byte_order in ("<", ">") else "=")


def _raw_bytes(value: Any) -> bytes:
    """Raw memory as the different pickle protocols write it."""
    if isinstance(value, _Bytes):
        text, encoding = value.arguments
        if encoding != "latin1":
            raise TypeError(f"bytes written as {encoding!r}")
        return text.encode("latin1")
    if isinstance(value, str):
        return value.encode("latin1")
    if isinstance(value, bytes | bytearray):
        return bytes(value)
    raise TypeError(f"an array made of {type(value).__name__}")


def _sparse_array(value: _Sparse) -> NDArray[np.float64]:
    """The dense form of a compressed sparse matrix."""
    state = value.state
    shape = state["_shape"] if "_shape" in state else state["shape"]
    content, minor, starts = (as_array(state[name]) for name in ("data", "indices", "indptr"))
    major = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    dense = np.zeros(tuple(int(n) for n in shape))
    where = (minor, major) if isinstance(value, _Columns) else (major, minor)
    np.add.at(dense, where, content)
    return dense


def _chumpy_array(value: _Chumpy) -> NDArray[Any]:
    """The content of a chumpy array: `x` of a plain one, the chosen entries of `a` of a Select."""
    if not isinstance(value.state, dict):
        raise TypeError("a chumpy object without content")
    if "x" in value.state:
        return as_array(value.state["x"])
    if "a" in value.state and "idxs" in value.state:
        chosen = as_array(value.state["a"]).ravel()[as_array(value.state["idxs"]).astype(np.intp)]
        shape = value.state.get("preferred_shape")
        return chosen if shape is None else chosen.reshape(as_array(shape).astype(np.intp))
    raise TypeError(f"a chumpy object that is computed from {' '.join(map(str, value.state))}")
