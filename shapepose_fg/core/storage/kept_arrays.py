"""Named sets of arrays that are kept while a run goes on: in memory, or as files that survive the process."""

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

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import write_content

Arrays = Mapping[str, NDArray[Any]]
"""Arrays of numbers by name."""
_SUFFIX = ".safetensors"
_ALIGNED = 64
"""Bytes; arrays begin at multiples of it."""


class KeptArrays:
    """Sets of arrays, each under a name, with what is to be said about it as plain values; here in memory.

    That of a set that is dropped goes back to the system at once.
    """

    lasting = False
    """Whether they outlive this process."""

    def __init__(self) -> None:
        self._sets: dict[str, tuple[Arrays, Any]] = {}

    def names(self, prefix: str) -> list[str]:
        """Names of the sets that begin with `prefix`, in order."""
        return sorted(name for name in self._sets if name.startswith(prefix))

    def keep(self, name: str, arrays: Arrays, about: Any = None) -> None:
        """Keep a set, whole or not at all; one of the same name is replaced."""
        self._sets[name] = (_mapped(arrays), about)

    def drop(self, name: str) -> None:
        """Forget a set, if there is one."""
        self._sets.pop(name, None)

    def about(self, name: str) -> Any:
        """What is said about a set."""
        return self._sets[name][1]

    def array(self, name: str, key: str, rows: slice = slice(None)) -> NDArray[Any]:
        """Rows of an array of a set."""
        return self._sets[name][0][key][rows]

    def keys(self, name: str) -> list[str]:
        """Which arrays a set has."""
        return list(self._sets[name][0])


InMemory = KeptArrays


def _mapped(arrays: Arrays) -> Arrays:
    """Copies in a mapping of their own. Freed between others, the allocator's would stay with the process."""
    starts = np.cumsum([0, *(-(-array.nbytes // _ALIGNED) * _ALIGNED for array in arrays.values())]).tolist()
    if starts[-1] == 0:
        return {key: array.copy() for key, array in arrays.items()}
    memory = mmap.mmap(-1, starts[-1], flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    copies = {}
    for start, (key, array) in zip(starts, arrays.items(), strict=False):
        copies[key] = np.ndarray(array.shape, array.dtype, memory, start)
        copies[key][...] = array
    return copies


class InFolder(KeptArrays):
    """The same as a file per set: safetensors, which holds no code and gives single arrays and rows of them.

    A file is on the disk when `keep` returns. Reading raises InputError that names a file that is damaged.
    """

    lasting = True

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def names(self, prefix: str) -> list[str]:
        found = (file.name for file in self.folder.glob(f"*{_SUFFIX}") if not file.name.startswith("."))
        return sorted(name.removesuffix(_SUFFIX) for name in found if name.startswith(prefix))

    def keep(self, name: str, arrays: Arrays, about: Any = None) -> None:
        content = {key: np.ascontiguousarray(array) for key, array in arrays.items()}
        write_content(self._file(name), save(content, {"about": json.dumps(about)}))

    def drop(self, name: str) -> None:
        self._file(name).unlink(missing_ok=True)

    def about(self, name: str) -> Any:
        with self._opened(name) as file:
            return json.loads(file.metadata()["about"])

    def array(self, name: str, key: str, rows: slice = slice(None)) -> NDArray[Any]:
        with self._opened(name) as file:
            return file.get_tensor(key) if rows == slice(None) else file.get_slice(key)[rows]

    def keys(self, name: str) -> list[str]:
        with self._opened(name) as file:
            return list(file.keys())

    def _file(self, name: str) -> Path:
        return self.folder / f"{name}{_SUFFIX}"

    @contextmanager
    def _opened(self, name: str) -> Iterator[Any]:
        """A file of arrays; what is wrong with it, now or when it is read, is an InputError."""
        try:
            with safe_open(self._file(name), framework="numpy") as content:
                yield content
        except (OSError, SafetensorError, KeyError, TypeError, json.JSONDecodeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(
                f"{self._file(name)}: a part of an unfinished run cannot be read ({reason}); begin that run anew"
                " with --restart"
            ) from None
