"""Experiments: each works at a small scale; a run that was stopped goes on; old figures are measured again."""

import importlib.util
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.core.errors import InputError
from shapepose_fg.evaluation.experiments import ablation, fitters, runner, scenes, stretches
from shapepose_fg.evaluation.experiments.experiment import Case, Column, Experiment
from shapepose_fg.evaluation.experiments.made_with import changes, fingerprint, made_with
from shapepose_fg.evaluation.experiments.registry import experiments
from shapepose_fg.evaluation.experiments.runner import Kept, measured
from shapepose_fg.evaluation.experiments.stretches import Scale, Stretch
from shapepose_fg.evaluation.varied import varied
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.simulation.training.motions import split_of

SCRIPTS = Path(__file__).parents[2] / "scripts"
QUICK = {each.name: each for each in experiments(Scale(quick=True)) if each.name not in ("scenes", "time off")}
"""Those that need no recording, but two that differ from `time` in what is simulated and in settings only."""


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_every_experiment_makes_a_table_of_plain_figures(name, tmp_path):
    experiment = QUICK[name]
    if name == "ablation":  # one configuration is measured as the other
        experiment = experiment.only(lambda case: case.startswith("ours, over time"))
    figures, seconds = measured(experiment, Kept(tmp_path), told=lambda _: None)
    assert seconds > 0
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    rows = [line for line in experiment.table(figures) if line.startswith("|")]
    assert len(rows) >= 3
    assert len({row.count("|") for row in rows}) == 1, "rows of different length"
    assert any(re.search(r"\d", cell) for cell in rows[-1].split("|")[2:]), "no figure in the last row"


def test_what_has_no_data_is_no_experiment():
    assert [each.name for each in experiments(Scale())] == ["scenes", "who is there"]


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
    kept = Kept(tmp_path, "full")
    with pytest.raises(KeyboardInterrupt):
        measured(counting(times, fails="second"), kept, told=lambda _: None)
    figures, _ = measured(counting(times), kept, told=lambda _: None)
    assert times == ["first", "second"]
    assert figures == {"first": {"value": 1}, "second": {"value": 2}}
    again, _ = measured(counting(times), kept, told=lambda _: None)
    assert times == ["first", "second"]
    assert again == figures


@pytest.mark.parametrize("why", ["another scale", "other defaults", "afresh"])
def test_what_is_old_is_measured_again(why, tmp_path, monkeypatch):
    times: list[str] = []
    measured(counting(times), Kept(tmp_path, "full"), told=lambda _: None)
    if why == "other defaults":
        monkeypatch.setattr(runner, "made_with", lambda basis: made_with(basis) | {"temporal": "False"})
    scale = "quick" if why == "another scale" else "full"
    measured(counting(times), Kept(tmp_path, scale, afresh=why == "afresh"), told=lambda _: None)
    assert times == ["first", "second"] * 2


def test_damaged_figures_are_named(tmp_path):
    kept = Kept(tmp_path)
    measured(counting([]), kept, told=lambda _: None)
    file = tmp_path / "counting" / "first.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"seconds": "long"}))
    with pytest.raises(InputError, match=r"first\.json.*delete it"):
        measured(counting([]), kept, told=lambda _: None)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"window_graph.rho_3d": "0.5"}, ["window_graph.rho_3d was 0.5, is 1.0"]),
        ({"window_graph.no_longer": "3"}, []),
        ({"body/data/gone.npz": "0123"}, ["body/data/gone.npz is gone"]),
    ],
)
def test_what_makes_a_table_old(change, told):
    now = made_with()
    assert changes(now | change, now) == told
    assert changes({name: value for name, value in now.items() if name != "temporal"}, now) == ["temporal is new"]


def test_tables_depend_on_what_they_say():
    every, bodies = (made_with(basis) for basis in ("pipeline", "bodies"))
    assert {f"body.{name}" if "/" not in name else name for name in bodies} <= set(every)
    assert "simulation/data/detector.json" in every and "window_graph.rho_3d" not in bodies
    assert fingerprint(every) != fingerprint(bodies)


