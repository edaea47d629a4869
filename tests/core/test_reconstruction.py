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

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Known, Reconstruction, Status
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.storage.files import write_atomically


def people(frames: list[int], seed: int = 0) -> Reconstruction:
    """Random people, one row for each of `frames`; the wrist of the first is unknown."""
    rng = np.random.default_rng(seed)
    N = len(frames)
    joints = rng.normal(size=(N, 25, 3))
    covariance = np.tile(np.eye(3) * 1e-4, (N, 25, 1, 1))
    if N > 0:
        joints[0, 4], covariance[0, 4] = np.nan, np.nan
    known = np.full((N, 25), Known.SEEN)
    known[:, 5], known[:, 6] = Known.BODY, Known.MOTION
    known[:1, 4] = Known.UNKNOWN
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
        time_s=np.array(frames) / 25,
        velocity=rng.normal(size=(N, 25, 3)),
        velocity_covariance=np.tile(np.eye(3) * 1e-2, (N, 25, 1, 1)),
        known=known,
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
    assert sorted(file.name for file in (tmp_path / "new" / "folder").iterdir()) == [
        "people.npz",
        "run.json",
    ]


def test_file_has_the_columns_that_are_promised_and_nothing_pickled(tmp_path):
    people([0, 0, 3]).save(tmp_path)
    with np.load(tmp_path / "people.npz", allow_pickle=False) as file:
        shapes = {name: file[name].shape for name in file.files}
        assert file["joint_names"].tolist()[:4] == ["Nose", "Neck", "RShoulder", "RElbow"]
        assert file["status"].tolist() == ["ok", "body undetermined", "body undetermined"]
        assert file["frame"].dtype == np.int64
        assert file["known_names"][file["known"][0, 3:7]].tolist() == [
            "seen",
            "unknown",
            "body",
            "motion",
        ]
    assert shapes == {
        "frame": (3,),
        "person": (3,),
        "joint_names": (25,),
        "time_s": (3,),
        "joints": (3, 25, 3),
        "covariance": (3, 25, 3, 3),
        "velocity": (3, 25, 3),
        "velocity_covariance": (3, 25, 3, 3),
        "known": (3, 25),
        "known_names": (5,),
        "confidence": (3, 25),
        "betas": (3, 10),
        "global_orient": (3, 3),
        "body_pose": (3, 23, 3),
        "transl": (3, 3),
        "status": (3,),
        "run_id": (),
    }


def test_nobody_is_saved_too(tmp_path):
    Reconstruction.empty().save(tmp_path)
    assert len(Reconstruction.load(tmp_path)) == 0
    assert len(Reconstruction.concatenate([])) == 0


def test_rows_of_a_frame_and_back_together():
    every = people([0, 0, 3, 7])
    assert [len(every.at(frame)) for frame in (0, 1, 3, 7)] == [2, 0, 1, 1]
    np.testing.assert_array_equal(every.at(3).joints[0], every.joints[2])
    assert_same(
        Reconstruction.concatenate([every.at(0), every.at(1), every.at(3), every.at(7)]), every
    )
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
        ("known", np.full((2, 25), 5), "known must hold codes below 5, got 5"),
        ("known", np.full((2, 25), 300), "known must hold 0 to 255, got 300 to 300"),
        ("known", np.full((2, 25), 1.0), "known must hold uint8 values, got float64"),
        ("time_s", np.zeros(3), r"time_s must be \(2,\), got \(3,\)"),
        (
            "velocity_covariance",
            np.zeros((2, 25, 3)),
            r"velocity_covariance must be \(2, 25, 3, 3\)",
        ),
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


def columns_of(people: Reconstruction) -> dict[str, np.ndarray]:
    """What people.npz holds."""
    names = np.array([kind.name.lower() for kind in Known])
    return {name: getattr(people, name) for name in (*Reconstruction.ROWS, "joint_names")} | {
        "known_names": names
    }


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
        np.savez(path, **(columns_of(people([0])) | {"betas": np.zeros((1, 11))}))
    elif kind == "other codes":
        np.savez(path, **(columns_of(people([0])) | {"known_names": np.array(["seen", "guessed"])}))
    elif kind == "no code names":
        np.savez(
            path,
            **{
                name: column
                for name, column in columns_of(people([0])).items()
                if "names" not in name
            },
        )
    elif kind == "cut":
        people([0]).save(path.parent)
        path.write_bytes(path.read_bytes()[:1000])
    elif kind == "zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("frame.npy", "no array")


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        (
            "missing",
            "there is no such file; give the people.npz of a reconstruction, or run one first",
        ),
        ("text", "cannot be read as an .npz file without pickled objects"),
        ("array", "cannot be read as an .npz file"),
        ("cut", "cannot be read as an .npz file"),
        ("zip", "cannot be read as an .npz file"),
        (
            "pickled",
            (
                "cannot be read as an .npz file without pickled objects (frame.npy holds object, "
                "neither numbers"
            ),
        ),
        ("other columns", "column frame is missing; give the people.npz of a reconstruction"),
        (
            "other codes",
            "known_names are not those of this version; give the people.npz of a reconstruction",
        ),
        ("no code names", "column joint_names is missing"),
        (
            "wrong shape",
            "betas must be (1, 10), got (1, 11); give the people.npz of a reconstruction",
        ),
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
    with pytest.raises(
        InputError,
        match=r"run.json: the file must be an object, got a list of 0; restore it or delete it",
    ):
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
from shapepose_fg.core.storage.files import write_atomically
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


