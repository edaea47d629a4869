"""Runs that are stopped go on, and end as if they had not been; nothing that was done is lost in
silence.
"""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.cli.main import main
from shapepose_fg.cli.stopping import Stopped
from shapepose_fg.core.detections import Recording
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.storage.kept_arrays import InFolder
from shapepose_fg.core.storage.output_folder import only_run_in
from shapepose_fg.core.trust import BELIEVED, Trust, Trusted
from shapepose_fg.estimation.detector_offsets import OffsetConfig
from shapepose_fg.io.config import toml_text
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import PipelineConfig, Task, reconstruct, reconstruct_parts
from shapepose_fg.pipeline.runs.assembly import Assembly
from shapepose_fg.pipeline.runs.manifest import (
    check_room,
    checksum_at_start,
    end_run,
    expected_bytes,
    open_run,
    people_at_start,
    write_people,
)
from shapepose_fg.pipeline.windows import WindowConfig
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.files import write_simulated
from shapepose_fg.tracking import identities
from shapepose_fg.tracking.identities import FollowingConfig

CONFIG = PipelineConfig(
    batch_frames=6,
    following=FollowingConfig(look_ahead_s=0.15),
    windows=WindowConfig(overlap_s=0.1),
    offsets=OffsetConfig(frames=4),
)
CUTS = (24,)


@pytest.fixture(scope="module", autouse=True)
def short_blocks(dance):
    """So that following stands between two windows in the middle of a stretch, too; `dance`, which
    others share, is made before.
    """
    before, identities.BLOCK_S = identities.BLOCK_S, 0.2
    yield
    identities.BLOCK_S = before


@pytest.fixture(scope="module")
def scene():
    """Two people before three cameras, 36 frames: windows of 6, a cut after 24."""
    return built_in_scene(seed=1, people=2, cameras=3, frames=36)


@pytest.fixture(scope="module")
def recording(scene):
    return simulate(scene, seed=1)


@pytest.fixture(scope="module")
def whole(scene, recording, tmp_path_factory) -> Path:
    """The files of the run that nobody stopped, in memory."""
    folder = tmp_path_factory.mktemp("whole")
    reconstruct(recording, scene.rig, CONFIG, cuts=CUTS).save(folder)
    return folder


def assert_same_files(folder: Path, expected: Path) -> None:
    """To the byte; of run.json all but the times."""
    for name in ("people.npz", "observations.npz"):
        assert (folder / name).read_bytes() == (expected / name).read_bytes(), name
    run, other = (json.loads((each / "run.json").read_text()) for each in (folder, expected))
    for key in other.keys() - {"seconds", "inputs", "time"}:
        assert run[key] == other[key], key


class Interrupted(InFolder):
    """Parts in a folder, until a budget of writes is used up: the run is stopped, before or behind
    the next.
    """

    def __init__(self, folder: Path, writes: int, *, behind: bool) -> None:
        super().__init__(folder)
        self.writes, self.behind = writes, behind

    def keep(self, name, arrays, about=None) -> None:
        self.writes -= 1
        if self.writes < 0 and not self.behind:
            raise Stopped(signal.SIGTERM)
        super().keep(name, arrays, about)
        if self.writes < 0:
            raise Stopped(signal.SIGTERM)


def with_stops(task: Task, folder: Path) -> Assembly:
    """The result of a run that is stopped, and goes on, until it comes to its end."""
    for stops in range(12):
        kept = Interrupted(folder, 4 + stops, behind=stops % 3 == 1)
        try:
            result = reconstruct_parts(kept, task)
        except Stopped:
            continue
        assert stops >= 2
        return result
    raise AssertionError("the run must come to an end")


@pytest.mark.slow
def test_a_run_that_is_stopped_again_and_again_ends_the_same(scene, recording, whole, tmp_path):
    """Stopped around the writes of windows, of where following stands, and of bodies; a window is
    two writes.
    """
    result = with_stops(Task(recording, scene.rig, CONFIG, cuts=CUTS), tmp_path / "parts")
    result.save(tmp_path / "results")
    assert_same_files(tmp_path / "results", whole)
    people = Reconstruction.load(tmp_path / "results")
    assert people.observations is not None and "run_id" not in people.run


