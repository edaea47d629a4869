"""Who is next, who is tried again and who is given up, with leaders that only say so; and real ones
that die.
"""

import json
import os
import signal
from multiprocessing import Pipe
from pathlib import Path

import pytest

from shapepose_fg.cli.batch import runner as module
from shapepose_fg.cli.batch.command import status_of
from shapepose_fg.cli.batch.runner import Assignment, BatchRunner, Leader
from shapepose_fg.cli.batch.status import BatchStatus, RecordingStatus, read_status
from shapepose_fg.cli.batch.table import Entry
from shapepose_fg.cli.reconstruct.request import Request
from shapepose_fg.cli.reconstruct.run import Ended
from shapepose_fg.cli.stopping import Stopped
from shapepose_fg.core.errors import InputError

DONE = Ended(10, 20, 2, ("cam1 is late",))


class Stage:
    """Leaders that end as they are told, in the order in which they were begun."""

    def __init__(self) -> None:
        self.begun: list[Assignment] = []
        self.ends: dict[str, list[Ended | str]] = {}
        self.frameless: list[str] = []
        """Whose first attempt ends before any frame is done."""
        self.heard: list[tuple] = []
        self.together = 0
        self.alive = 0

    def leader(self, assignment: Assignment) -> "FakeLeader":
        self.begun.append(assignment)
        self.alive += 1
        self.together = max(self.together, self.alive)
        return FakeLeader(self, assignment)

    def began(self, name: str) -> None:
        self.heard.append(("began", name))

    def frames(self, name: str, done: int, count: int) -> None:
        self.heard.append(("frames", name, done, count))

    def ended(self, name: str, *, failed: str | None, again: bool) -> None:
        self.heard.append(("ended", name, failed, again))


class FakeLeader:
    def __init__(self, stage: Stage, assignment: Assignment) -> None:
        self.stage, self.assignment, self.began = stage, assignment, 0.0
        self.messages, tell = Pipe(duplex=False)
        if assignment.name in stage.frameless:
            stage.frameless.remove(assignment.name)
        else:
            (assignment.folder / "parts").mkdir(parents=True, exist_ok=True)
            tell.send((5, 10))
        tell.close()
        self.result = stage.ends.get(assignment.name, [DONE]).pop(0)

    def next(self):
        try:
            return self.messages.recv()
        except EOFError:
            return None

    def ask_to_stop(self) -> None:
        pass

    def end(self):
        self.stage.alive -= 1
        return self.result


@pytest.fixture
def stage(monkeypatch) -> Stage:
    found = Stage()
    monkeypatch.setattr(module, "Leader", found.leader)
    return found


def run(stage: Stage, folder: Path, entries: list[Entry], at_once: int = 1, anew=()) -> BatchStatus:
    of = {entry.name: RecordingStatus({}, anew=entry.name in anew) for entry in entries}
    batch_status = BatchStatus(folder / "batch.json", "t", of)
    sizes = {entry.name: len(entry.name) for entry in entries}
    BatchRunner(entries, sizes, folder, "tcp://x", at_once).run(batch_status, stage)
    return batch_status


def entries(*names: str) -> list[Entry]:
    return [Entry(name, Request()) for name in names]


def test_the_largest_are_begun_first_and_who_failed_comes_again_at_the_end(stage, tmp_path):
    stage.ends = {"bbb": ["disk full", DONE], "cc": ["no", "no again"], "a": [DONE]}
    (tmp_path / "bbb" / "parts").mkdir(parents=True)
    batch_status = run(stage, tmp_path, entries("a", "bbb", "cc"), anew=("bbb", "cc"))
    assert [each.name for each in stage.begun] == ["bbb", "cc", "a", "bbb", "cc"]
    # What was there goes once; what the first attempt left is kept.
    assert [(each.restart, each.resume) for each in stage.begun if each.name == "bbb"] == [
        (True, False),
        (False, True),
    ]
    assert {name: each.status for name, each in batch_status.of.items()} == {
        "a": "done",
        "bbb": "done",
        "cc": "failed",
    }
    assert (
        batch_status.of["cc"].reasons == ("no", "no again") and batch_status.of["cc"].attempts == 2
    )
    assert batch_status.of["bbb"].frames == 10 and batch_status.of["bbb"].warnings == (
        "cam1 is late",
    )
    assert ("ended", "cc", "no", True) in stage.heard and (
        "ended",
        "cc",
        "no again",
        False,
    ) in stage.heard
    assert ("frames", "a", 5, 10) in stage.heard
    assert read_status(tmp_path / "batch.json") == batch_status.of
    content = json.loads((tmp_path / "batch.json").read_text())
    assert (content["done"], content["failed"], content["waiting"]) == (2, 1, 0)


