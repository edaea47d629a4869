"""Experiments: each works at a small scale; a run that was stopped goes on; old figures are measured again."""

import json
import re

import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.evaluation.experiments import runner
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment
from shapepose_fg.evaluation.experiments.made_with import changes, fingerprint, made_with
from shapepose_fg.evaluation.experiments.registry import experiments
from shapepose_fg.evaluation.experiments.runner import Kept, measured
from shapepose_fg.evaluation.experiments.scale import Scale

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
    every, bodies, detector = (made_with(basis) for basis in ("pipeline", "bodies", "detector"))
    assert {f"body.{name}" if "/" not in name else name for name in bodies} <= set(every)
    assert "simulation/data/detector.json" in detector and "window_graph.rho_3d" not in detector
    assert len({fingerprint(each) for each in (every, bodies, detector)}) == 3
