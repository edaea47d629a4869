"""scripts/benchmark.py: that it measures what it says; how long things take is not tested."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from shapepose_fg.simulation import built_in_scene, simulate

SCRIPT = Path(__file__).parents[2] / "scripts" / "benchmark.py"


@pytest.fixture(scope="module")
def script():
    """The script as a module (not called `benchmark`: a plugin of pytest has a fixture of that
    name).
    """
    spec = importlib.util.spec_from_file_location("benchmark", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = sys.modules["benchmark"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules["benchmark"]


def test_a_long_recording_goes_back_and_forth(script):
    short = simulate(built_in_scene(frames=5))
    long = script.to_and_fro(short, 12)
    assert [id(long[t]) for t in range(12)] == [
        id(short[t]) for t in (0, 1, 2, 3, 4, 4, 3, 2, 1, 0, 0, 1)
    ]


def test_the_exponent_of_growth_is_that_of_the_time_beyond_a_frame(script, monkeypatch, tmp_path):
    """A command that takes a second, and one more for the square of the number of people."""

    def spent(tree, options, output):
        people = 0 if "0:1" in options else made[-1]
        return script.Spent(1.0 + people**2, 0.0, 100.0, {})

    made = list[int]()
    monkeypatch.setattr(script, "_USUAL", script._USUAL | {"frames": 2, "cameras": 2})
    monkeypatch.setattr(script, "_GROWTH", {"people": (1, 2, 3)})
    monkeypatch.setattr(
        script, "simulate", lambda scene, config: made.append(scene.people) or simulate(scene)
    )
    monkeypatch.setattr(script, "spend", spent)
    exponents = [*script.growth(tmp_path).columns[2].cells]
    assert exponents == ["", "2.00", "2.00"]


@pytest.mark.slow
def test_a_command_that_fails_is_shown_with_what_it_said(script, tmp_path):
    with pytest.raises(SystemExit, match=r"(?s)--detections here .*failed.*here"):
        script.spend(
            script.HERE, ["--calibration", "no.json", "--detections", "here"], tmp_path / "out"
        )


@pytest.mark.slow
def test_two_commits_are_timed_alternately(script, monkeypatch, capsys, tmp_path):
    """No recording in the folder: the built-in scene is taken. Each checkout is run once, and what
    that took is told again for the later rounds.
    """
    taken, spent, spend = [], {}, script.spend

    def once(tree, options, output):
        taken.append("here" if tree == script.HERE else "against")
        if tree not in spent:
            spent[tree] = spend(tree, options, output)
        return spent[tree]

    monkeypatch.setattr(script, "spend", once)
    git = subprocess.run(
        ["git", "-C", str(script.HERE), "rev-parse", "HEAD"], capture_output=True, text=True
    )
    if git.returncode != 0:
        pytest.skip("not a git checkout")
    commit = git.stdout.strip()
    script.main(commit, case=["one frame"], rounds=2, data=tmp_path, frames=2)
    assert taken == ["against", "here"] * 3, "a round warms up"
    printed = capsys.readouterr().out
    for part in (
        "cores",
        "numpy",
        "one frame",
        "here",
        "processor",
        "peak memory",
        "solve",
        "ratio",
    ):
        assert part in printed
    left = subprocess.run(
        ["git", "-C", str(script.HERE), "worktree", "list"], capture_output=True, text=True
    )
    assert "against" not in left.stdout
