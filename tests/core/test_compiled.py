"""Kernels: compiled anew when they change, and said so when they are."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

from numba.core.dispatcher import Dispatcher

import shapepose_fg

ROOT = Path(shapepose_fg.__file__).parents[1]

PROGRAM = """
import sys
import numpy as np
from shapepose_fg.core.compiled import kernel, told_of_compiling
@kernel
def largest(values, found):
    found[0] = values[0]
    for value in values:
        found[0] = max(found[0], value)
@kernel
def total(values, found):
    found[0] = values.sum()
found = np.zeros(1)
with told_of_compiling(lambda: print("compiling")):
    for function in (largest, total, largest):
        function(np.array([1.0, 5.0, np.nan]), found)
        print(found[0])
"""


def kernels() -> dict[str, Dispatcher]:
    """All kernels of the package by module and name."""
    found = {}
    for path in sorted((ROOT / "shapepose_fg").rglob("*.py")):
        if "core.compiled import" in path.read_text(encoding="utf-8"):
            module = import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
            found |= {f"{module.__name__}.{k}": v for k, v in vars(module).items() if isinstance(v, Dispatcher)}
    return found


def test_a_kernel_calls_kernels_of_its_own_file_only():
    """Numba reads a compiled function from its cache until the function's own file changes."""
    for name, each in kernels().items():
        function = each.py_func
        if name.startswith(f"{function.__module__}."):
            called = (function.__globals__.get(word) for word in function.__code__.co_names)
            for other in (one for one in called if isinstance(one, Dispatcher)):
                assert other.py_func.__module__ == function.__module__, f"{name} calls {other}"


def test_compiling_is_said_once_and_not_when_it_is_read_from_the_cache(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM, encoding="utf-8")

    def lines() -> list[str]:
        run = [sys.executable, str(program)]
        done = subprocess.run(run, capture_output=True, text=True, timeout=120, check=True, cwd=ROOT)
        return done.stdout.split()

    first = lines()
    assert first[0] == "compiling" and first.count("compiling") == 1
    assert lines() == first[1:]