def test_a_row_pools_its_cases():
    """Means, but of shares of joints by how many joints there are; what is not measured has no say."""
    cases = {
        "a": {"f1": 90.0, "joints_unseen": 6, "unseen_inside_50": 100.0},
        "b": {"f1": 80.0, "joints_unseen": 2, "unseen_inside_50": 50.0},
        "c": {"f1": 100.0, "joints_unseen": 0, "unseen_inside_50": None},
    }
    made = [Case(name, dict) for name in cases]
    columns = [
        *(Column("mean", "f1"), Column("least", "f1", 0, "least"), Column("most", "f1", 0, "most")),
        *(Column("u", "joints_unseen", 0, "sum"), Column("u 50 %", "unseen_inside_50"), Column("none", "other")),
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


def test_cases_are_asked_for_by_their_words(monkeypatch, tmp_path, capsys):
    """All of them, in any order: `crowd 0` is in `crowd 0:300`, `crowd 10 Hz` in cases of `who is there`."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    spec = importlib.util.spec_from_file_location("reproduce_tables", SCRIPTS / "reproduce_tables.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    name = "crowd 6301 3 cameras 10 Hz"
    assert all(script.has_words(name, words) for words in ("crowd", "crowd 3 cameras", "6301 10 hz"))
    assert not any(script.has_words(name, words) for words in ("crossing", "crowd 30 Hz", "630"))
    assert script.has_words("crowd 0:300", "crowd 0") and not script.has_words("salsa 108:408", "crowd 0")
    words = ["--results", str(tmp_path), "--data", str(tmp_path), "--quick", "--seeds", "7"]
    monkeypatch.setattr(sys, "argv", ["", *words, "--only", "who is there", "--list", "--cases", "people 7"])
    script.main()
    assert "two people 7 2 cameras 30 Hz" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["", *words, "--cases", "nowhere"])
    with pytest.raises(SystemExit):
        script.main()
    assert "there is no such case" in capsys.readouterr().err


def test_every_setting_that_differs_from_the_paper_has_its_switch():
    switched = {name for names in ablation.SWITCHES.values() for name in names}
    assert switched | {"temporal"} == set(ablation.differing(ablation.PAPER, varied(PipelineConfig())))


def test_all_switches_together_lead_from_one_to_the_other():
    everything = [name for names in ablation.SWITCHES.values() for name in names]
    assert ablation.with_settings_of(ablation.PAPER, ablation.OURS, everything) == ablation.OURS
    one = ablation.with_settings_of(ablation.OURS, ablation.PAPER, everything[:1])
    assert ablation.differing(one, ablation.OURS) == everything[:1]


@pytest.mark.slow
def test_nothing_was_learnt_from_anybody_who_is_held_back(shared_data):
    """By the clips that each sequence says it is made of: 60 and 61 dance, all others are test subjects."""
    for stretch in scenes.held_back_stretches(shared_data / "cmu_mocap" / "cmu_smpl24.npz"):
        scene = stretch.scene
        assert scene.cuts == () and len(scene) == 300
        subjects = {clip.split("_")[0] for clips in scene.clips for clip in clips}
        assert len(subjects) > 2 and {split_of(subject) for subject in subjects} == {"test"}
    assert len(scenes.held_back(Scale(data=shared_data.parent)).cases) == 6


def test_a_case_is_drawn_by_its_seed_at_its_rate():
    slow = Stretch("demo", range(6), cameras=2, people=2, fps=10.0, seed=7)
    assert slow.scene.fps == 10.0 and len(slow.detections) == 6
    other = replace(slow, seed=8)
    assert np.abs(slow.scene.keypoints - other.scene.keypoints).max() > 0.05


def test_after_a_cut_everybody_is_somebody_else(monkeypatch):
    stretch = Stretch("demo", range(6), cameras=2, people=2)
    scene = replace(stretch.scene, cuts=(2, 4))
    monkeypatch.setattr(stretches, "_scene", lambda _: scene)
    truth = stretch.truth
    people = [np.unique(truth.person[truth.frame == frame]).tolist() for frame in range(6)]
    assert people == [[0, 1], [0, 1], [2, 3], [2, 3], [4, 5], [4, 5]]


def test_half_of_what_fitters_miss_goes_with_its_limb():
    joints = np.random.default_rng(0).normal(size=(20_000, 25, 3))
    targets, missing = fitters.corrupt(joints, 0.02, 0.3, np.random.default_rng(0))
    assert missing.mean() == pytest.approx(0.3, abs=0.005)  # five times its standard error
    trunk = np.setdiff1d(np.arange(25), np.concatenate(fitters.LIMBS))
    assert missing[:, trunk].mean() == pytest.approx(3.75 / 21.25, abs=0.005)  # singly only
    assert np.isnan(targets.xyz[missing]).all() and not targets.information[missing].any()
    np.testing.assert_allclose(targets.information[~missing][0], np.eye(3) / 0.02**2)
    assert (targets.xyz - joints)[~missing].std() == pytest.approx(0.02, rel=0.01)


def test_fitters_are_compared_on_bodies_that_stand_in_a_room(monkeypatch):
    """Both fitters on exact joints of six bodies: within a centimetre, with a body for each."""
    rng = np.random.default_rng(0)
    poses = np.concatenate([rng.normal(0, 0.1, (6, 1, 3)), PosePrior.default().sample(rng, 6)], axis=1)
    truth = fitters.true_joints(poses, rng)
    assert (truth[:, 0, 2] - truth[:, 21, 2]).min() > 1.0  # from heel to nose, z up
    monkeypatch.setattr(fitters, "_truth", lambda _: truth)
    monkeypatch.setattr(fitters, "BODIES", 6)
    monkeypatch.setattr(fitters, "BATCH", 3)
    for name in fitters.FITTERS:
        found = fitters.measure(Path(), "clean", name)
        assert found["mm"] < 10 and found["without"] == 0 and found["missing_mm"] is None and found["ms"] > 0
