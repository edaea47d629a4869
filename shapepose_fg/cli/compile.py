"""The command `compile`: compiles all kernels ahead of the first run."""

import time
from importlib import import_module
from pathlib import Path

from shapepose_fg.cli.terminal import show
from shapepose_fg.core.errors import InputError


def compile_kernels() -> None:
    """Compile for this machine what the first run would compile, for container images and services.

    The result is stored below NUMBA_CACHE_DIR, or in the user's cache. With NUMBA_CPU_NAME=generic
    it works on other processors.
    """
    from shapepose_fg.core.compiled import KERNELS
    from shapepose_fg.core.compiling import compile_beside
    from shapepose_fg.core.kept_kernels import kept_folder, wanted_folder

    package = Path(__file__).parent.parent
    if kept_folder() != wanted_folder():
        raise InputError(
            f"{wanted_folder()}: cannot be written; set NUMBA_CACHE_DIR to a writable folder"
        )
    for path in sorted(package.rglob("*.py")):
        if "\nfrom shapepose_fg.core.compiled import" in path.read_text(encoding="utf-8"):
            import_module(".".join(path.relative_to(package.parent).with_suffix("").parts))
    start, missing = time.perf_counter(), [each for each in KERNELS.values() if not each.is_kept]
    compile_beside(missing)
    for each in missing:  # kernels that the other processes could not compile
        if not each.is_kept:
            each.load()
    if lost := sum(not each.is_kept for each in KERNELS.values()):
        raise InputError(
            f"{wanted_folder()}: {lost} compiled functions could not be stored; check the free "
            "disk space"
        )
    took = (
        f"compiled in {time.perf_counter() - start:.0f} s" if missing else "were already compiled"
    )
    show(
        f"{len(missing or KERNELS)} functions {took}; {len(KERNELS)} are stored in "
        f"{wanted_folder()}"
    )
