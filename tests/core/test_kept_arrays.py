"""Sets of arrays that are kept in memory or in a folder: what comes back, and what becomes of the
memory.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.storage.kept_arrays import InFolder, InMemory, KeptArrays


@pytest.fixture(params=["memory", "folder"])
def kept(request, tmp_path) -> KeptArrays:
    return InMemory() if request.param == "memory" else InFolder(tmp_path)


def test_what_is_kept_comes_back(kept):
    rng = np.random.default_rng(0)
    given = {
        "numbers": rng.normal(size=(5, 3, 2)),
        "turned": rng.normal(size=(4, 6)).T,
        "yes": np.array([True, False, True]),
        "small": np.arange(3, dtype=np.uint8),
        "none": np.zeros((0, 4)),
    }
    kept.keep("part-1", given, {"said": [1, "two"]})
    expected = {name: array.copy() for name, array in given.items()}
    given["numbers"][:] = 0  # it is a copy
    assert kept.names("part-") == ["part-1"] and kept.names("other") == []
    assert sorted(kept.keys("part-1")) == sorted(given) and kept.about("part-1") == {
        "said": [1, "two"]
    }
    for name, array in expected.items():
        found = kept.array("part-1", name)
        assert found.dtype == array.dtype and found.shape == array.shape
        np.testing.assert_array_equal(found, array)
    np.testing.assert_array_equal(
        kept.array("part-1", "numbers", slice(1, 3)), expected["numbers"][1:3]
    )
    kept.keep("part-1", {"none": np.zeros((0, 4))})
    assert kept.keys("part-1") == ["none"] and kept.array("part-1", "none").shape == (0, 4)
    kept.drop("part-1")
    kept.drop("part-1")
    assert kept.names("") == []


@pytest.mark.skipif(sys.platform != "linux", reason="looks at memory as Linux shows it")
def test_memory_of_a_dropped_set_goes_back():
    """200 sets of a megabyte, every other one dropped: half of their memory is the system's
    again.
    """

    def used_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

    kept, before = InMemory(), used_mb()
    for n in range(200):
        kept.keep(
            f"part-{n}", {name: np.full(6250, n, dtype=float) for name in map(str, range(20))}
        )
    full = used_mb()
    assert full - before == pytest.approx(200, abs=20)
    for n in range(0, 200, 2):
        kept.drop(f"part-{n}")
    assert full - used_mb() == pytest.approx(100, abs=20)
    assert kept.array("part-7", "3").tolist() == [7] * 6250