KEYFRAMES = replace(CONFIG, windows=replace(CONFIG.windows, keyframe_s=0.12))
WITHOUT_OFFSETS = OffsetConfig(source="none")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "exchanged", "trust"),
    [
        (CONFIG, (0,), BELIEVED),
        (KEYFRAMES, (), BELIEVED),
        (KEYFRAMES, (0,), Trust(left_out=((1, 5, 9),), doubted=((2, 0, 24),))),
    ],
    ids=["one view exchanges sides", "keyframes", "both, and cameras are left out"],
)
def test_a_run_goes_on_whose_frames_are_not_as_the_detector_gave_them(
    scene, recording, tmp_path, config, exchanged, trust
):
    """Detections that are exchanged, thinned or left out before they are given out, and frames
    without people: all are so again when the run goes on.
    """
    mirror = np.array(recording.skeleton.mirror)
    frames = [
        replace(each, joint=np.where(np.isin(each.view, exchanged), mirror[each.joint], each.joint))
        for each in recording
    ]
    task = Task(
        Trusted(Recording(recording.skeleton, frames), trust),
        scene.rig,
        replace(config, offsets=WITHOUT_OFFSETS),
    )
    with_stops(task, tmp_path / "parts").save(tmp_path / "results")
    reconstruct_parts(InFolder(tmp_path / "others"), task).save(tmp_path / "whole")
    assert_same_files(tmp_path / "results", tmp_path / "whole")


def test_what_is_in_memory_and_what_is_in_the_files_is_the_same(dance, tmp_path):
    whole = tmp_path / "whole"
    dance.people.save(whole)
    Reconstruction.load(whole).save(tmp_path)
    for name in ("people.npz", "observations.npz", "run.json"):
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes(), name


@pytest.mark.slow
def test_without_time_it_goes_on_too(scene, recording, tmp_path):
    config = PipelineConfig(temporal=False, batch_frames=4, offsets=WITHOUT_OFFSETS)
    frames = range(4, 12)
    kept = Interrupted(tmp_path / "parts", 4, behind=False)
    with pytest.raises(Stopped):
        reconstruct_parts(kept, Task(recording, scene.rig, config, frames))
    counts = []
    execution = Execution(progress=lambda done, _: counts.append(done))
    task = Task(recording, scene.rig, config, frames)
    result = reconstruct_parts(InFolder(tmp_path / "parts"), task, execution)
    assert counts == [8], "the first window is not solved again"
    result.save(tmp_path)
    reconstruct(recording, scene.rig, config, frames=frames).save(tmp_path / "whole")
    assert_same_files(tmp_path, tmp_path / "whole")


@pytest.fixture(scope="module")
def command(scene, recording, tmp_path_factory) -> list[str]:
    """The command line of the same run, without --output."""
    folder = tmp_path_factory.mktemp("inputs")
    written = write_simulated(scene, recording, folder, "association")
    (folder / "settings.toml").write_text(toml_text(CONFIG))
    options = {"--calibration": written["cameras"], "--detections": written["detections"]}
    options |= {"--config": folder / "settings.toml", "--cuts": CUTS[0], "--workers": 1}
    words = [str(word) for option in options.items() for word in option]
    return ["reconstruct", *words, "--no-report", "--no-check"]


SHORT_BLOCKS = """
import sys, time
from shapepose_fg.core.storage.kept_arrays import InFolder
from shapepose_fg.tracking import identities
identities.BLOCK_S = 0.2
keep, last = InFolder.keep, sys.argv.pop(1)
def keep_and_wait(self, name, *more):
    keep(self, name, *more)
    time.sleep(600 if name == last else 0)
InFolder.keep = keep_and_wait
from shapepose_fg.__main__ import main
main()
"""


def start(last: str, command: list[str], *more: str) -> subprocess.Popen:
    """The command, which waits to be stopped when it has kept `last`."""
    words = [sys.executable, "-c", SHORT_BLOCKS, last, *command, *more]
    return subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=hears_ctrl_c
    )


