"""scripts/benchmark.py: that it measures what it says; how long things take is not tested."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.speed import (
    PARTS,
    STAGES,
    BackAndForth,
    Spent,
    peak_mib,
    rows_mib,
    spend,
    stage_two,
)
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.simulation import built_in_scene, simulate

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
    monkeypatch.setattr(benchmark, "built_in_scene", lambda **more: built_in_scene(**(more | {"frames": 5})))


@pytest.fixture(scope="module")
def recording():
    scene = built_in_scene(frames=5)
    return simulate(scene), scene.rig


@pytest.mark.parametrize("temporal", [False, True])
def test_times_of_stages_add_up(recording, temporal):
    spent = spend(*recording, replace(PipelineConfig(), temporal=temporal), range(5))
    assert spent.frames == 5
    assert len(spent.people) == 20
    whole = sum(spent.ms(stage) for stage in STAGES)
    # All but what lies between the stages is in one of them.
    assert 0.5 * spent.wall_ms < whole <= 1.001 * spent.wall_ms
    assert 0 < spent.seconds["bodies"] < spent.seconds["solve"]
    assert all(spent.seconds[stage] >= 0 for stage in STAGES if stage in spent.seconds)


def test_stage_two_is_taken_apart_by_functions_that_exist(recording):
    shares = stage_two(*recording, PipelineConfig(), range(3))
    assert set(shares) == {*PARTS, "the rest"}
    assert all(share > 0 for share in shares.values()), shares
    assert sum(shares.values()) == pytest.approx(1.0)


def test_a_long_recording_goes_back_and_forth(recording):
    long = BackAndForth(recording[0], 12)
    assert len(long) == 12
    assert [id(long[t]) for t in range(12)] == [id(recording[0][t]) for t in (0, 1, 2, 3, 4, 4, 3, 2, 1, 0, 0, 1)]


def test_memory_of_rows(recording):
    spent = spend(*recording, PipelineConfig(), range(2))
    assert 0 < rows_mib(spent.people) < peak_mib()


def test_prints_machine_stages_and_ratios(benchmark, five_frames, monkeypatch, capsys):
    monkeypatch.setattr(
        sys, "argv", ["benchmark.py", "--scene", "--frames", "3", "--rounds", "1", "--lengths", "7"]
    )
    benchmark.main()
    printed = capsys.readouterr().out
    for part in ("cores", "torch", "the built-in scene: 3 frames", "covariances", "all, processor", "7 frames: "):
        assert part in printed


def test_prints_how_fast_it_simulates(benchmark, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["benchmark.py", "--simulate", "demo", "--frames", "4"])
    benchmark.main()
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if "│" in line]
    assert [row[1] for row in rows] == ["1", "2"]  # workers
    assert rows[0][-2] == "1.00" and all(float(cell) > 0 for row in rows for cell in row[3::2] if cell != "│")


def test_prints_what_chunks_gain_and_change(benchmark, five_frames, monkeypatch, capsys):
    words = "benchmark.py --scene --chunks 96 --times 40 --workers 1".split()
    monkeypatch.setattr(sys, "argv", words)
    monkeypatch.setattr(benchmark, "spend", spent_of_chunks)
    benchmark.main()
    printed = " ".join(capsys.readouterr().out.split())
    assert (
        "200 frames in 2 chunks, 1 workers: clock 10.0 ms a frame, 20.0 in one process uncut, ratio 2.00"
        in printed
    )
    assert "joints at most 1.000 mm apart within an overlap (13 frames) of 1 seams, 0.000 mm elsewhere" in printed
    assert "0 of 1 people lose their identity at a seam" in printed


def spent_of_chunks(_, rig, config, frames, workers=1, chunk_frames=None) -> Spent:
    """One person in every frame, twice as fast in chunks, whose joints are a millimetre away at the seam at 96."""
    count = len(frames)
    people = Reconstruction.empty(BODY_25.joints)
    rows = {name: getattr(people, name) for name in people.ROWS}
    rows = {name: np.zeros((count, *each.shape[1:]), dtype=each.dtype) for name, each in rows.items()}
    rows |= {"frame": np.arange(count), "status": np.full(count, "ok")}
    if chunk_frames is not None:
        rows["joints"][96:99, 3, 1] = 1e-3
    wall = count * (0.02 if chunk_frames is None else 0.01)
    return Spent(count, wall, wall, {}, replace(people, **rows))
