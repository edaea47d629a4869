"""What is said on a terminal: names and paths of the user's stand there as they are."""

import json
import unicodedata
from pathlib import Path

import pytest
from rich.progress import TextColumn
from rich.table import Table

from shapepose_fg.cameras.check.report import CameraUse, Distances
from shapepose_fg.cli.main import main
from shapepose_fg.cli.setup_table import use_table
from shapepose_fg.cli.terminal import (
    bars,
    forget_notes,
    note,
    note_of_reading,
    progress,
    show,
    show_written,
    table,
    use_any_streams,
)


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
    monkeypatch.setattr("shapepose_fg.cli.terminal._is_terminal", lambda _: True)
    monkeypatch.setattr("rich.progress.Progress.start", lambda bar: shown.extend(bar.columns))
    with progress("looking through a[/b]"):
        (words, *_) = (each for each in shown if isinstance(each, TextColumn))
        assert words.markup is False


ESCAPES = "\x1b]0;title\x07\x1b[31mred\x9b2J\r\x08\u202e"


def obeyed(text: str) -> set[str]:
    """What a terminal would do something at, but for ends of lines."""
    return {letter for letter in text if unicodedata.category(letter) in ("Cc", "Cf")} - {"\n"}


def test_what_is_said_has_no_escapes(capsys, monkeypatch):
    use_any_streams()
    note(ESCAPES)
    show(ESCAPES)
    table = Table(ESCAPES, title=ESCAPES)
    table.add_row(ESCAPES)
    show(table)
    print(ESCAPES, flush=True)
    with bars() as shown:
        shown.console.print(ESCAPES)
    said = "".join(capsys.readouterr())
    assert said.count("red") == 7 and not obeyed(said)
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    note(ESCAPES)
    assert capsys.readouterr().err.startswith("\x1b[1mnote: \x1b[0m"), "colours of our own stay"


@pytest.mark.parametrize("columns", [30, 42, 60, 100])
def test_words_of_a_table_stay_whole_on_a_narrow_terminal(columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    heads = ("camera", "detected", "left out px", "probability")
    show(table(heads, [("cam01", "1234", "12/340", "0.99"), ("cam02", "7", "3.1/9", "1.00")]))
    lines = capsys.readouterr().out.splitlines()
    assert {"camera", "detected", "left", "out", "px", "probability", "12/340"} <= set(
        " ".join(lines).split()
    )
    assert max(map(len, lines)) <= max(columns, 37)  # the longest words, with a gap of one


def test_cells_stay_whole_where_broken_heads_make_room(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "46")
    row = ("cam01", "-0.05 13.50 1.53", "1556 ± 2.2 %", "0.5")
    show(table(("camera", "x y z, m", "focal, px", "rotation ± °"), [row]))
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].split() == " ".join(row).split() and len(lines[-1]) <= 46


def test_names_and_keys_of_files_reach_no_terminal_as_they_are(tmp_path, capsys):
    """Keys of TOML and JSON, names of files and recordings, arguments."""
    escaped = json.dumps(ESCAPES)
    (tmp_path / "keys.toml").write_text(f"{escaped} = 1\n[{escaped}]\na = 2", encoding="utf-8")
    (tmp_path / "keys.json").write_text(
        f'{{{escaped}: 1, "K": {{{escaped}: [1]}}}}', encoding="utf-8"
    )
    (tmp_path / "table.toml").write_text(f"[recordings.{escaped}]\n{escaped} = 1", encoding="utf-8")
    (tmp_path / f"a{ESCAPES}").write_text("{}")
    common = ["--detections", str(tmp_path), "--output", str(tmp_path / "out")]
    for words in (
        ["reconstruct", "--calibration", str(tmp_path / "keys.json"), *common],
        ["reconstruct", "--calibration", str(tmp_path / f"a{ESCAPES}"), *common],
        ["reconstruct", "--calibration", str(tmp_path / f"b{ESCAPES}"), *common],
        ["reconstruct", "--calibration", "c", "--config", str(tmp_path / "keys.toml"), *common],
        ["batch", str(tmp_path / "table.toml"), "--output", str(tmp_path / "out")],
        ["report", str(tmp_path / ESCAPES)],
        [ESCAPES],
    ):
        with pytest.raises(SystemExit) as ended:
            main(words)
        said = "".join(capsys.readouterr())
        assert ended.value.code == 2 and "error" in said and not obeyed(said), words


def test_output_to_a_file_has_no_blanks_at_the_ends_of_lines(capsys):
    made = Table(show_header=False, box=None)
    made.add_row("joints", "a b " * 60)
    show(made)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 2 and [line for line in lines if line != line.rstrip()] == []


@pytest.mark.parametrize("columns", [30, 80])
def test_a_path_is_never_broken(columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    paths = ["a folder/with a long name/" * 5 + "people.npz", "b/run.json  open it in a browser"]
    show_written(paths)
    assert capsys.readouterr().out == f"written  {paths[0]}\n         {paths[1]}\n"


def test_notes_of_an_input_that_is_read_twice_are_printed_once(capsys):
    for _ in range(2):
        forget_notes()
        note_of_reading("a", "b")
        note_of_reading("b", "c")
    assert capsys.readouterr().err.split("note: ")[1:] == ["a\n", "b\n", "c\n"] * 2
