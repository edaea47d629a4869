"""What is said on a terminal: names and paths of the user's stand there as they are."""

from pathlib import Path

import pytest
from rich.progress import TextColumn
from rich.table import Table

from shapepose_fg.cli.terminal import progress, show
from shapepose_fg.setup_check.report import CameraUse, Distances
from shapepose_fg.setup_check.table import use_table


@pytest.mark.parametrize("name", ["cam[left]", "a[/b]", ":cat:", "[red]"])
def test_a_name_is_no_markup(capsys, name):
    table = Table(name, title=name)
    table.add_row(str(Path(name)))
    show(table)
    show(name)
    assert capsys.readouterr().out.count(name) == 4
    none = Distances(0, None, None, None, None)
    show(use_table([CameraUse(name, 3, 1, none, none, none)]))
    assert name in capsys.readouterr().out


def test_a_bar_s_words_are_no_markup(monkeypatch):
    shown = []
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    monkeypatch.setattr("rich.progress.Progress.start", lambda bar: shown.extend(bar.columns))
    with progress("looking through a[/b]"):
        (words, *_) = (each for each in shown if isinstance(each, TextColumn))
        assert words.markup is False
