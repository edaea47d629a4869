"""Experiments: each works at a small scale; a run that was stopped goes on; old figures are
measured again.
"""

import importlib.util
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.evaluation.experiments import scenes
from shapepose_fg.evaluation.experiments.experiment import Case, Column, Experiment, measured
from shapepose_fg.evaluation.experiments.registry import experiments
from shapepose_fg.evaluation.experiments.scenes import Scale, Segment
from shapepose_fg.simulation.training.motions import split_of

SCRIPTS = Path(__file__).parents[2] / "scripts"
QUICK = {each.name: each for each in experiments(Scale(quick=True))}
"""Those that need no recording."""


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_every_experiment_makes_a_table_of_plain_figures(name, tmp_path):
    experiment = QUICK[name]
    figures, seconds = measured(experiment, tmp_path, told=lambda _: None)
    assert seconds > 0
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    rows = [line for line in experiment.table(figures) if line.startswith("|")]
    assert len(rows) >= 3
    assert len({row.count("|") for row in rows}) == 1, "rows of different length"
    assert any(re.search(r"\d", cell) for cell in rows[-1].split("|")[2:]), (
        "no figure in the last row"
    )


def test_what_has_no_data_is_no_experiment():
    assert [each.name for each in experiments(Scale())] == ["who is there"]


def counting(times: list[str], fails: str = "") -> Experiment:
    """Two cases that note down when they are measured; one of them may fail."""

    def measure(name: str) -> dict:
        if name == fails:
            raise KeyboardInterrupt
        times.append(name)
        return {"value": len(times)}

    rows = {name: [Case(name, lambda name=name: measure(name))] for name in ("first", "second")}
    return Experiment("counting", rows, [Column("value", "value")])


def test_a_run_that_was_stopped_goes_on(tmp_path):
    times: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        measured(counting(times, fails="second"), tmp_path, told=lambda _: None)
    figures, _ = measured(counting(times), tmp_path, told=lambda _: None)
    assert times == ["first", "second"]
    assert figures == {"first": {"value": 1}, "second": {"value": 2}}
    again, _ = measured(counting(times), tmp_path, told=lambda _: None)
    assert times == ["first", "second"]
    assert again == figures


def test_what_is_kept_is_measured_again_if_asked(tmp_path):
    times: list[str] = []
    measured(counting(times), tmp_path, told=lambda _: None)
    measured(counting(times), tmp_path, afresh=True, told=lambda _: None)
    assert times == ["first", "second"] * 2


def test_damaged_figures_are_named(tmp_path):
    measured(counting([]), tmp_path, told=lambda _: None)
    file = tmp_path / "counting" / "first.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"seconds": "long"}))
    with pytest.raises(InputError, match=r"first\.json.*delete it"):
        measured(counting([]), tmp_path, told=lambda _: None)


def test_a_row_pools_its_cases():
    """Means, but of shares of joints by how many joints there are; what is not measured has no
    say.
    """
    cases = {
        "a": {"f1": 90.0, "joints_unseen": 6, "unseen_inside_50": 100.0},
        "b": {"f1": 80.0, "joints_unseen": 2, "unseen_inside_50": 50.0},
        "c": {"f1": 100.0, "joints_unseen": 0, "unseen_inside_50": None},
    }
    made = [Case(name, dict) for name in cases]
    columns = [
        *(Column("mean", "f1"), Column("least", "f1", 0, "least"), Column("most", "f1", 0, "most")),
        *(
            Column("u", "joints_unseen", 0, "sum"),
            Column("u 50 %", "unseen_inside_50"),
            Column("none", "other"),
        ),
    ]
    experiment = Experiment("pooled", {"first": made[:1], "all": made}, columns)
    assert [case.name for case in experiment.cases] == ["a", "b", "c"]
    assert experiment.table(cases)[2:] == [
        "| first | 90.0 | 90 | 90 | 6 | 100.0 | - |",
        "| all | 90.0 | 80 | 100 | 8 | 87.5 | - |",
    ]
    assert list(experiment.only(lambda name: name == "b").rows) == ["all"]
    with pytest.raises(ValueError, match="one name"):
        _ = Experiment("pooled", {"a": [made[0], Case("a", dict)]}, columns).cases


