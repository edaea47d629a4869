"""Named sets of arrays that are stored during a run: in memory, or in files that survive the
process.
"""

import hashlib
import json
import mmap
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from shapepose_fg.core.errors import naming
from shapepose_fg.core.storage.files import LARGE, inside, open_regular, write_content
from shapepose_fg.core.storage.schema import Column, checked_columns

Arrays = Mapping[str, NDArray[Any]]
"""Arrays of numbers by name."""
_SUFFIX = ".safetensors"
ANEW = "start that run again with --restart"
"""Cure in error messages about a damaged set."""
_ALIGNED = 64
"""Alignment of arrays, bytes."""


class KeptArrays:
    """Sets of arrays by name, each with plain values about it; stored in memory.

    When a set is dropped, its memory is returned to the system immediately.
    """

    lasting = False
    """Whether the arrays survive this process."""

    def __init__(self) -> None:
        self._sets: dict[str, tuple[Arrays, Any]] = {}

    def names(self, prefix: str) -> list[str]:
        """Names of the sets that begin with `prefix`, sorted."""
        return sorted(name for name in self._sets if name.startswith(prefix))

    def keep(self, name: str, arrays: Arrays, about: Any = None) -> None:
        """Store a set atomically; replaces one of the same name."""
        self._sets[name] = (_mapped(arrays), about)

    def drop(self, name: str) -> None:
        """Remove a named set of arrays, if it exists."""
        self._sets.pop(name, None)

    def about(self, name: str) -> Any:
        """The plain values about a set."""
        return self._sets[name][1]

    def array(self, name: str, key: str, rows: slice = slice(None)) -> NDArray[Any]:
        """Rows of one array of a set."""
        return self._sets[name][0][key][rows]

    def keys(self, name: str) -> list[str]:
        """Names of the arrays of a set."""
        return list(self._sets[name][0])

    def place(self, name: str) -> str:
        """Description of where a set is stored, for messages."""
        return name

    def columns(
        self, name: str, columns: Mapping[str, Column], sizes: dict[str, int]
    ) -> dict[str, NDArray[Any]]:
        """Arrays of a set; InputError if one does not match its column, or these `sizes`."""
        with naming(self.place(name), ANEW):
            return checked_columns(columns, {key: self.array(name, key) for key in columns}, sizes)


InMemory = KeptArrays


def _mapped(arrays: Arrays) -> Arrays:
    """Copies of arrays in a separate memory mapping, which is released immediately when they are
    deleted; memory of the allocator would remain in use.
    """
    starts = np.cumsum(
        [0, *(-(-array.nbytes // _ALIGNED) * _ALIGNED for array in arrays.values())]
    ).tolist()
    if starts[-1] == 0:
        return {key: array.copy() for key, array in arrays.items()}
    memory = mmap.mmap(-1, starts[-1], flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    copies = {}
    for start, (key, array) in zip(starts, arrays.items(), strict=False):
        copies[key] = np.ndarray(array.shape, array.dtype, memory, start)
        copies[key][...] = array
    return copies


class InFolder(KeptArrays):
    """Arrays stored in a folder, one safetensors file per set: the format contains no code and
    allows reading single arrays and rows.

    When `keep` returns, the file is on disk. It has a digest of each array, and one of all these
    digests, its name and its run. An array is verified when it is first read, and again if the file
    has changed. InputError names a damaged file.
    """

    lasting = True

    def __init__(self, folder: Path, run: str = "") -> None:
        """`run` identifies the run of the arrays: files of another run are refused."""
        self.folder, self.run = folder, run
        self._checked: dict[tuple[str, str | None], tuple[int, ...]] = {}

    def names(self, prefix: str) -> list[str]:
        found = (
            file.name for file in self.folder.glob(f"*{_SUFFIX}") if not file.name.startswith(".")
        )
        return sorted(name.removesuffix(_SUFFIX) for name in found if name.startswith(prefix))

    def keep(self, name: str, arrays: Arrays, about: Any = None) -> None:
        content = {key: np.ascontiguousarray(array) for key, array in arrays.items()}
        arrays_text = json.dumps({key: _digest(key, array) for key, array in content.items()})
        metadata = {"about": json.dumps(about), "arrays": arrays_text}
        write_content(
            self._file(name), save(content, metadata | {"sha256": self._seal(name, metadata)})
        )

    def drop(self, name: str) -> None:
        self._file(name).unlink(missing_ok=True)

    def about(self, name: str) -> Any:
        with self._opened(name) as file:
            return json.loads(file.metadata()["about"])

    def array(self, name: str, key: str, rows: slice = slice(None)) -> NDArray[Any]:
        with self._opened(name, key) as file:
            return file.get_tensor(key) if rows == slice(None) else file.get_slice(key)[rows]

    def keys(self, name: str) -> list[str]:
        with self._opened(name) as file:
            return list(json.loads(file.metadata()["arrays"]))

    def place(self, name: str) -> str:
        return str(self._file(name))

    def _file(self, name: str) -> Path:
        return self.folder / f"{name}{_SUFFIX}"

    def _seal(self, name: str, metadata: Mapping[str, str]) -> str:
        """Digest of all metadata of a file, which include the digests of its arrays."""
        return hashlib.sha256(
            json.dumps([self.run, name, metadata["about"], metadata["arrays"]]).encode()
        ).hexdigest()

    @contextmanager
    def _opened(self, name: str, key: str | None = None) -> Iterator[Any]:
        """Open a file of arrays; its metadata and the array `key` are verified by their digests.

        InputError if it is damaged, now or when it is read.
        """
        file = self._file(name)
        words = "a part of an interrupted run cannot be read ({})"
        kinds = OSError, SafetensorError, KeyError, TypeError, ValueError, RecursionError
        with naming(file, ANEW, words, *kinds):
            status = file.stat() if file.exists() else None
            stamp = () if status is None else (status.st_ino, status.st_size, status.st_mtime_ns)
            if self._checked.get((name, None)) != stamp:
                open_regular(inside(self.folder, file.name), ANEW, LARGE).close()
            with safe_open(file, framework="numpy") as content:
                metadata, right = content.metadata() or {}, True
                if self._checked.get((name, None)) != stamp:
                    right = metadata.keys() == {"about", "arrays", "sha256"} and metadata[
                        "sha256"
                    ] == self._seal(name, metadata)
                if right and key is not None and self._checked.get((name, key)) != stamp:
                    right = json.loads(metadata["arrays"])[key] == _digest(
                        key, content.get_tensor(key)
                    )
                if not right:
                    raise ValueError("its content has changed, or it belongs to another run")
                self._checked[name, None] = self._checked[name, key] = stamp
                yield content


def _digest(key: str, array: NDArray[Any]) -> str:
    """Digest of an array: its name, type, shape and bytes."""
    digest = hashlib.sha256(json.dumps([key, array.dtype.str, array.shape]).encode())
    digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()