ADDED = ("time_s", "velocity", "velocity_covariance", "known")


def test_columns_that_are_not_given_are_unknown():
    old = people([0, 3])
    columns = {
        name: getattr(old, name)
        for name in (*Reconstruction.ROWS, "joint_names")
        if name not in ADDED
    }
    new = Reconstruction(**columns)
    assert (
        np.isnan(new.time_s).all()
        and np.isnan(new.velocity).all()
        and np.isnan(new.velocity_covariance).all()
    )
    assert new.velocity_covariance.shape == (2, 25, 3, 3)
    assert (new.known == Known.UNKNOWN).all()


def test_files_of_the_first_version_still_load(tmp_path):
    """What 0.1.0 wrote: no times, velocities, or ways of knowing."""
    old = people([0, 3])
    columns = {
        name: getattr(old, name)
        for name in (*Reconstruction.ROWS, "joint_names")
        if name not in ADDED
    }
    np.savez_compressed(tmp_path / "people.npz", **columns)
    loaded = Reconstruction.load(tmp_path)
    np.testing.assert_array_equal(loaded.joints, old.joints)
    assert np.isnan(loaded.time_s).all() and (loaded.known == Known.UNKNOWN).all()


def test_joints_are_counted_by_how_they_are_known():
    count = people([0, 0, 3]).counts()["joints"]
    assert count == {"seen": 3 * 23 - 1, "weak": 0, "body": 3, "motion": 3, "unknown": 1}
    assert Reconstruction.empty().counts()["joints"] == {
        "seen": 0,
        "weak": 0,
        "body": 0,
        "motion": 0,
        "unknown": 0,
    }


def part(rows: list[int], **run) -> Reconstruction:
    return replace(people(rows), run=run)


def test_the_run_of_parts_put_together():
    settings = {"candidates": {"gate_m": 0.1}}
    early = part(
        [100], frames=[100, 200], configuration=settings, seconds={"vote": 1.0}, people={"found": 1}
    )
    late = part([200, 201], frames=[200, 300], configuration=settings, people={"found": 2})
    far = part(
        [500], frames=[500, 510], configuration=settings, versions={"numpy": "9"}, inputs={"a": "x"}
    )
    both = Reconstruction.concatenate([late, early])
    assert both.frame.tolist() == [200, 201, 100]
    assert both.run == {"frames": [100, 300], "configuration": settings}
    three = Reconstruction.concatenate([early, late, far]).run
    assert three == {"frames": [[100, 300], [500, 510]], "configuration": settings}
    # Parts of one run are that run, a part that found nobody still covered its frames, and nobody
    # has no say.
    assert Reconstruction.concatenate([early, early.at(7)]).run == early.run
    nobody = replace(Reconstruction.empty(), run={"frames": [200, 210], "configuration": settings})
    assert Reconstruction.concatenate([early, nobody]).run["frames"] == [100, 210]
    assert Reconstruction.concatenate([Reconstruction.empty(), early]).run == early.run
    assert "frames" not in Reconstruction.concatenate([early, part([500])]).run


@pytest.mark.parametrize(
    ("one", "other", "message"),
    [
        (
            {"configuration": {"refine": {"settled_m": 0.1}}},
            {"configuration": {"refine": {"settled_m": 0.2}}},
            "same configuration, but refine.settled_m differs",
        ),
        (
            {"frames": [0, 10]},
            {"frames": [9, 12]},
            "must not overlap, but two of them cover frame 9",
        ),
        (
            {"frames": [0, 10]},
            {"frames": 9},
            r'"frames" must be \[start, stop\] or a list of those, got 9',
        ),
    ],
)
def test_parts_that_do_not_go_together(one, other, message):
    with pytest.raises(ValueError, match=message):
        Reconstruction.concatenate([part([0], **one), part([11], **other)])


def observed(frames: list[int], views: int = 3, seed: int = 0) -> ObservationTable:
    """A table for `people(frames)`: most joints seen, some by nobody, gates of every kind."""
    rng = np.random.default_rng(seed)
    N = len(frames)
    gate = rng.integers(0, len(Gate), (N, 25, views))
    seen = gate != Gate.NOT_SEEN
    return ObservationTable(
        frame=np.array(frames, dtype=int),
        person=np.arange(N),
        joint_names=np.array(BODY_25.joints),
        view_names=np.array([f"cam{view}" for view in range(views)]),
        candidate=np.where(seen, rng.integers(0, 90, seen.shape), -1),
        xy=np.where(seen[..., None], rng.uniform(0, 1000, (*seen.shape, 2)), np.nan),
        confidence=np.where(seen, rng.uniform(0.1, 1, seen.shape), 0),
        residual_px=np.where(seen[..., None], rng.normal(size=(*seen.shape, 2)), np.nan),
        gate=gate,
    )


