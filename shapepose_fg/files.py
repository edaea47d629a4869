"""Files, read with one clear error and written whole or not at all."""

import glob
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from shapepose_fg.errors import InputError


def read_text(path: Path, *, may_be_empty: bool = False) -> str:
    """Text of the UTF-8 file at `path`; InputError where it is missing, unreadable, not text, or empty."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; check the path") from None
    except IsADirectoryError:
        raise InputError(f"{path}: this is a folder; give the file inside it") from None
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: byte {error.start} is not UTF-8 text; check that this is the file that you mean"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
    if not may_be_empty and not text.strip():
        raise InputError(f"{path}: the file is empty; write or copy it again")
    return text


def read_json(path: Path) -> Any:
    """Value of the JSON file at `path`; InputError that names the line, also for a key that occurs twice.

    NaN and Infinity are let through as floats: who checks the values names their key.
    """
    text = read_text(path)
    try:
        return json.loads(text, object_pairs_hook=lambda pairs: _unique(pairs, path))
    except json.JSONDecodeError as error:
        cut = " (the file ends too early)" if error.pos >= len(text.rstrip()) else ""
        raise InputError(
            f"{path}: line {error.lineno} column {error.colno} is not JSON: {error.msg}{cut};"
            " correct it there or write the file again"
        ) from None
    except InputError:
        raise
    except (ValueError, RecursionError) as error:  # an integer of 5,000 digits, or 10,000 open brackets
        raise InputError(f"{path}: cannot be read as JSON ({error}); write the file again") from None


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then put it in place in one step.

    Whoever reads `path`, whenever this process dies, finds the old file or the whole new one. OSError that names
    `path` where that fails.
    """
    write_together({path: write})


def write_together(files: Mapping[Path, Callable[[BinaryIO], object]]) -> None:
    """`write_atomically` of several files in order, none of which is put in place before all are complete."""
    temporary: dict[Path, Path] = {}
    try:
        for path, write in files.items():
            with _naming(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=_PART)
                temporary[path] = Path(name)
                with os.fdopen(handle, "wb") as stream:
                    write(stream)
                    stream.flush()
                    os.fsync(stream.fileno())
                Path(name).chmod(0o666 & ~_umask())  # mkstemp makes files that only their owner reads
        for path in files:
            with _naming(path):
                temporary[path].replace(path)
            del temporary[path]
    finally:
        for left in temporary.values():
            left.unlink(missing_ok=True)
    for folder in {path.parent for path in files}:
        _sync_folder(folder)


def sweep(folder: Path, name: str | None = None) -> None:
    """Remove what a killed process was writing in `folder`, as the file `name` or as any.

    Nobody else may be writing there.
    """
    for left in folder.glob(f".*{_PART}" if name is None else f".{glob.escape(name)}.*{_PART}"):
        left.unlink(missing_ok=True)


_PART = ".part"
"""What temporary files end with."""


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """An OSError inside the block names `path`, where it names none, or a temporary file beside `path`."""
    try:
        yield
    except OSError as error:
        if error.filename is not None and not Path(str(error.filename)).name.startswith(f".{path.name}."):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def _unique(pairs: list[tuple[str, Any]], path: Path) -> dict[str, Any]:
    """An object's members, if no key occurs twice: JSON itself would keep the last one in silence."""
    members = dict(pairs)
    if len(members) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise InputError(f'{path}: key "{twice}" occurs twice in one object; give each its own name')
    return members


def _umask() -> int:
    """The process's file mode mask; it can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _sync_folder(folder: Path) -> None:
    """Make the new name itself survive a power cut, where the system can."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:  # some network file systems cannot
        pass
    finally:
        os.close(descriptor)
