"""Kernels: compiled anew when they change, and said so when they are."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

from numba.core.dispatcher import Dispatcher

import shapepose_fg

ROOT = Path(shapepose_fg.__file__).parents[1]

PROGRAM = """
import logging
import sys
import numpy as np
from numba import njit
logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
from shapepose_fg.proposal.assignment import match_best_first
njit(lambda x: x + 1)(1.0)  # one of the user's own
for score in ([0.5, 0.2], [0.1, 0.2]):
    print(match_best_first(np.array([0, 0]), np.array([0, 1]), np.array(score)).tolist())
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


def test_compiling_is_logged_once_and_not_when_it_is_read_from_the_cache(tmp_path):
    def lines() -> list[str]:
        run, cache = [sys.executable, "-c", PROGRAM], os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
        done = subprocess.run(run, capture_output=True, text=True, timeout=120, check=True, cwd=ROOT, env=cache)
        return done.stdout.splitlines()

    first = lines()
    assert "compiling for this machine" in first[0] and first[1:] == ["[0]", "[1]"]
    assert lines() == first[1:]
