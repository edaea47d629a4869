"""Experiments: each works at a small scale; a run that was stopped goes on; old figures are measured again."""

import json
import re

import pytest

from shapepose_fg.errors import InputError
from shapepose_fg.estimation.window_graph import WindowGraphConfig
from shapepose_fg.evaluation.experiments import fingerprint as module
from shapepose_fg.evaluation.experiments import runner
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment
from shapepose_fg.evaluation.experiments.fingerprint import fingerprint
from shapepose_fg.evaluation.experiments.registry import experiments
from shapepose_fg.evaluation.experiments.runner import Kept, measured
from shapepose_fg.evaluation.experiments.scale import Scale
from shapepose_fg.pipeline import PipelineConfig

QUICK = {each.name: each for each in experiments(Scale(quick=True))}
"""Those that need no recording."""


@pytest.mark.parametrize("name", QUICK)
def test_every_experiment_makes_a_table_of_plain_figures(name, tmp_path):
    figures, seconds = measured(QUICK[name], Kept(tmp_path), told=lambda _: None)
    assert seconds > 0
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    rows = [line for line in QUICK[name].table(figures) if line.startswith("|")]
    assert len(rows) >= 3
    assert len({row.count("|") for row in rows}) == 1, "rows of different length"
    assert any(re.search(r"\d", cell) for cell in rows[-1].split("|")[2:]), "no figure in the last row"


def counting(times: list[str], fails: str = "") -> Experiment:
    """Two cases that note down when they are measured; one of them may fail."""

    def measure(name: str) -> dict:
        if name == fails:
            raise KeyboardInterrupt
        times.append(name)
        return {"value": len(times)}

    cases = [Case(name, lambda name=name: measure(name)) for name in ("first", "second")]
    return Experiment("counting", cases, lambda figures: [str(figures)])


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
        monkeypatch.setattr(runner, "fingerprint", lambda basis: "00000000")
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


def test_fingerprints_are_of_what_they_are_called(monkeypatch):
    fingerprint.cache_clear()
    before = {basis: fingerprint(basis) for basis in ("pipeline", "bodies", "detector")}
    assert len(set(before.values())) == 3
    graph = WindowGraphConfig(rho_3d=0.5)
    monkeypatch.setattr(module, "PipelineConfig", lambda: PipelineConfig(window_graph=graph))
    fingerprint.cache_clear()
    after = {basis: fingerprint(basis) for basis in before}
    fingerprint.cache_clear()
    changed = {basis for basis in before if before[basis] != after[basis]}
    assert changed == {"pipeline"}
