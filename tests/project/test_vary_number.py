"""scripts/vary_number.py: it changes one number, and tells noise from a difference."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("vary_number", ROOT / "scripts/vary_number.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SOURCE = '''"""Of µ."""
A = 0.5
"""A length, m."""
B, C = 1 / 3, (
    2.0,
    3.0,
)
D: float = 4.0


def f(A=9.0):
    B = A
    return B
'''


@pytest.mark.parametrize(
    ("name", "value", "now"),
    [("A", "0.25", 0.25), ("A", "x3", 1.5), ("B", "x3", 1.0), ("C", "(1.0, 1.0)", (1.0, 1.0)),
     ("D", "inf", np.inf)],
)  # fmt: skip
def test_only_the_named_constant_changes(script, name, value, now):
    before, after = {}, {}
    exec(SOURCE, before)
    exec(script.changed(SOURCE, name, value), after)
    assert after[name] == now != before[name]
    for other in {"A", "B", "C", "D", "__doc__"} - {name}:
        assert after[other] == before[other]
    assert after["f"]() == 9.0


def test_other_names_are_refused(script, tmp_path):
    with pytest.raises(SystemExit, match="no constant"):
        script.changed(SOURCE, "E", "1")
    with pytest.raises(SystemExit, match="no module"):
        script.copied(tmp_path, "tracking.nothing.A", "1")


def test_the_copy_differs_in_one_line(script, tmp_path):
    path = "estimation/draft.py"
    script.copied(tmp_path, "estimation.draft.DISAGREE", "x2")
    differ = [
        file.relative_to(ROOT / "shapepose_fg").as_posix()
        for file in (ROOT / "shapepose_fg").rglob("*.py")
        if file.read_bytes() != (tmp_path / file.relative_to(ROOT)).read_bytes()
    ]
    assert differ == [path]
    old, new = ((at / "shapepose_fg" / path).read_text().splitlines() for at in (ROOT, tmp_path))
    assert sum(a != b for a, b in zip(old, new, strict=True)) == 1


def test_a_difference_counts_if_it_exceeds_the_spread(script):
    rng = np.random.default_rng(0)
    usual = rng.uniform(90, 100, (10, 6))
    apart = rng.normal(0, 1, usual.shape)
    noise = usual + apart - apart.mean(axis=0)
    assert "nothing differs" in "\n".join(script.lines("2.0", noise, usual))
    noise[:, 2] += 5
    text = "\n".join(script.lines("2.0", noise, usual))
    assert text.count("*") == 1 and "nothing differs" not in text
    assert len([*script.lines("x1", usual, usual)]) == 1


@pytest.mark.slow
def test_values_are_measured_in_turn(script, monkeypatch, capsys):
    """The second value leaves no detection any weight, so that nobody is found."""
    constant = "tracking.track_selection._SURE_AFFINITY"
    monkeypatch.setattr(sys, "argv", ["x", constant, "inf", "--seconds", "0.2"])
    monkeypatch.setattr(script, "__file__", str(ROOT / "scripts/vary_number.py"))
    script.main()
    usual, none = (line.split() for line in capsys.readouterr().out.splitlines()[1:3])
    assert usual[0] == "x1" and float(usual[1]) > 80
    assert none[0] == "inf" and float(none[1]) == 0
