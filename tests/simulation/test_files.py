"""Simulated recordings as files: whoever reads them finds the scene, and the truth beside it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.files import named_scene, write_simulated
from tests.marks import slow


def run(*arguments: str) -> int:
    """Exit code of a command line."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    return int(caught.value.code or 0)


@pytest.mark.slow
def test_what_is_simulated_can_be_reconstructed_and_compared(tmp_path: Path, capsys):
    assert (
        run("simulate", "demo", "--output", str(tmp_path), "--frames", "40:43", "--seed", "5") == 0
    )
    printed = capsys.readouterr()
    assert "3 frames of 4 people, 6 cameras" in printed.out and printed.err == ""
    truth = Reconstruction.load(tmp_path / "truth")
    scene = built_in_scene(5)
    np.testing.assert_array_equal(truth.joints.reshape(3, 4, 25, 3), scene.keypoints[40:43])
    np.testing.assert_array_equal(
        truth.body_pose.reshape(3, 4, 23, 3), scene.motion.body_pose[40:43]
    )
    np.testing.assert_array_equal(truth.frame, np.repeat([0, 1, 2], 4))
    assert (truth.covariance == 0).all() and (truth.status == Status.OK).all()
    assert truth.run["simulated"]["name"] == "demo" and truth.run["simulated"]["first_frame"] == 40
    for calibration in ("rig.json", "calibration.json"):
        files = ["--calibration", str(tmp_path / calibration), "--detections", str(tmp_path)]
        assert run("reconstruct", *files, "--output", str(tmp_path), "--overwrite") == 0
        found = Reconstruction.load(tmp_path)
        metrics = joint_metrics(found, truth.joints.reshape(3, 4, 25, 3))
        assert metrics.people_found == 12 and metrics.recall > 0.9
    assert len(Reconstruction.load(tmp_path / "truth")) == 12  # the result has not taken its place


@pytest.mark.parametrize("format", ["association", "openpose"])
def test_the_same_seed_gives_the_same_files(tmp_path: Path, format: str):
    options = [
        "simulate",
        "demo",
        "--frames",
        ":2",
        "--cameras",
        "2",
        "--people",
        "2",
        "--format",
        format,
    ]
    for folder, seed in (("one", "1"), ("same", "1"), ("other", "2")):
        assert run(*options, "--output", str(tmp_path / folder), "--seed", seed) == 0
    files = [
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (tmp_path / "one", tmp_path / "same", tmp_path / "other")
    ]
    assert files[0] == files[1] and files[0].keys() == files[2].keys()
    assert len(files[0]) == {"association": 3 + 3, "openpose": 3 + 4}[format]
    assert sum(files[0][name] != files[2][name] for name in files[0]) > 3


@pytest.mark.parametrize(
    ("people", "cameras"), [(1, 2), (4, 3), (0, 6), *slow((12, 6), (4, 12), (12, 12))]
)
def test_any_number_of_people_and_cameras(tmp_path: Path, people: int, cameras: int):
    scene = named_scene("demo", people=people, cameras=cameras).part(range(2))
    written = write_simulated(scene, simulate(scene), tmp_path, "association")
    rig = read_rig(written["cameras"])
    assert len(rig) == cameras
    table = read_detections(written["detections"], rig)
    assert len(table) == 2
    truth = Reconstruction.load(written["truth"])
    assert len(truth) == 2 * people
    for frame, found in enumerate(table):
        xy, _ = rig.project(truth.at(frame).joints)
        inside = np.all((xy >= 0) & (xy <= rig.image_sizes[:, None, None] - 1), axis=-1)
        # Some are missed, and a few false ones come to each view.
        assert 0.3 * inside.sum() <= len(found) <= inside.sum() + 10 * cameras


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["tango"], "tango: must be one of demo salsa crossing crowd"),
        (["demo", "--cameras", "1"], "--cameras 1: must be 2 to 12"),
        (["demo", "--people", "13"], "--people 13: must be 0 to 12"),
        (["demo", "--seed", "-1"], "--seed -1: must not be negative"),
        (["demo", "--frames", "5:2"], "0 <= A < B"),
        (["demo", "--format", "coco"], "'coco' is not one of 'association', 'openpose'"),
        (["salsa", "--split", "train"], "--split train: must be tune or report"),
        (["salsa", "--people", "2"], "salsa has 8 people; leave it out"),
        (["salsa"], "give their file with --mocap"),
        (["crowd", "--mocap", "nowhere.npz"], "nowhere.npz: there is no such file"),
    ],
)
def test_errors_are_one_sentence(tmp_path: Path, monkeypatch, capsys, arguments, sentence):
    monkeypatch.setenv("SHAPEPOSE_DATA", str(tmp_path))
    assert run("simulate", *arguments, "--output", str(tmp_path / "out")) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("error: ") and len(printed.err.splitlines()) == 1
    assert sentence in printed.err
    assert not (tmp_path / "out" / "truth").exists()


def test_frames_of_an_earlier_run_are_not_mixed_with_new_ones(tmp_path: Path, capsys):
    options = [
        "simulate",
        "demo",
        "--people",
        "1",
        "--cameras",
        "2",
        "--format",
        "openpose",
        "--output",
    ]
    assert run(*options, str(tmp_path), "--frames", ":2") == 0
    assert run(*options, str(tmp_path), "--frames", ":1") == 2
    assert "frames of another recording" in capsys.readouterr().err
    assert len(list(tmp_path.glob("openpose/cam0/*.json"))) == 2


@pytest.mark.slow
def test_a_sequence_of_recorded_motions(shared_data: Path, tmp_path: Path, monkeypatch):
    monkeypatch.setenv("SHAPEPOSE_DATA", str(shared_data.parent))
    options = ["simulate", "salsa", "--split", "tune", "--frames", "100:102", "--cameras", "3"]
    assert run(*options, "--output", str(tmp_path)) == 0
    assert len(Reconstruction.load(tmp_path / "truth")) == 2 * 8
    about = json.loads((tmp_path / "truth" / "run.json").read_text())["simulated"]
    assert (
        about["split"] == "tune"
        and about["frames"] == 2
        and about["fps"] == 30
        and about["cuts"] == []
    )
    assert len(read_detections(tmp_path, read_rig(tmp_path / "rig.json"))[1]) > 100


def test_cuts_are_listed_counted_from_the_first_frame_that_is_written(tmp_path: Path):
    scene = built_in_scene(frames=10)
    names = tuple((f"clip {segment}",) for segment in range(4))
    whole = replace(scene, cuts=(2, 5, 8), clips=names)
    part = whole.part(range(2, 8))
    assert part.cuts == (3,) and part.clips == names[1:3] and len(part) == 6
    np.testing.assert_array_equal(part.keypoints, scene.keypoints[2:8])
    written = write_simulated(
        whole.part(range(4, 9)), simulate(scene.part(range(4, 9))), tmp_path, "association"
    )
    truth = Reconstruction.load(written["truth"])
    assert truth.run["simulated"]["cuts"] == [1, 4] and truth.run["simulated"]["fps"] == 25.0
    np.testing.assert_allclose(truth.time_s, truth.frame / 25.0)