def test_who_is_to_begin_anew_does_so_until_frames_are_done(stage, tmp_path, monkeypatch):
    """A first attempt that ends before its run is begun leaves what was there before: nothing to go
    on with.
    """
    stage.ends, stage.frameless = {"a": ["no memory", DONE]}, ["a"]
    (tmp_path / "a" / "parts").mkdir(parents=True)
    batch_status = run(stage, tmp_path, entries("a"), anew=("a",))
    assert [(each.restart, each.resume) for each in stage.begun] == [(True, False), (True, False)]
    assert batch_status.of["a"].status == "done" and not batch_status.of["a"].anew

    def stop(*_: object) -> None:
        raise Stopped(15)

    for heard, anew in (("began", True), ("frames", False)):
        monkeypatch.setattr(stage, heard, stop)
        batch_status = BatchStatus(
            tmp_path / "batch.json", "t", {"a": RecordingStatus({}, anew=True)}
        )
        batch_status.write()
        with pytest.raises(Stopped):
            stage.ends = {"a": ["stopped"]}
            BatchRunner(entries("a"), {"a": 1}, tmp_path, "tcp://x", 1).run(batch_status, stage)
        assert read_status(tmp_path / "batch.json")["a"].anew == anew
        monkeypatch.undo()
        monkeypatch.setattr(module, "Leader", stage.leader)


def test_a_batch_that_goes_on_knows_who_was_to_begin_anew(tmp_path):
    """--restart, or another wish, that was stopped before anything was begun, and gone on with by
    --resume.
    """
    both = [Entry("a", Request(fps=25.0)), Entry("b", Request(fps=50.0))]

    def anew(entries: list[Entry], **how: bool) -> list[str]:
        options = {"resume": False, "restart": False} | how
        found = status_of(entries, tmp_path, **options)
        BatchStatus(tmp_path / "batch.json", "t", found).write()
        return [name for name, each in found.items() if each.anew]

    assert anew(both) == []
    assert anew(both, resume=True) == []
    other = [both[0], Entry("b", Request(fps=60.0))]
    assert anew(other, resume=True) == ["b"]
    assert anew(other, resume=True) == ["b"], "it has not begun yet"
    assert anew(other, restart=True) == ["a", "b"]
    assert anew(other, resume=True) == ["a", "b"]


def test_no_more_are_led_at_a_time_than_asked(stage, tmp_path):
    batch_status = run(stage, tmp_path, entries(*"abcdefg"), at_once=3)
    assert stage.together == 3 and len(batch_status.names("done")) == 7


def test_recordings_with_shared_shapes_are_led_in_turn_and_not_without_those_before(
    stage, tmp_path
):
    stage.ends = {"bb": ["no", "no"]}
    chain = [Entry("a", Request()), Entry("bb", Request(), "a"), Entry("ccc", Request(), "bb")]
    chain += [Entry("dddd", Request(), "ccc")]
    batch_status = run(stage, tmp_path, chain, at_once=4)
    assert [each.name for each in stage.begun] == ["a", "bb", "bb"] and stage.together == 1
    assert batch_status.names("failed") == ["bb", "ccc", "dddd"]
    assert (
        "needs the body shapes of recording bb, which failed" in batch_status.of["ccc"].reasons[0]
    )


def test_who_was_done_when_all_are_stopped_is_done(stage, tmp_path, monkeypatch):
    def stop(name: str, done: int, count: int) -> None:
        raise Stopped(15)

    monkeypatch.setattr(stage, "frames", stop)
    with pytest.raises(Stopped):
        run(stage, tmp_path, entries("a", "b"), at_once=2)
    assert read_status(tmp_path / "batch.json")["a"].status == "done" and stage.alive == 0


def test_a_damaged_list_is_named(tmp_path):
    file = tmp_path / "batch.json"
    for text, words in (
        ("[]", "this is not the status file of a batch; start again with --restart"),
        ('{"format": "shapepose-fg batch 1"}', "recordings.* must be an object, got null"),
        (
            (
                '{"format": "shapepose-fg batch 1", "recordings": {"a": {"asked": {}, "status": '
                '"lost"}}}'
            ),
            r"a\.status",
        ),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=words):
            read_status(file)


@pytest.mark.slow
def test_a_leader_that_fails_says_why_and_one_that_is_killed_is_noticed(tmp_path):
    lost = Assignment(
        "a", Request(calibration=tmp_path / "no.json", detections=tmp_path), tmp_path, "tcp://x"
    )
    leader = Leader(lost)
    assert leader.next() is None
    told = leader.end()
    assert isinstance(told, str) and told.startswith(
        f"{tmp_path / 'no.json'}: there is no such file"
    )
    assert "error: " in (tmp_path / "log.txt").read_text()
    leader = Leader(lost)
    os.kill(leader._pid.result(), signal.SIGKILL)
    assert leader.next() is None
    assert leader.end() == "its process was killed; there may be too little memory"