def hears_ctrl_c() -> None:
    """Whoever runs the tests may ignore it, and what is ignored is inherited."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def wait_for(file: Path, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + 120
    while not file.exists():
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.01)


def finished(command: list[str], *more: str) -> int:
    """The exit code of the same in this process."""
    with pytest.raises(SystemExit) as ended:
        main([*command, *more])
    return ended.value.code


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="stops processes by POSIX signals")
def test_the_command_is_interrupted_and_goes_on(command, tmp_path, capsys):
    """Ctrl-C, then to the end; beside it a run that nobody stopped. Kills: tests/hostile."""
    out = tmp_path / "out"
    with only_run_in(out, []):
        assert finished(command, "--output", str(out)) == 2
    assert f"another run writes its results here (process {os.getpid()})" in capsys.readouterr().err
    first = start("part-000001", command, "--output", str(out))
    wait_for(out / "parts" / "part-000001.safetensors", first)
    first.send_signal(signal.SIGINT)
    _, said = first.communicate(timeout=60)
    assert first.returncode == 130
    assert (
        "frames are stored in" in said
        and "continue with --resume" in said
        and said.count("\n") == 1
    )
    left = {file.name: file.read_bytes() for file in (out / "parts").iterdir()}
    assert finished(command, "--output", str(out)) == 2
    said = capsys.readouterr().err
    assert "there is an interrupted run after " in said and "or start again with --restart" in said
    assert finished(command, "--output", str(out), "--resume", "--fps", "25") == 2
    said = capsys.readouterr().err
    assert "had another time" in said and said.count("\n") == 1
    assert left == {file.name: file.read_bytes() for file in (out / "parts").iterdir()}, (
        "asking loses nothing"
    )
    assert finished(command, "--output", str(out), "--resume") == 0
    assert sorted(file.name for file in out.iterdir()) == sorted(
        ["cameras.json", "observations.npz", "people.npz", "run.json"]
    )
    assert finished(command, "--output", str(tmp_path / "whole")) == 0
    assert_same_files(out, tmp_path / "whole")


@pytest.mark.parametrize(
    ("before", "after"), [((), ("--without", "cam1")), (("--cameras", "cam0,cam2"), ())]
)
def test_a_run_does_not_go_on_with_other_cameras(
    command, tmp_path, capsys, monkeypatch, before, after
):
    def stop(*_: object, **__: object) -> None:
        raise Stopped(signal.SIGTERM)

    with monkeypatch.context() as patched:
        patched.setattr("shapepose_fg.cli.reconstruct.run.reconstruct_parts", stop)
        assert finished(command, "--output", str(tmp_path), *before) == 143
    monkeypatch.setattr("shapepose_fg.pipeline.runs.manifest.Parts", lambda kept: _Done())
    capsys.readouterr()
    for more, said in (
        ((), "continue with --resume"),
        (("--resume",), "had another set of cameras"),
    ):
        assert finished(command, "--output", str(tmp_path), *after, *more) == 2
        assert said in capsys.readouterr().err


EARLY = """
import os, signal, sys
import shapepose_fg.__main__ as begin

class Interrupting:
    def find_spec(self, name, *_):
        if name == "shapepose_fg.cli.main":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
