"""Kernels: compiled anew when they change, and said so when they are."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import shapepose_fg
from shapepose_fg.core.compiled import KERNELS, signature
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.setup_check.report import check_setup
from shapepose_fg.simulation import built_in_scene, simulate

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


def test_a_kernel_is_compiled_anew_when_a_file_has_changed_that_it_calls_into(tmp_path):
    """Its own file, or one whose part it calls by way of another; else it is read from the cache, wherever it
    stands.
    """
    compiled = "from shapepose_fg.core.compiled import kernel, part\n"
    files = {
        "inner": compiled + "@part\ndef twice(x):\n    return 2 * x\n",
        "outer": compiled + "from inner import twice\n@part\ndef more(x):\n    return twice(x) + 1\n",
        "own": compiled + "from outer import more\n@kernel('f0')\ndef run(x):\n    return more(x)\n",
    }
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    for name, text in files.items():
        (here / f"{name}.py").write_text(text)
    program = "from own import run; print(run(10.0), sum(run.stats.cache_hits.values()))"

    def said(folder: Path = here) -> str:
        where = {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        run = [sys.executable, "-B", "-c", program]
        done = subprocess.run(run, capture_output=True, text=True, timeout=120, check=True, env=os.environ | where)
        return done.stdout.strip()

    assert [said(), said()] == ["21.0 0", "21.0 1"]
    shutil.copytree(here, there)
    (here / "inner.py").write_text(files["inner"].replace("2 * x", "3 * x"))
    assert [said(), said()] == ["31.0 0", "31.0 1"]
    assert said(there) == "21.0 1"


def test_compiling_is_logged_once_and_not_when_it_is_read_from_the_cache(tmp_path):
    def lines() -> list[str]:
        run, cache = [sys.executable, "-c", PROGRAM], os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
        done = subprocess.run(run, capture_output=True, text=True, timeout=120, check=True, cwd=ROOT, env=cache)
        return done.stdout.splitlines()

    first = lines()
    assert "compiling 1 functions for this machine" in first[0] and first[1:] == ["[0]", "[1]"]
    assert lines() == first[1:]


@pytest.mark.slow
def test_what_no_cache_has_is_compiled_side_by_side_by_other_processes(tmp_path):
    """All kernels that are imported, when the first is called; and the same result as here."""
    for name in ("one", "two"):
        text = f"from shapepose_fg.core.compiled import kernel\n@kernel('f1')\ndef {name}(x):\n    x[0] = 3\n"
        (tmp_path / f"{name}.py").write_text(text)
    program = (
        "import numpy as np; from one import one; from two import two; from shapepose_fg.core import compiled\n"
        "compiled._cores, compiled._WORTH_S, x, y = lambda: 2, 0.0, np.ones(4), np.ones(4)\n"
        "one(x); two(y); print(*(sum(each.stats.cache_hits.values()) for each in (one, two)), (x == y).all())"
    )
    where = {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    run = [sys.executable, "-B", "-c", program]
    done = subprocess.run(run, capture_output=True, text=True, timeout=120, check=True, env=os.environ | where)
    assert done.stdout.split() == ["1", "1", "True"]  # neither was compiled there


def test_a_reconstruction_calls_kernels_with_the_types_that_they_name():
    """Each is compiled once: for one more layout of an array it would be compiled again, for seconds."""
    scene = built_in_scene(seed=3, frames=12)
    recording, before = simulate(scene, seed=3), {name: set(each.overloads) for name, each in KERNELS.items()}
    check_setup(recording, scene.rig)
    reconstruct(recording, scene.rig, times=FrameTimes.from_fps(scene.fps, len(scene)))
    used = {name: set(each.overloads) for name, each in KERNELS.items() if len(each.overloads) > 0}
    others = {name: types - {signature(KERNELS[name])} - before.get(name, set()) for name, types in used.items()}
    assert not any(others.values()), others
    assert sum(signature(KERNELS[name]) in types for name, types in used.items()) >= 38
