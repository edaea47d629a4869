"""scripts/benchmark.py: that it measures what it says; how long things take is not tested."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.simulation import built_in_scene, simulate

SCRIPT = Path(__file__).parents[2] / "scripts" / "benchmark.py"


@pytest.fixture(scope="module")
def benchmark():
    """The script as a module."""
    spec = importlib.util.spec_from_file_location("benchmark", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = sys.modules["benchmark"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules["benchmark"]


@pytest.fixture
def five_frames(benchmark, monkeypatch):
    monkeypatch.setattr(benchmark, "built_in_scene", lambda **more: built_in_scene(**(more | {"frames": 5})))


@pytest.fixture(scope="module")
def recording():
    scene = built_in_scene(frames=5)
    return simulate(scene), scene.rig


@pytest.mark.parametrize("temporal", [False, True])
def test_times_of_stages_add_up(benchmark, recording, temporal):
    spent = benchmark.spend(*recording, replace(PipelineConfig(), temporal=temporal), 5)
    assert len(spent.people) == 20
    whole = sum(spent.stages_ms.values())
    # All but what lies between the stages is in one of them.
    assert 0.5 * spent.wall_ms < whole <= 1.001 * spent.wall_ms
    assert spent.stages_ms["solve"] > 0 and min(spent.stages_ms.values()) >= 0


def test_a_long_recording_goes_back_and_forth(benchmark, recording):
    long = benchmark.BackAndForth(recording[0], 12)
    assert len(long) == 12
    assert [id(long[t]) for t in range(12)] == [id(recording[0][t]) for t in (0, 1, 2, 3, 4, 4, 3, 2, 1, 0, 0, 1)]


def test_memory_of_rows(benchmark, recording):
    spent = benchmark.spend(*recording, PipelineConfig(), 2)
    assert 0 < benchmark.rows_mib(spent.people) < benchmark.peak_mib()


@pytest.mark.slow
def test_prints_machine_stages_and_ratios(benchmark, five_frames, monkeypatch, capsys):
    monkeypatch.setattr(
        sys, "argv", ["benchmark.py", "--scene", "--frames", "3", "--rounds", "1", "--lengths", "7"]
    )
    benchmark.main()
    printed = capsys.readouterr().out
    for part in ("cores", "torch", "the built-in scene: 3 frames", "all, processor", "7 frames: "):
        assert part in printed
