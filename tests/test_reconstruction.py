"""The result: its shapes, its files, and what a killed or failing save leaves behind."""

import json
import os
import signal
import subprocess
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.errors import InputError
from shapepose_fg.files import write_atomically
from shapepose_fg.reconstruction import Reconstruction, Status
from shapepose_fg.skeleton import BODY_25


def people(frames: list[int], seed: int = 0) -> Reconstruction:
    """Random people, one row for each of `frames`; the wrist of the first is unknown."""
    rng = np.random.default_rng(seed)
    N = len(frames)
    joints = rng.normal(size=(N, 25, 3))
    covariance = np.tile(np.eye(3) * 1e-4, (N, 25, 1, 1))
    if N > 0:
        joints[0, 4], covariance[0, 4] = np.nan, np.nan
    return Reconstruction(
        frame=np.array(frames, dtype=int),
        person=np.arange(N),
        joint_names=np.array(BODY_25.joints),
        joints=joints,
        covariance=covariance,
        confidence=rng.uniform(size=(N, 25)),
        betas=rng.normal(size=(N, 10)),
        global_orient=rng.normal(size=(N, 3)),
        body_pose=rng.normal(size=(N, 23, 3)),
        transl=rng.normal(size=(N, 3)),
        status=np.array([Status.OK, *[Status.BODY_UNDETERMINED] * (N - 1)][:N], dtype=str),
        run={"frames": [0, 10], "configuration": {"gate_m": 0.1}},
    )


def assert_same(first: Reconstruction, second: Reconstruction) -> None:
    for name in (*Reconstruction.ROWS, "joint_names"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


def test_saved_and_loaded_is_the_same(tmp_path):
    original = people([0, 0, 3])
    original.save(tmp_path / "new" / "folder")
    for path in (tmp_path / "new" / "folder", tmp_path / "new" / "folder" / "people.npz"):
        loaded = Reconstruction.load(path)
        assert_same(loaded, original)
        assert loaded.run == original.run
    assert sorted(file.name for file in (tmp_path / "new" / "folder").iterdir()) == ["people.npz", "run.json"]


def test_file_has_the_columns_that_are_promised_and_nothing_pickled(tmp_path):
    people([0, 0, 3]).save(tmp_path)
    with np.load(tmp_path / "people.npz", allow_pickle=False) as file:
        shapes = {name: file[name].shape for name in file.files}
        assert file["joint_names"].tolist()[:4] == ["Nose", "Neck", "RShoulder", "RElbow"]
        assert file["status"].tolist() == ["ok", "body undetermined", "body undetermined"]
        assert file["frame"].dtype == np.int64
    assert shapes == {
        "frame": (3,),
        "person": (3,),
        "joint_names": (25,),
        "joints": (3, 25, 3),
        "covariance": (3, 25, 3, 3),
        "confidence": (3, 25),
        "betas": (3, 10),
        "global_orient": (3, 3),
        "body_pose": (3, 23, 3),
        "transl": (3, 3),
        "status": (3,),
    }


def test_nobody_is_saved_too(tmp_path):
    Reconstruction.empty().save(tmp_path)
    assert len(Reconstruction.load(tmp_path)) == 0
    assert len(Reconstruction.concatenate([])) == 0


def test_rows_of_a_frame_and_back_together():
    every = people([0, 0, 3, 7])
    assert [len(every.at(frame)) for frame in (0, 1, 3, 7)] == [2, 0, 1, 1]
    np.testing.assert_array_equal(every.at(3).joints[0], every.joints[2])
    assert_same(Reconstruction.concatenate([every.at(0), every.at(1), every.at(3), every.at(7)]), every)
    assert every.at(3).run == every.run


def test_run_may_hold_arrays_and_paths(tmp_path):
    people([0]).with_run(seconds=np.float64(1.5), counts=np.arange(2), file=tmp_path).save(tmp_path)
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["seconds"] == 1.5
    assert run["counts"] == [0, 1]
    assert run["file"] == str(tmp_path)
    assert run["configuration"] == {"gate_m": 0.1}


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("joints", np.zeros((2, 17, 3)), r"joints must be \(2, 25, 3\), got \(2, 17, 3\)"),
        ("covariance", np.zeros((2, 25, 3)), r"covariance must be \(2, 25, 3, 3\), got"),
        ("frame", np.array([0.5, 1.0]), "frame must hold int64 values, got float64"),
        ("status", np.array(["ok", "fine"]), r"status must be one of \['ok', .*\], got \['fine'\]"),
        ("status", np.array([Status.OK, None]), "status must hold .* values, got object"),
    ],
)
def test_wrong_columns(column, value, message):
    with pytest.raises(ValueError, match=message):
        replace(people([0, 0]), **{column: value})


