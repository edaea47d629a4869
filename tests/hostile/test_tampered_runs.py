"""Runs that somebody, or the disk, has changed: one sentence, or the same bytes; what was there
before stays.
"""

import json
import os
import random
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.storage.files import inside
from shapepose_fg.core.storage.kept_arrays import InFolder
from shapepose_fg.core.storage.output_folder import only_run_in
from shapepose_fg.pipeline.pipeline import Task, reconstruct, reconstruct_parts
from shapepose_fg.pipeline.runs.manifest import open_run
from tests.hostile import runs

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def task(dance) -> Iterator[Task]:
    """The task; `dance`, which others share, is made before blocks are short."""
    with runs.short_blocks():
        yield runs.task(frames=36)


@pytest.fixture(scope="module")
def stopped(task, tmp_path_factory) -> Path:
    """The parts of a run that was stopped when following stood between two windows, in the middle
    of a stretch.
    """
    folder = tmp_path_factory.mktemp("stopped")
    with pytest.raises(runs.Ended):
        reconstruct_parts(runs.Stopping(folder), task)
    assert len(list(folder.glob("part-*"))) >= 2 and len(list(folder.glob("followed-*"))) in (1, 2)
    return folder


@pytest.fixture(scope="module")
def whole(task, tmp_path_factory) -> Path:
    """The parts and the result of the run that nobody touched."""
    folder = tmp_path_factory.mktemp("whole")
    reconstruct_parts(InFolder(folder / "parts"), task).save(folder)
    return folder


@pytest.fixture
def parts(stopped, tmp_path) -> Path:
    return shutil.copytree(stopped, tmp_path / "parts")


