"""The origin of a result: versions of the software, and checksums of the inputs."""

import hashlib
import platform
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib import metadata
from pathlib import Path

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import files_below, open_regular

_PACKAGES = {
    "shapepose-fg": ("shapepose-fg",),
    "numpy": ("numpy",),
    "scipy": ("scipy",),
    "gtsam": ("gtsam",),
    "numba": ("numba",),
    "opencv": ("opencv-python-headless", "opencv-python", "opencv-contrib-python"),
}
"""Distributions that provide each entry of run.json's versions."""


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that affect numerical results; no package is imported
    for this.
    """
    found = {"python": platform.python_version()} | dict.fromkeys(_PACKAGES, "not installed")
    for name, distributions in _PACKAGES.items():
        for distribution in reversed(distributions):
            with suppress(metadata.PackageNotFoundError):
                found[name] = metadata.version(distribution)
    return found


_INPUTS = (".txt", ".json", ".toml", ".yml", ".yaml", ".xml")
"""Suffixes of the files in a folder that count as inputs: calibrations and detections."""


def checksums(inputs: Iterable[str | Path]) -> dict[str, str]:
    """SHA-256 of every input file; for a folder, one checksum of the names and contents of its data
    files.

    Thus a recording of 10,000 JSON files is one line of run.json, and a renamed or missing file
    changes it.
    """
    return {str(path): _digest(Path(path), _INPUTS) for path in inputs}


class ReadInputs:
    """Detects input files that change while they are read.

    Create it before reading starts, and call `checksums` when everything has been read.
    """

    def __init__(self, paths: Iterable[str | Path | None]) -> None:
        self._before = dict(_states(paths))

    def checksums(self, inputs: Iterable[str | Path | None]) -> dict[str, str]:
        """`checksums` of the files that were read; InputError if one of them has changed since this
        object was created.

        `inputs` are files and folders given to the constructor, or lie in these.
        """
        inputs = [path for path in inputs if path is not None]
        found = checksums(inputs)
        for file, state in _states(inputs):
            if self._before.get(file) != state:
                raise InputError(
                    f"{file}: this file changed while it was read; start again when it is complete"
                )
        return found


def program_digest() -> str:
    """SHA-256 of this program and its data: equal for runs of the same version."""
    package_folder, data = Path(__file__).parent.parent, (".py", ".npz", ".json", ".safetensors")
    parts = (
        _digest(package, data) for package in (package_folder, package_folder.with_name("factors"))
    )
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()


def _states(paths: Iterable[str | Path | None]) -> Iterator[tuple[str, int]]:
    """Size and modification time, as one number, of files, and of the data files in folders.

    Only path and number are kept, because hours of footage are half a million files.
    """
    for path in (Path(path) for path in paths if path is not None):
        for file in files_below(path, _INPUTS) if path.is_dir() else (path,):
            with suppress(OSError):
                state = file.stat()
                yield str(file), state.st_size << 64 | state.st_mtime_ns


def _digest(path: Path, endings: tuple[str, ...]) -> str:
    """SHA-256, hexadecimal, of a file; for a folder, of its files with these suffixes."""
    try:
        if path.is_dir():
            whole = hashlib.sha256()
            for file in sorted(files_below(path, endings)):
                whole.update(
                    f"{file.relative_to(path).as_posix()} {_digest(file, endings)}\n".encode()
                )
            return whole.hexdigest()
        with open_regular(path) as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