def with_observations(frames: list[int], seed: int = 0) -> Reconstruction:
    return replace(people(frames, seed), observations=observed(frames, seed=seed))


def test_observations_go_with_their_rows(tmp_path):
    every = with_observations([0, 0, 3, 7])
    picked = every.rows(np.array([3, 1]))
    np.testing.assert_array_equal(
        picked.observations.candidate, every.observations.candidate[[3, 1]]
    )
    back = Reconstruction.concatenate([every.at(frame) for frame in (0, 3, 7)])
    np.testing.assert_array_equal(back.observations.gate, every.observations.gate)
    assert Reconstruction.concatenate([every, Reconstruction.empty()]).observations is not None
    assert Reconstruction.concatenate([every, part([9])]).observations is None
    renamed = every.relabelled(np.array([5, 6, 5, 5]))
    assert renamed.person.tolist() == renamed.observations.person.tolist() == [5, 6, 5, 5]
    with pytest.raises(ValueError, match="observations must have the same person as the people"):
        replace(every, person=np.array([5, 6, 5, 5]))
    every.save(tmp_path)
    np.testing.assert_array_equal(
        Reconstruction.load(tmp_path).observations.xy, every.observations.xy
    )


def test_observations_of_an_earlier_result_do_not_stay(tmp_path):
    with_observations([0, 0]).save(tmp_path)
    assert (tmp_path / "observations.npz").is_file()
    people([0, 0]).save(tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["people.npz", "run.json"]
    observed([0, 5]).save(tmp_path / "observations.npz")
    with pytest.raises(
        InputError, match=r"observations.npz: observations must have the same frame .* delete it"
    ):
        Reconstruction.load(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("file", ["people.npz", "observations.npz"])
def test_a_file_that_is_damaged_anywhere_is_one_sentence_or_none(tmp_path, file):
    """300 files with a few bytes changed, lost or doubled: each loads, or says in one sentence what
    it is.
    """
    with_observations([0, 0, 3]).save(tmp_path)
    path, rng = tmp_path / file, np.random.default_rng(0)
    whole, refused = path.read_bytes(), 0
    for _ in range(300):
        damaged = bytearray(whole)
        place = int(rng.integers(len(whole)))
        # The directory at the end and the headers decide most: half of the damage is done there.
        place = place if rng.random() < 0.5 else len(whole) - 1 - place % 1200
        kind = rng.integers(3)
        if kind == 0:
            damaged[place] ^= int(rng.integers(1, 256))
        elif kind == 1:
            del damaged[place : place + int(rng.integers(1, 200))]
        else:
            damaged[place:place] = damaged[place : place + 30]
        path.write_bytes(bytes(damaged))
        try:
            Reconstruction.load(tmp_path)
        except InputError as error:
            refused += 1
            assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
    assert refused > 200


@pytest.mark.parametrize(
    ("run", "sentence"),
    [
        ({"configuration": []}, "configuration must be an object, got a list of 0"),
        ({"people": 3}, "people must be an object, got 3"),
        ({"seconds": {"vote": "1"}}, "seconds.vote must be a number, got text '1'"),
        ({"time": {"fps": True}}, "time.fps must be a number, got true"),
        ({"cuts": [1.5]}, "cuts[0] must be a whole number, got 1.5"),
        ({"body": 7}, "body must be text, got 7"),
        ({"frames": [[0, 1], [2]]}, '"frames" must be [start, stop] or a list of those'),
        (
            {"frames": [0, 10_000_000_000_000]},
            '"frames" must be [start, stop] of at most 10000000 frames, got [0, 1',
        ),
        (
            {"frames": [[0, 6_000_000], [6_000_000, 12_000_000]]},
            '"frames" must be [start, stop] of at most 10000000',
        ),
        ({"frames": [-5, 3]}, '"frames" must be [start, stop] of at most'),
        ({"frames": [0, 10**18]}, '"frames" must be [start, stop] of at most'),
    ],
)
def test_entries_of_run_json_that_are_read_again(tmp_path, run, sentence):
    people([0]).save(tmp_path)
    (tmp_path / "run.json").write_text(json.dumps(run))
    with pytest.raises(InputError) as caught:
        Reconstruction.load(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / 'run.json'}: ")
    assert sentence in str(caught.value) and "restore it or delete it" in str(caught.value)


def test_files_from_before_weak_joints_had_a_code_still_load(tmp_path):
    """Their codes keep their meaning, and observations without a probability count as certain."""
    old = people([0, 3])
    np.savez(
        tmp_path / "people.npz",
        **(columns_of(old) | {"known_names": columns_of(old)["known_names"][:4]}),
    )
    np.testing.assert_array_equal(Reconstruction.load(tmp_path).known, old.known)