@pytest.fixture
def script(monkeypatch):
    """The script as a function of its words."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    spec = importlib.util.spec_from_file_location(
        "reproduce_tables", SCRIPTS / "reproduce_tables.py"
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def run(*words: str) -> None:
        monkeypatch.setattr(sys, "argv", ["", *words])
        module.main()

    run.has_words = module.has_words
    return run


def test_cases_are_asked_for_by_their_words(script, tmp_path, capsys, monkeypatch):
    """All of them, in any order: `crowd 0` is in `crowd 0:300`, `crowd 10 Hz` in cases of `who is
    there`.
    """
    name = "crowd 6301 3 cameras 10 Hz"
    assert all(
        script.has_words(name, words) for words in ("crowd", "crowd 3 cameras", "6301 10 hz")
    )
    assert not any(script.has_words(name, words) for words in ("crossing", "crowd 30 Hz", "630"))
    assert script.has_words("crowd 0:300", "crowd 0") and not script.has_words(
        "salsa 108:408", "crowd 0"
    )
    (tmp_path / "data" / "cmu_mocap").mkdir(parents=True)
    words = ["--results", str(tmp_path), "--data", str(tmp_path), "--quick", "--seeds", "7"]
    script(*words, "--only", "who is there", "--list", "--cases", "people 7")
    assert "two people 7 2 cameras 30 Hz" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        script(*words, "--only", "who is there", "--cases", "nowhere")
    assert "there is no such case" in capsys.readouterr().err


def test_a_folder_without_recordings_is_named(script, tmp_path, capsys):
    """Either the folder that holds them or the one above will do."""
    with pytest.raises(SystemExit):
        script("--data", str(tmp_path / "nowhere"), "--only", "shelf", "--list")
    told = capsys.readouterr().err
    nowhere = tmp_path / "nowhere"
    assert f"neither {nowhere} nor {nowhere / 'data'} has a folder shelf or cmu_mocap" in told
    (tmp_path / "data" / "cmu_mocap").mkdir(parents=True)
    for folder in (tmp_path, tmp_path / "data"):
        script("--data", str(folder), "--quick", "--only", "time", "--list")
        assert "time" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        script("--data", str(tmp_path), "--quick", "--only", "shelf", "--list")
    assert f"{tmp_path / 'data'} has no shelf" in capsys.readouterr().err


@pytest.mark.slow
def test_nothing_was_learnt_from_anybody_who_is_held_back(shared_data):
    """By the clips that each sequence says it is made of: 60 and 61 dance, all others are test
    subjects.
    """
    for segment in scenes.held_back_segments(shared_data / "cmu_mocap" / "cmu_smpl24.npz"):
        scene = segment.scene
        assert len(scene) == 300 and len(scene.clips) == len(scene.cuts) + 1
        subjects = {clip.split("_")[0] for clips in scene.clips for clip in clips}
        assert len(subjects) > 2 and {split_of(subject) for subject in subjects} == {"test"}
    assert len(scenes.held_back(Scale(data=shared_data)).cases) == 6


def test_a_case_is_drawn_by_its_seed_at_its_rate():
    slow = Segment("demo", range(6), cameras=2, people=2, fps=10.0, seed=7)
    assert slow.scene.fps == 10.0 and len(slow.detections) == 6
    other = replace(slow, seed=8)
    assert np.abs(slow.scene.keypoints - other.scene.keypoints).max() > 0.05


def test_after_a_cut_everybody_is_somebody_else(monkeypatch):
    segment = Segment("demo", range(6), cameras=2, people=2)
    scene = replace(segment.scene, cuts=(2, 4))
    monkeypatch.setattr(scenes, "_scene", lambda _: scene)
    truth = segment.truth
    people = [np.unique(truth.person[truth.frame == frame]).tolist() for frame in range(6)]
    assert people == [[0, 1], [0, 1], [2, 3], [2, 3], [4, 5], [4, 5]]
