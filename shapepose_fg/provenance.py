"""Where a result comes from: versions of what ran, and checksums of what was read."""

import hashlib
import platform
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

from shapepose_fg.errors import InputError

_PACKAGES = {
    "shapepose-fg": ("shapepose-fg",),
    "numpy": ("numpy",),
    "scipy": ("scipy",),
    "gtsam": ("gtsam",),
    "torch": ("torch",),
    "opencv": ("opencv-python-headless", "opencv-python", "opencv-contrib-python"),
}
"""Name in run.json, and the distributions that provide it."""


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide about numbers; nothing is imported for it."""
    found = {"python": platform.python_version()}
    for name, distributions in _PACKAGES.items():
        found[name] = next(filter(None, map(_version, distributions)), "not installed")
    return found


_INPUTS = (".txt", ".json", ".toml", ".yml", ".yaml", ".xml")
"""Files of a folder that may be read: calibrations and detections."""


def checksums(inputs: Iterable[str | Path]) -> dict[str, str]:
    """sha256 of every input file; of a folder, of its files of numbers by name and content.

    A recording of 10,000 JSON files is one line of run.json, and a file renamed or lost changes it.
    """
    return {str(path): _digest(Path(path)) for path in inputs}


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _digest(path: Path) -> str:
    """sha256 in hexadecimal."""
    try:
        if path.is_dir():
            files = sorted(file for file in path.rglob("*") if file.suffix in _INPUTS)
            whole = hashlib.sha256()
            for file in files:
                whole.update(f"{file.relative_to(path).as_posix()} {_digest(file)}\n".encode())
            return whole.hexdigest()
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
