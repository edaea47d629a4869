"""The results folder: tested for writing before a long run, and locked for one run at a time."""

import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import sweep

_LOCK = ".lock"


def prepare_output(folder: Path, names: Iterable[str] = ()) -> None:
    """Make the folder, and test whether the files `names` can be written there; InputError if
    not.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as trial:
            trial.write(b"trial")
    except OSError as error:
        problem = f"results cannot be written here ({error.strerror})"
        raise InputError(f"{folder}: {problem}; give a writable folder") from None
    for name in names:
        if (folder / name).exists() and not (folder / name).is_file():
            what = "folder" if (folder / name).is_dir() else "pipe"
            raise InputError(
                f"{folder / name}: this is a {what}, but a file must be written here; move it"
            )


@contextmanager
def only_run_in(folder: Path, names: Iterable[str]) -> Iterator[None]:
    """Call `prepare_output`, and lock the folder for this run during the block; InputError if
    another run has locked it.

    Temporary files of a killed run are removed, and so is a new folder if it stays empty. The lock
    is one of the operating system, so it always ends with the process.
    """
    names, is_new = tuple(names), not folder.exists()
    prepare_output(folder, names)
    file = folder / _LOCK
    if file.is_symlink() or (file.exists() and not file.is_file()):
        raise InputError(f"{file}: this is a link or a pipe, not a file of a run; remove it")
    lock = FileLock(file, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        number = file.read_text().strip() if file.is_file() else ""
        process = f" (process {number})" if number.isdecimal() else ""
        raise InputError(
            f"{folder}: another run writes its results here{process}; wait for it, or give another "
            "--output"
        ) from None
    try:
        file.write_text(f"{os.getpid()}\n")
        for name in names:
            sweep(folder, name)
        yield
    finally:
        # Removed before the lock is released: a waiting run then sees that the file is gone, and
        # makes a new one.
        file.unlink(missing_ok=True)
        lock.release()
        if is_new:
            with suppress(OSError):  # not empty
                folder.rmdir()
