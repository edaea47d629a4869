"""The cache of compiled functions between runs.

Numba caches compiled functions next to their source file, and discards them if this file changes.
Here each module with kernels has a cache folder with a copy of its source, next to which Numba
caches. The folder is named by a digest of the sources of the module and of everything that its
kernels call. The cache is therefore never stale, and is shared by all installations of a user.
"""

import atexit
import hashlib
import os
import shutil
import sys
import tempfile
import uuid
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any, cast

import numba
from llvmlite.binding import get_host_cpu_features, get_host_cpu_name

from shapepose_fg.core.storage.files import user_cache

OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "nogil": True,
    "fastmath": {"contract", "reassoc"},
    "no_cfunc_wrapper": True,
}
"""Options of Numba for all compiled functions."""
NUMBA: Any = cast(Any, numba).config
"""Numba's own settings, from its environment variables."""
_GIVEN = "SHAPEPOSE_FG_KERNELS"
"""Environment variable by which a process passes the path of its temporary folder to its child
processes."""


def wanted_folder() -> Path:
    """The folder for compiled functions: below NUMBA_CACHE_DIR, or in the user's cache."""
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(given).absolute() / "shapepose-fg"
    return user_cache("kernels").absolute()


@cache
def kept_folder() -> Path | None:
    """The folder that is used for compiled functions: the wanted one; if it is not writable, a
    temporary folder of this process and its children; None if neither can be written.
    """
    wanted = wanted_folder()
    if given := os.environ.get(_GIVEN):
        return Path(given)
    if _can_keep(wanted):
        return wanted
    try:
        temporary, owner = Path(tempfile.mkdtemp(prefix="shapepose-fg-kernels-")), os.getpid()
        atexit.register(
            lambda: os.getpid() != owner or shutil.rmtree(temporary, ignore_errors=True)
        )
        if _can_keep(temporary):
            os.environ[_GIVEN] = str(temporary)
            return temporary
    except OSError:
        pass
    return wanted if os.path.isdir(wanted) else None  # noqa: PTH112


def _can_keep(place: Path) -> bool:
    try:
        place.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=place).close()
        # Minimum free space on the disk, bytes: ten times the size of all kernels.
        return shutil.disk_usage(place).free > 50_000_000
    except OSError:
        return False


@cache
def module_folder(module: str) -> Path | None:
    """The folder of a module's kernels, with a copy of its source; None if nothing can be
    written.
    """
    place, source = kept_folder(), Path(sys.modules[module].__file__ or "")
    if place is None:
        return None
    folder = place / f"{module}-{_digest(module)}"
    if folder.exists():
        return folder
    fresh, elsewhere = place / f"{uuid.uuid4()}", wanted_folder() / folder.name
    try:
        if elsewhere.exists():  # readable, but not writable
            shutil.copytree(elsewhere, fresh, copy_function=os.symlink)
        else:
            fresh.mkdir()
            (fresh / source.name).write_bytes(source.read_bytes())
            os.utime(
                fresh / source.name, (0, 0)
            )  # older versions of Numba check the time, not the content
        if not folder.exists():
            fresh.rename(folder)
        _remove_old(place, module)
    except OSError:
        return folder if folder.exists() else None
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return folder


def _remove_old(place: Path, module: str) -> None:
    by_age = sorted(place.glob(f"{module}-*"), key=lambda each: each.stat().st_mtime, reverse=True)
    # Maximum number of cached folders per module: for several checkouts, Python versions,
    # processors.
    for each in by_age[16:]:
        shutil.rmtree(each, ignore_errors=True)


def kept_in(folder: Path, function: Any, njit: Callable[[Any], Any]) -> Any:
    """Apply `njit` to a copy of `function` from the source file in `folder`, next to which Numba's
    cache then is.
    """
    code = function.__code__.replace(
        co_filename=str(folder / Path(function.__code__.co_filename).name)
    )
    copy = FunctionType(code, function.__globals__, function.__name__, function.__defaults__)
    copy.__qualname__ = function.__qualname__
    given, NUMBA.CACHE_DIR = NUMBA.CACHE_DIR, ""
    try:
        return njit(copy)
    finally:
        NUMBA.CACHE_DIR = given


@cache
def _digest(module: str) -> str:
    """Digest of the sources of a module's kernels, the versions of Numba and Python, and the
    processor type.
    """
    given = NUMBA.CPU_FEATURES
    features = get_host_cpu_features().flatten() if given is None else given
    options = sorted(
        f"{name}={sorted(each) if isinstance(each, set) else each}"
        for name, each in OPTIONS.items()
    )
    host = (
        options,
        numba.__version__,
        sys.implementation.cache_tag,
        NUMBA.CPU_NAME or get_host_cpu_name(),
        features,
    )
    state = hashlib.sha256(repr(host).encode())
    for content in sorted(Path(each).read_bytes() for each in _sources(module)):
        state.update(content)
    return state.hexdigest()[:16]


@cache
def _sources(module: str) -> frozenset[str]:
    """Source files of a module and of all modules from which its kernels call kernels or parts."""
    inside = (getattr(each, "py_func", None) for each in vars(sys.modules[module]).values())
    others = {each.__module__ for each in inside if each is not None} - {module}
    return frozenset({str(sys.modules[module].__file__)}).union(*map(_sources, others))
