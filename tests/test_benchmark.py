"""scripts/benchmark.py: that it measures what it says; how long things take is not tested."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.pipeline import PipelineConfig
from shapepose_fg.simulation import built_in_scene

SCRIPT = Path(__file__).parents[1] / "scripts" / "benchmark.py"


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
    monkeypatch.setattr(benchmark, "built_in_scene", lambda: built_in_scene(frames=5))


def test_times_of_batches_add_up(benchmark, five_frames):
    config = replace(PipelineConfig(), batch_frames=2)
    fitter = benchmark.TimedFitter(benchmark.make_fitter())
    timing = benchmark.measure(benchmark._scene(), config, range(5), fitter)
    assert timing.frames.tolist() == [2, 2, 1]
    assert timing.people == 20
    whole = sum(timing.mean_ms(stage) for stage in benchmark.STAGES)
    assert timing.mean_ms("all") == pytest.approx(whole)
    # Fitting bodies is a part of stage II, in every batch.
    assert (timing.seconds["bodies"] > 0).all()
    assert (timing.seconds["bodies"] < timing.seconds["refine"]).all()


def test_stage_two_is_taken_apart_by_functions_that_exist(benchmark, five_frames):
    fitter = benchmark.TimedFitter(benchmark.make_fitter())
    shares = benchmark.stage_two(benchmark._scene(), PipelineConfig(), range(2), fitter)
    assert set(shares) == {*benchmark.PARTS, "the rest"}
    assert all(share > 0 for share in shares.values()), shares
    assert sum(shares.values()) == pytest.approx(1.0)


def test_prints_machine_stages_and_ratios(benchmark, five_frames, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["benchmark.py", "--scene", "--frames", "3", "--rounds", "1"])
    benchmark.main()
    printed = capsys.readouterr().out
    for part in (
        "cores",
        "torch",
        "the built-in scene: 3 frames",
        "median of 1 batches",
        "covariances",
        "threads = 2",
    ):
        assert part in printed


def test_median_and_mean_of_unequal_batches(benchmark):
    seconds = {"vote": np.array([0.02, 0.04, 0.03])}
    timing = benchmark.Timing(np.array([2, 2, 1]), 0, seconds)
    assert timing.median_ms("vote") == pytest.approx(20.0)  # of 10, 20 and 30 ms a frame
    assert timing.mean_ms("vote") == pytest.approx(18.0)  # 90 ms over 5 frames


def test_prints_how_fast_it_simulates(benchmark, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["benchmark.py", "--simulate", "demo", "--frames", "4"])
    benchmark.main()
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if "│" in line]
    assert [row[1] for row in rows] == ["1", "2"]  # workers
    assert rows[0][-2] == "1.00" and all(float(cell) > 0 for row in rows for cell in row[3::2] if cell != "│")
