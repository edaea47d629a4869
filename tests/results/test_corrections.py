"""Corrections beside a result: listed, taken back to the last byte, and refused where they do not
fit.
"""

import hashlib
import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.results.corrections import correct, read_corrections, refuse_corrected, take_back
from shapepose_fg.results.edits import Action, Edit
from shapepose_fg.simulation import built_in_scene
from shapepose_fg.simulation.files import truth_of


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three people in ten frames, exactly."""
    truth_of(built_in_scene(people=3, frames=10)).with_run(people={"dropped": {"a": 1}}).save(
        tmp_path / "results"
    )
    return tmp_path / "results"


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def run(*arguments: object) -> int:
    """Exit code of `shapepose-fg tracks`."""
    with pytest.raises(SystemExit) as caught:
        main(["tracks", *map(str, arguments)])
    return int(caught.value.code or 0)


def test_corrections_are_listed_and_taken_back_to_the_last_byte(folder):
    before = contents(folder)
    first, second = Edit(Action.SPLIT, 1, 7, 4), Edit(Action.DROP, 2)
    assert correct(folder, first).changed == {1, 7}
    after_first = Reconstruction.load(folder)
    correct(folder, second)
    people = Reconstruction.load(folder)
    assert set(people.person.tolist()) == {0, 1, 7} and len(people) == 20
    assert people.run["people"]["found"] == 20 and people.run["people"]["dropped"] == {"a": 1}
    assert read_corrections(folder) == (first, second)
    assert contents(folder / "uncorrected") == before
    edit, people = take_back(folder)
    assert edit == second and read_corrections(folder) == (first,)
    np.testing.assert_array_equal(people.person, after_first.person)
    np.testing.assert_array_equal(Reconstruction.load(folder).joints, after_first.joints)
    take_back(folder)
    assert contents(folder) == before
    with pytest.raises(InputError, match="there is no correction to undo"):
        take_back(folder)


def test_a_correction_that_cannot_be_made_changes_nothing(folder):
    before = contents(folder)
    with pytest.raises(InputError, match="results: 0 and 1 are both present in 10 frames"):
        correct(folder, Edit(Action.MERGE, 0, 1))
    assert contents(folder) == before


def test_a_result_that_was_corrected_is_not_written_over(folder):
    refuse_corrected(folder)
    correct(folder, Edit(Action.DROP, 2))
    with pytest.raises(
        InputError, match=r"was corrected by hand \(corrections.json and uncorrected\)"
    ):
        refuse_corrected(folder)
    (folder / "corrections.json").unlink()
    with pytest.raises(
        InputError, match=r"by hand \(uncorrected\).* delete corrections.json and uncorrected"
    ):
        refuse_corrected(folder)


def test_a_folder_of_before_that_is_gone_loses_no_result(folder):
    correct(folder, Edit(Action.RENAME, 0, 7))
    shutil.rmtree(folder / "uncorrected")
    before = contents(folder)
    for action in (lambda: correct(folder, Edit(Action.DROP, 1)), lambda: take_back(folder)):
        with pytest.raises(
            InputError, match=r"uncorrected/people\.npz: .* or delete corrections\.json"
        ):
            action()
    assert contents(folder) == before


def test_a_first_correction_that_was_stopped_half_way_is_told(folder, monkeypatch):
    before = contents(folder)

    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("shapepose_fg.results.corrections.write_content", stop)
        with pytest.raises(KeyboardInterrupt):
            correct(folder, Edit(Action.DROP, 2))
    assert set(Reconstruction.load(folder).person.tolist()) == {0, 1}
    sentence = r"corrections\.json: this file is missing beside uncorrected"
    for action in (lambda: read_corrections(folder), lambda: correct(folder, Edit(Action.DROP, 1))):
        with pytest.raises(InputError, match=sentence):
            action()
    assert contents(folder / "uncorrected") == before


def test_a_result_without_run_json_comes_back_without_it(folder):
    (folder / "run.json").unlink()
    before = contents(folder)
    correct(folder, Edit(Action.RENAME, 0, 7))
    take_back(folder)
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            lambda c: c | {"format": "1"},
            "format must be 'shapepose-fg corrections 1', got text '1'",
        ),
        (lambda c: c | {"edits": []}, "edits must hold 1 value, got 0"),
        (lambda c: c | {"more": 1}, "more is not a known key"),
        (lambda c: c | {"people": "0"}, "people.npz is not the result of these corrections"),
        (
            lambda c: c | {"edits": [{"action": "drop", "person": 2, "frame": 3}]},
            "drop needs no frame",
        ),
        (
            lambda c: c | {"edits": [{"action": "hide", "person": 2}]},
            "edits[0].action must be 'merge', 'split',",
        ),
        (lambda c: c | {"edits": [{"action": "drop", "person": -2}]}, "edits[0].person"),
        (lambda c: c | {"edits": [{"action": "drop"}]}, "edits[0].person is missing"),
        (lambda c: [], "the file must be"),
    ],
)
def test_bad_files(folder, change, sentence):
    correct(folder, Edit(Action.DROP, 2))
    file = folder / "corrections.json"
    file.write_text(json.dumps(change(json.loads(file.read_text()))))
    with pytest.raises(InputError) as caught:
        read_corrections(folder)
    assert str(caught.value).startswith(f"{file}: ") and sentence in str(caught.value)
    assert "copy the files of uncorrected back and delete uncorrected and corrections.json" in str(
        caught.value
    )


def test_a_result_that_changed_since_is_noticed(folder):
    correct(folder, Edit(Action.DROP, 2))
    truth_of(built_in_scene(people=2, frames=10)).save(folder)
    for action in (lambda: correct(folder, Edit(Action.DROP, 1)), lambda: take_back(folder)):
        with pytest.raises(InputError, match=r"people\.npz is not the result of these corrections"):
            action()


def test_a_result_of_other_joints_is_refused_in_a_sentence(folder):
    """By somebody who knows how its corrections say which people.npz they led to."""
    correct(folder, Edit(Action.SPLIT, 1, 7, frame=3))
    correct(folder, Edit(Action.SWAP, 0, 1, frame=5))
    file, told = folder / "people.npz", folder / "corrections.json"
    before, columns = file.read_bytes(), dict(np.load(file))
    columns["joint_names"] = columns["joint_names"][::-1]
    np.savez(file, **columns)
    digests = [hashlib.sha256(content).hexdigest() for content in (before, file.read_bytes())]
    told.write_text(told.read_text().replace(*digests))
    with pytest.raises(
        InputError, match="parts must have the same joint_names; copy the files of uncorrected back"
    ):
        take_back(folder)


def test_the_command_to_undo_can_be_pasted(folder, tmp_path, capsys):
    moved = folder.rename(tmp_path / "trial 3 (Jürgen's)")
    assert run(moved, "split", 1, 4) == 0
    (line,) = [each for each in capsys.readouterr().out.splitlines() if each.startswith("to undo")]
    assert shlex.split(line.removeprefix("to undo it: ")) == [
        "shapepose-fg",
        "tracks",
        str(moved),
        "undo",
    ]


def test_tracks_on_the_command_line(folder, capsys):
    assert run(folder) == 0
    printed = capsys.readouterr().out
    assert [line.split()[:4] for line in printed.splitlines()[1:4]] == [
        [str(person), "0-9", "10", "0"] for person in range(3)
    ]
    assert "3 people, 30 rows" in printed
    assert run(folder, "split", 1, 4) == 0
    printed = capsys.readouterr().out
    assert "done: split 1 4 --new 3; joints and bodies were not solved again" in printed
    assert "4 people, 30 rows" in printed and "corrected: split 1 4 --new 3" in printed
    assert f"to undo it: shapepose-fg tracks {folder} undo" in printed
    assert run(folder, "merge", 1, 3) == 0
    assert run(folder / "people.npz", "swap", 0, 2, 5) == 0
    assert run(folder, "rename", 2, 9) == 0
    assert "done: rename 2 9\n" in capsys.readouterr().out
    assert run(folder, "drop", 9) == 0
    assert "corrected: split 1 4 --new 3; merge 1 3; swap 0 2 5; rename 2 9; drop 9" in " ".join(
        capsys.readouterr().out.split()
    )
    for _ in range(5):
        assert run(folder, "undo") == 0
    assert "undone: split 1 4 --new 3" in capsys.readouterr().out
    assert sorted(path.name for path in folder.iterdir()) == ["people.npz", "run.json"]
    assert run(folder, "list", "--json") == 0
    listed = json.loads(capsys.readouterr().out)
    assert [track["person"] for track in listed] == [0, 1, 2]
    assert listed[0]["seen"] is None and 1.4 < listed[0]["stature_m"] < 2.1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ["merge", 0, 1],
            "0 and 1 are both present in 10 frames, first in 0, so they are two people",
        ),
        (["drop", 7], "there is no person 7; there are 0 1 2"),
        (["undo"], "there is no correction to undo"),
        (["split", 0, 0], "cannot be split at 0; give a frame from 1 to 9"),
        (["merge", 0], "merge: needs person other, got 1"),
        (["merge", "a", 0], "Invalid value for 'NUMBERS"),
        (["paint"], "'paint' is not one of 'list', 'merge'"),
    ],
)
def test_errors_are_one_sentence(folder, capsys, arguments, sentence):
    assert run(folder, *arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith("error: ") and printed.err.count("\n") == 1
    assert sentence in printed.err


def test_a_folder_without_a_result(tmp_path, capsys):
    assert run(tmp_path) == 2
    assert "people.npz: there is no such file" in capsys.readouterr().err


def test_a_number_that_no_result_has(folder, capsys):
    assert run(folder, "rename", 0, 2**53) == 2
    assert (
        "9007199254740992 is not a valid number of a person; give one from 0 to"
        in capsys.readouterr().err
    )
    assert run(folder, "rename", 0, 2**53 - 1) == 0
    assert Reconstruction.load(folder).person.max() == 2**53 - 1


@pytest.mark.parametrize("text", ["[]", '{"configuration": null}', '{"configuration": []}'])
def test_an_odd_run_json_is_one_sentence(folder, capsys, text):
    for name in ("observations.npz", "cameras.json"):
        (folder / name).write_bytes(b"")
    (folder / "run.json").write_text(text)
    before = contents(folder)
    for words in (["merge", 0, 1], ["drop", 0]):
        assert run(folder, *words) == 2
        printed = capsys.readouterr().err
        assert "run.json: " in printed and "restore it or delete it" in printed
    assert contents(folder) == before
