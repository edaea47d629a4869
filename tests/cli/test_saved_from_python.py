"""A result that was saved in Python, README's way: every command that takes a result takes it."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg import InputError, Reconstruction, read_rig, reconstruct
from shapepose_fg.cli.main import main
from shapepose_fg.simulation import built_in_scene, simulate

COMMANDS = {
    "explain": ["explain", "{}", "0", "RWrist", "--frame", "1"],
    "report": ["report", "{}"],
    "export": ["export", "{}", "trc", "csv", "glb"],
    "tracks": ["tracks", "{}"],
    "export rrd": ["export", "{}", "rrd"],
}


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(frames=3)


@pytest.fixture(scope="module")
def people(scene) -> Reconstruction:
    return reconstruct(simulate(scene), scene.rig)


def run(capsys, *line: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        main(list(map(str, line)))
    said = capsys.readouterr()
    return int(end.value.code or 0), said.out, said.err


@pytest.mark.parametrize("command", COMMANDS)
def test_what_was_saved_is_taken_by_every_command(people, tmp_path, capsys, command):
    if command == "export rrd":
        pytest.importorskip("rerun")
    people.save(tmp_path)
    code, _, err = run(capsys, *(word.format(tmp_path) for word in COMMANDS[command]))
    assert code == 0, err
    assert "cameras.json" not in err


def test_the_cameras_are_those_that_it_was_solved_with(people, scene, tmp_path):
    people.save(tmp_path)
    for name in ("wTc", "K"):
        kept = [getattr(camera, name) for camera in read_rig(tmp_path / "cameras.json").cameras]
        np.testing.assert_array_equal(kept, [getattr(camera, name) for camera in scene.rig.cameras])


def test_a_result_without_cameras_is_saved_with_them_or_the_command_says_how(
    people, scene, tmp_path, capsys
):
    loaded = replace(people, rig=None)
    loaded.save(tmp_path / "bare")
    for line in (
        ["explain", tmp_path / "bare", 0, "RWrist", "--frame", 1],
        ["overlay", tmp_path / "bare"],
    ):
        code, _, err = run(capsys, *line)
        assert code == 2 and err.count("\n") == 1 and "people.save(folder, rig)" in err
    code, _, err = run(capsys, "export", tmp_path / "bare", "trc")
    assert code == 2 and "--up z" in err
    loaded.save(tmp_path / "whole", scene.rig)
    assert run(capsys, *["explain", tmp_path / "whole", 0, "RWrist", "--frame", 1])[0] == 0


def test_parts_put_together_keep_their_cameras(people, scene, tmp_path):
    first, rest = people.rows(people.frame == 0), people.rows(people.frame > 0)
    Reconstruction.concatenate([first, rest]).save(tmp_path)
    assert read_rig(tmp_path / "cameras.json").names == scene.rig.names


def test_another_programs_calibration_is_not_overwritten(people, scene, tmp_path):
    theirs = '{"cameras": []}'
    (tmp_path / "cameras.json").write_text(theirs)
    with pytest.raises(InputError, match="another folder"):
        people.save(tmp_path)
    assert (tmp_path / "cameras.json").read_text() == theirs and not (
        tmp_path / "people.npz"
    ).exists()


def test_cameras_that_are_not_those_of_the_observations_are_refused(people, scene, tmp_path):
    other = replace(scene.rig, cameras=scene.rig.cameras[::-1])
    with pytest.raises(ValueError, match="cameras of the observations"):
        people.save(tmp_path, other)
    assert not (tmp_path / "people.npz").exists()