begin.main()
"""


@pytest.mark.skipif(os.name != "posix", reason="stops processes by POSIX signals")
def test_ctrl_c_while_the_program_is_loaded_leaves_no_traceback():
    done = subprocess.run(
        [sys.executable, "-c", EARLY],
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=hears_ctrl_c,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.fixture
def begun(tmp_path) -> Iterator[dict]:
    """A run in `tmp_path` that was stopped behind its first window."""
    values = {
        "inputs": {"a.json": "1"},
        "configuration": {"windows": {"overlap_s": 0.4}},
        "program": "x" * 64,
    }
    kept = open_run(tmp_path, values)
    kept.keep("followed-000000", {})
    yield values


def test_a_run_goes_on_with_the_same_only(tmp_path, begun, monkeypatch):
    monkeypatch.setattr("shapepose_fg.pipeline.runs.manifest.Parts", lambda kept: _Done())
    with pytest.raises(
        InputError,
        match=r"there is an interrupted run after 8 frames; continue with --resume,"
        r" or start again",
    ):
        open_run(tmp_path, begun)
    open_run(tmp_path, begun, resume=True)
    for other, words in (
        ({"inputs": {"a.json": "2"}}, r"another inputs\.a\.json \(1 then, 2 now\)"),
        (
            {"configuration": {"windows": {"overlap_s": 0.5}}},
            r"windows\.overlap_s \(0\.4 then, 0\.5 now\)",
        ),
        ({"program": "y" * 64}, r"another version of this program; start it with the same options"),
    ):
        with pytest.raises(InputError, match=words):
            open_run(tmp_path, begun | other, resume=True)
    assert len(list((tmp_path / "parts").iterdir())) == 2, "all of it is still there"
    open_run(tmp_path, begun, restart=True)
    assert [file.name for file in (tmp_path / "parts").iterdir()] == ["manifest.json"]


class _Done:
    """Parts of eight frames."""

    def notes(self):
        from shapepose_fg.core.notes import Notes

        return Notes(frames=8)


def test_a_run_goes_on_with_the_people_that_it_began_with(tmp_path):
    """The file of shapes may not change under a stopped run, but by its own hand."""
    kept, file = InFolder(tmp_path / "parts"), tmp_path / "shapes.npz"
    body = "b" * 64
    first = SubjectShapes(np.array(["0"]), np.ones((1, 10)), np.eye(10)[None], body)
    more = SubjectShapes(
        np.array(["0", "1"]), np.full((2, 10), 2.0), np.stack([np.eye(10)] * 2), body
    )

    def must_not_load() -> SubjectShapes:
        raise AssertionError("it was read when the run began")

    def stored(people: SubjectShapes) -> bytes:
        content = BytesIO()
        people.write(content)
        return content.getvalue()

    file.write_bytes(stored(first))
    assert people_at_start(kept, file, lambda: first) is first
    again = people_at_start(kept, file, must_not_load)
    assert again.names.tolist() == ["0"] and again.body == body
    np.testing.assert_array_equal(again.betas, first.betas)
    assert checksum_at_start(kept) == hashlib.sha256(stored(first)).hexdigest()
    file.write_bytes(stored(more))
    with pytest.raises(
        InputError,
        match=r"shapes\.npz: this file has changed since the run was interrupted; start"
        r" again",
    ):
        people_at_start(kept, file, must_not_load)
    # Stopped right behind its own writing: that is no change by somebody else, and who was known
    # stays known.
    write_people(kept, file, more)
    assert file.read_bytes() == stored(more)
    assert people_at_start(kept, file, must_not_load).names.tolist() == ["0"]
    file.unlink()
    with pytest.raises(InputError, match="this file has changed"):
        people_at_start(kept, file, must_not_load)


@pytest.mark.parametrize("removed", ["manifest.json", "followed-000000.safetensors"])
@pytest.mark.parametrize("by", ["restart", "end"])
def test_a_kill_while_a_run_is_removed_leaves_nothing_to_be_refused(
    tmp_path, begun, monkeypatch, by, removed
):
    """Whichever file goes first, the next start finds no half of a run."""

    def killed(folder: Path, ignore_errors: bool = False) -> None:
        if folder.exists():
            (folder / removed).unlink()
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("shapepose_fg.pipeline.runs.manifest.shutil.rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            open_run(tmp_path, begun, restart=True) if by == "restart" else end_run(tmp_path)
    kept = open_run(tmp_path, begun, resume=True)
    assert kept.names("") == [], "it begins anew"
    assert [file.name for file in tmp_path.iterdir()] == ["parts"]


def test_a_folder_of_somebody_else_is_left_alone(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "wheel.stl").write_text("mine")
    for options in ({}, {"resume": True}, {"restart": True}):
        with pytest.raises(InputError, match="this is not a run of this program"):
            open_run(tmp_path, {}, **options)
    assert (tmp_path / "parts" / "wheel.stl").read_text() == "mine"


@pytest.mark.slow
def test_a_damaged_part_is_named(scene, recording, tmp_path):
    kept = Interrupted(tmp_path / "parts", 4, behind=False)
    with pytest.raises(Stopped):
        reconstruct_parts(kept, Task(recording, scene.rig, CONFIG, cuts=CUTS))
    assert kept.names("followed") == ["followed-000000"]
    part = tmp_path / "parts" / "part-000000.safetensors"
    part.write_bytes(part.read_bytes()[:-100])
    with pytest.raises(
        InputError, match=r"part-000000\.safetensors: a part of an interrupted run cannot be read"
    ):
        reconstruct_parts(
            InFolder(tmp_path / "parts"), Task(recording, scene.rig, CONFIG, cuts=CUTS)
        )


def test_one_run_at_a_time_and_its_leftovers_are_swept(tmp_path):
    (tmp_path / ".people.npz.abc123.part").write_text("half")
    (tmp_path / ".other.part").write_text("somebody's")
    with only_run_in(tmp_path, ["people.npz"]):
        assert sorted(file.name for file in tmp_path.iterdir()) == [".lock", ".other.part"]
    assert [file.name for file in tmp_path.iterdir()] == [".other.part"]
    (tmp_path / "people.npz").mkdir()
    with (
        pytest.raises(InputError, match=r"people\.npz: this is a folder"),
        only_run_in(tmp_path, ["people.npz"]),
    ):
        pass


class _Usage(NamedTuple):
    free: int


def test_room_is_asked_for_before_the_work(dance, tmp_path, monkeypatch):
    needed = expected_bytes(dance.recording, dance.scene.rig, range(40))
    people = dance.people
    tables = ((people, people.ROWS), (people.observations, people.observations.ROWS))
    held = sum(getattr(table, name).nbytes for table, names in tables for name in names)
    # As parts and as results. Views miss joints, so that fewer people are expected than there are.
    assert 0.5 < needed / (2 * held) < 1.1
    monkeypatch.setattr("shutil.disk_usage", lambda _: _Usage(needed - 1))
    with pytest.raises(
        InputError, match=r"about 2\.\d MB of disk space are needed, and 2\.\d MB are free; free"
    ):
        check_room(tmp_path, needed)
    monkeypatch.setattr("shutil.disk_usage", lambda _: _Usage(needed))
    check_room(tmp_path, needed)