def test_parts_of_other_skeletons_do_not_mix():
    other = replace(people([0]), joint_names=np.array([f"joint {i}" for i in range(25)]))
    with pytest.raises(ValueError, match="same joint_names"):
        Reconstruction.concatenate([people([0]), other])


def write_bad(path, kind: str) -> None:
    """A file that is not a people.npz, in one of several ways."""
    if kind == "text":
        path.write_text("hello")
    elif kind == "array":
        with path.open("wb") as stream:
            np.save(stream, np.zeros(3))
    elif kind == "other columns":
        np.savez(path, joints=np.zeros((1, 25, 3)))
    elif kind == "pickled":
        np.savez(path, frame=np.array([{}], dtype=object))
    elif kind == "wrong shape":
        columns = {name: getattr(people([0]), name) for name in (*Reconstruction.ROWS, "joint_names")}
        np.savez(path, **(columns | {"betas": np.zeros((1, 11))}))
    elif kind == "cut":
        people([0]).save(path.parent)
        path.write_bytes(path.read_bytes()[:1000])
    elif kind == "zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("frame.npy", "no array")


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("missing", "there is no such file; run a reconstruction first"),
        ("text", "cannot be read as an .npz file without pickled objects"),
        ("array", "cannot be read as an .npz file"),
        ("cut", "cannot be read as an .npz file"),
        ("zip", "column person is missing"),
        ("pickled", "cannot be read as an .npz file without pickled objects (Object arrays cannot be loaded"),
        ("other columns", "column frame is missing; give the people.npz of a reconstruction"),
        ("wrong shape", "betas must be (1, 10), got (1, 11); give the people.npz of a reconstruction"),
    ],
)
def test_bad_files(tmp_path, kind, sentence):
    path = tmp_path / "people.npz"
    write_bad(path, kind)
    with pytest.raises(InputError) as caught:
        Reconstruction.load(tmp_path)
    assert str(caught.value).startswith(f"{path}: ")
    assert sentence in str(caught.value)


def test_bad_run_json(tmp_path):
    people([0]).save(tmp_path)
    (tmp_path / "run.json").write_text("[]")
    with pytest.raises(InputError, match=r"run.json: must hold an object; restore it or delete it"):
        Reconstruction.load(tmp_path)
    (tmp_path / "run.json").unlink()
    assert Reconstruction.load(tmp_path).run == {}


def test_a_save_that_fails_leaves_the_old_files(tmp_path, monkeypatch):
    old = people([0, 0], seed=0)
    old.save(tmp_path)

    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        people([0, 1, 2], seed=1).save(tmp_path)
    monkeypatch.undo()
    assert_same(Reconstruction.load(tmp_path), old)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["people.npz", "run.json"]


def test_run_that_json_cannot_hold_leaves_the_old_files(tmp_path):
    old = people([0, 0])
    old.save(tmp_path)
    with pytest.raises(ValueError, match="not JSON compliant"):
        people([5]).with_run(seconds=float("nan")).save(tmp_path)
    assert_same(Reconstruction.load(tmp_path), old)


KILLED = """
import os, signal, sys
from shapepose_fg.files import write_atomically
from pathlib import Path

def write(stream):
    stream.write(b"new" * 100_000)
    stream.flush()
    os.kill(os.getpid(), signal.SIGKILL)

write_atomically(Path(sys.argv[1]), write)
"""


@pytest.mark.skipif(os.name != "posix", reason="kills a process by a POSIX signal")
def test_a_save_that_is_killed_leaves_the_old_file(tmp_path):
    path = tmp_path / "people.npz"
    path.write_bytes(b"old")
    result = subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False, timeout=60)
    assert result.returncode == -signal.SIGKILL
    assert path.read_bytes() == b"old"
    # The next save is not disturbed by what the killed one left.
    write_atomically(path, lambda stream: stream.write(b"new"))
    assert path.read_bytes() == b"new"


@pytest.mark.skipif(os.name != "posix", reason="file modes are POSIX's")
def test_files_have_the_mode_of_any_other_file(tmp_path):
    people([0]).save(tmp_path)
    (tmp_path / "plain").write_text("")
    assert (tmp_path / "people.npz").stat().st_mode == (tmp_path / "plain").stat().st_mode