def contents(file: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Arrays of a part, and what is said of them."""
    with safe_open(file, framework="numpy") as opened:
        return {name: opened.get_tensor(name) for name in opened.keys()}, opened.metadata()  # noqa: SIM118


def first(parts: Path, kind: str) -> Path:
    return sorted(parts.glob(f"{kind}-*"))[0 if kind == "part" else -1]


def refused(parts: Path, task: Task) -> str:
    with pytest.raises(InputError) as caught:
        reconstruct_parts(InFolder(parts), task)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_part_that_is_not_as_it_was_written_is_named(parts, task):
    """As somebody who has safetensors would change it: NaN, a metre aside, another frame to go on
    from.
    """
    for kind, name, change in (
        ("part", "joints", lambda joints: np.full_like(joints, np.nan)),
        ("part", "joints", lambda joints: joints + 1.0),
        ("followed", "at", lambda at: at * 0 + 10**12),
    ):
        file = first(parts, kind)
        before = file.read_bytes()
        arrays, said = contents(file)
        save_file(arrays | {name: change(arrays[name])}, file, said)
        text = refused(parts, task)
        assert file.name in text and "its content has changed" in text and "--restart" in text
        file.write_bytes(before)


def test_parts_that_changed_places_or_are_of_another_run_are_refused(parts, task):
    one, other = sorted(parts.glob("part-*"))[:2]
    before = one.read_bytes()
    one.write_bytes(other.read_bytes())
    assert "its content has changed" in refused(parts, task)
    one.write_bytes(before)
    with pytest.raises(InputError, match="it belongs to another run"):
        reconstruct_parts(InFolder(parts, run="b" * 64), task)


@pytest.mark.parametrize(
    ("kind", "name", "change", "sentence"),
    [
        (
            "part",
            "joints",
            lambda joints: np.full_like(joints, np.nan),
            "joints must be numbers where joints are known",
        ),
        ("part", "joints", lambda joints: joints[:, :3], "must be"),
        ("part", "joints", lambda joints: joints * 1e9, "joints must be at most"),
        ("part", "status", lambda status: status + 200, "codes below"),
        ("part", "frame", lambda frame: frame + 10**6, "its rows are not of this run"),
        ("part", "frame", lambda frame: frame * 0, "its rows are not of this run"),
        ("part", "person", lambda person: person * 0, "its rows are not of this run"),
        ("part", "time_s", lambda time_s: time_s * 0 + 0.5, "its rows are not of this run"),
        ("part", "observations.gate", lambda gate: gate * 0, "must agree on what was seen"),
        ("part", "", lambda notes: notes | {"frames": -1}, "notes: frames"),
        ("part", "", lambda notes: [notes], "notes"),
        ("part", "", lambda notes: notes | {"evidence": {"x": 1}}, "notes: evidence"),
        ("followed", "at", lambda at: at * 0 + 10**12, "it continues at frame 1000000000000"),
        ("followed", "at", lambda at: at.astype(float), "at must hold int64"),
        ("followed", "state.mean", lambda mean: mean[..., :4], "must be"),
        ("followed", "state.mean", lambda mean: mean * np.nan, "must be finite"),
        (
            "followed",
            "state.covariance",
            lambda covariance: covariance * 1e200,
            "covariance must be at most",
        ),
        ("followed", "state.ids", lambda ids: ids * 0, "different numbers"),
        ("followed", "state.ids", lambda _: None, "state.ids"),
        ("followed", "state.numbers", lambda numbers: numbers - 10, "must not be negative"),
        (
            "followed",
            "state.rows",
            lambda rows: rows[1:],
            "it continues at frame|are not (of|those of) its frames",
        ),
        ("followed", "rows.candidate", lambda candidate: candidate + 10**6, "of other detections"),
        ("followed", "rows.candidate", lambda candidate: candidate[:, ::-1], "of other detections"),
        ("followed", "rows.track", lambda _: None, "rows.track"),
        ("followed", "detections.joint", lambda joint: (joint + 1) % 25, "of other joints"),
        (
            "followed",
            "detections.joint",
            lambda joint: joint[1:],
            "not those of its frames|must be",
        ),
        ("followed", "detections.joint", lambda _: None, "detections.joint"),
        ("followed", "detections.mirrored", lambda share: share + 2, "mirrored must be at most"),
        ("keypoint", "xyz_m", lambda xyz: xyz + 10, "none longer than"),
    ],
)
def test_what_has_the_right_digests_and_makes_no_sense_is_refused(
    parts, task, kind, name, change, sentence
):
    file, kept = first(parts, kind), InFolder(parts)
    arrays, said = contents(file)
    about = json.loads(said["about"])
    if name and (changed := change(arrays.pop(name))) is not None:
        arrays[name] = changed
    kept.keep(file.stem, arrays, about if name else change(about))
    text = refused(parts, task)
    assert re.search(sentence, text) and file.name in text


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a system with pipes in folders")
def test_a_pipe_or_a_link_among_the_parts_is_refused_at_once(parts, task, tmp_path):
    file = first(parts, "part")
    moved = file.rename(tmp_path / "elsewhere.safetensors")
    os.mkfifo(file)
    assert "pipe" in refused(parts, task)
    file.unlink()
    file.symlink_to(moved)
    assert "link leads out of its folder" in refused(parts, task)
    file.unlink()
    file.symlink_to(file)
    assert "link leads out of its folder" in refused(parts, task)


def test_one_flipped_bit_is_the_same_bytes_or_one_sentence(stopped, task, whole, tmp_path):
    """And the result that is there already stays, whole, until a whole one takes its place."""
    rng, expected = random.Random(0), (whole / "people.npz").read_bytes()
    out = tmp_path / "out"
    people = reconstruct(task.detections, task.rig, task.config, frames=range(6))
    people.save(out)
    before = (out / "people.npz").read_bytes()
    same = 0
    # Of the checkpoints only the newest is read.
    read = sorted(file for file in stopped.iterdir() if file.stem != "followed-000000")
    for number, file in enumerate(read * 3):
        parts = shutil.copytree(stopped, tmp_path / f"parts-{number}")
        content = bytearray(file.read_bytes())
        # The first bytes are the header, where most of what can go wrong is.
        place = rng.randrange(len(content) if number % 3 else min(len(content), 600))
        content[place] ^= 1 << rng.randrange(8)
        (parts / file.name).write_bytes(content)
        try:
            reconstruct_parts(InFolder(parts), task).save(out)
        except InputError as error:
            assert "\n" not in str(error)
            assert (out / "people.npz").read_bytes() == before
        else:
            same += 1
            assert (out / "people.npz").read_bytes() == expected
            people.save(out)
    assert same <= 1, "hardly a bit of a part means nothing"


def test_a_result_that_could_not_be_read_again_replaces_nothing(dance, tmp_path):
    people = dance.people
    people.save(tmp_path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    joints = people.joints.copy()
    joints[np.flatnonzero(people.status == Status.OK)[0]] = np.nan
    for column, value in (("joints", joints), ("transl", people.transl + 1e7)):
        changed = Reconstruction(**{**vars(people), column: value})
        with pytest.raises(
            InputError, match=rf"people\.npz: {column} must be .*the previous files are unchanged"
        ):
            changed.save(tmp_path)
        assert before == {file.name: file.read_bytes() for file in tmp_path.iterdir()}
        np.savez(
            tmp_path / "x.npz", **{name: each.array() for name, each in changed.columns().items()}
        )
        with pytest.raises(InputError, match=f"{column} must be"):
            Reconstruction.load(tmp_path / "x.npz")
        (tmp_path / "x.npz").unlink()


@pytest.mark.parametrize(
    "name", ["=HYPERLINK(1)", "+1", "-nose", "@SUM", "a\nb", "a\tb", "\x1b[31m", "", "n" * 65]
)
def test_names_of_joints_are_names(dance, tmp_path, name):
    columns = {key: each.array() for key, each in dance.people.columns().items()}
    columns["joint_names"] = np.array([name, *dance.people.joint_names[1:]])
    np.savez(tmp_path / "people.npz", **columns)
    with pytest.raises(InputError, match="joint_names must have 1 to 64 printable"):
        Reconstruction.load(tmp_path)


def test_no_link_leads_a_run_out_of_its_folder(tmp_path):
    out, other = tmp_path / "out", tmp_path / "other"
    out.mkdir()
    other.mkdir()
    for name in ("parts", ".parts-gone"):
        (out / name).symlink_to(other)
        with pytest.raises(InputError, match="link leads out of its folder"):
            open_run(out, {})
        (out / name).unlink()
    for name in (".detections", "export", "overlay"):
        (out / name).symlink_to(other)
        with pytest.raises(InputError, match="link leads out of its folder"):
            inside(out, name)
        assert inside(tmp_path, "other") == other
    (other / "mine").write_text("mine")
    (out / ".lock").symlink_to(other / "mine")
    with pytest.raises(InputError, match=r"\.lock: this is a link"), only_run_in(out, ()):
        pass
    assert (other / "mine").read_text() == "mine" and len(list(other.iterdir())) == 1
