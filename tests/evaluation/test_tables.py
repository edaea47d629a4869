"""The script that measures the tables: resumes, pools the figures of a row, replaces tables."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.simulation import built_in_scene
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.training.motions import split_of

SCRIPT = Path(__file__).parents[2] / "scripts" / "reproduce_tables.py"


@pytest.fixture
def script():
    spec = importlib.util.spec_from_file_location("reproduce_tables", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_case_is_measured_as_plain_figures(script):
    case = script.Case("two", "two", lambda: built_in_scene(people=2, cameras=3), range(6))
    figures = script.measure(case)
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    head, rule, row = script.table([case], [figures]).splitlines()
    assert head.count("|") == rule.count("|") == row.count("|")
    assert row.startswith("| two | 100.0 |")


def test_a_row_pools_its_cases(script):
    """Means, but shares of joints are weighted by their count; missing figures are left out."""
    cases = [
        {"f1": 90.0, "joints_unseen": 6, "unseen_inside_50": 100.0},
        {"f1": 80.0, "joints_unseen": 2, "unseen_inside_50": 50.0},
        {"f1": 100.0, "joints_unseen": 0, "unseen_inside_50": None},
    ]
    columns = (("f1", 1), ("f1", 0, "least"), ("joints_unseen", 0, "sum"), ("other", 1))
    cells = [script.Column("", *each).cell(cases) for each in columns]
    assert cells == ["90.0", "80", "8", "-"]
    assert script.Column("", "unseen_inside_50").cell(cases) == "87.5"


def test_kept_figures_are_not_measured_again_and_the_page_is_updated(
    script, tmp_path, monkeypatch, capsys
):
    measured: list[str] = []

    def measure(case):
        measured.append(case.name)
        return {"f1": 90.0}

    page = tmp_path / "page.md"
    page.write_text("before\n<!-- who is there @old -->\nold\n<!-- end -->\nafter\n")
    monkeypatch.setattr(script, "measure", measure)
    monkeypatch.setattr(script, "PAGE", page)
    for _ in range(2):
        script.main(only=["who is there"], seed=[7], results=tmp_path, update=True)
    assert measured == ["7 two people, with time", "7 two people, without time"]
    text = page.read_text()
    assert text.startswith("before\n<!-- who is there -->") and text.endswith("end -->\nafter\n")
    assert "| two people, with time | 90.0 |" in text and "old" not in text
    assert "| **all** | 90.0 |" in capsys.readouterr().out


@pytest.mark.slow
def test_nothing_was_learnt_from_anybody_who_is_held_back(script, shared_data):
    """By the clips that each sequence is made of."""
    mocap = Mocap.load(shared_data / "cmu_mocap" / "cmu_smpl24.npz")
    cases = list(script.held_back(mocap))
    assert len(cases) == 6
    for case in cases[:3]:
        scene = case.make().part(case.span)
        assert len(scene) == 300 and len(scene.clips) == len(scene.cuts) + 1
        subjects = {clip.split("_")[0] for clips in scene.clips for clip in clips}
        assert len(subjects) > 2 and {split_of(subject) for subject in subjects} == {"test"}


def test_after_a_cut_everybody_is_somebody_else(script):
    scene = replace(built_in_scene(people=2, cameras=2).part(range(6)), cuts=(2, 4))
    truth = script.truth(scene)
    people = [np.unique(truth.person[truth.frame == frame]).tolist() for frame in range(6)]
    assert people == [[0, 1], [0, 1], [2, 3], [2, 3], [4, 5], [4, 5]]
