"""One line, or one camera, does not end or silence a live reconstruction for the others."""

import json
import resource
import socket
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.live import sockets
from shapepose_fg.live.cameras import CameraState
from shapepose_fg.live.inputs import feed
from shapepose_fg.live.notes import SparingNotes
from shapepose_fg.live.sockets import MOST_CLIENTS
from tests.marks import slow

HZ = 60
YEAR_S = 3.15e7
FRAMES = 14


@pytest.fixture
def live(start, five_cameras):
    return start(five_cameras)


@pytest.fixture(scope="module")
def seen(five_cameras, two_people, seen_exactly):
    return seen_exactly(five_cameras, two_people)


def views(rig, seen, frames=range(FRAMES), shift_s=0.0):
    """What each camera gives of two people who stand still: its name, its detections, when."""
    for frame in frames:
        for view, name in enumerate(rig.names):
            yield [name, seen.only(seen.view == view), shift_s + frame / HZ]


def play(live, given) -> list[str]:
    """Push views; why those that were refused were."""
    refused = []
    for each in given:
        try:
            live.push_view(*each)
        except ValueError as error:
            refused.append(str(error))
    live.finish()
    return refused


def two_people_are_there(live, at_s: float) -> None:
    people = live.people()
    assert len(people) == 2 and np.isfinite(people.joints).all()
    assert people.time_s[0] == pytest.approx(at_s, abs=1.5 / HZ)


@pytest.mark.parametrize("hz", [60, *slow(5, 24, 200)])
def test_no_picture_is_dropped_at_any_rate(live, five_cameras, seen, hz):
    for frame in range(8):
        for view, name in enumerate(five_cameras.names):
            live.push_view(name, seen.only(seen.view == view), 100 + frame / hz + view / hz / 7)
    live.finish()
    assert (live.report().frames, live.report().dropped, live.report().late) == (8, 0, 0)


@pytest.mark.parametrize("shift_s", [-3.0, *slow(9e11, 3.0)])
@pytest.mark.parametrize("which", [0, 31], ids=["the first", "a later"])
def test_one_time_that_is_wrong_moves_nobody_s_clock(live, five_cameras, seen, which, shift_s):
    given = list(views(five_cameras, seen))
    given[which][2] += shift_s
    play(live, given)
    report = live.report()
    assert report.frames >= FRAMES - 1 and report.dropped <= 1 and report.jumps == 0
    two_people_are_there(live, (FRAMES - 1) / HZ)


@pytest.mark.parametrize("shift_s", [-5.0, *slow(YEAR_S)])
def test_a_camera_whose_clock_is_set_is_left_out_and_named(live, five_cameras, seen, shift_s):
    given = list(views(five_cameras, seen))
    for each in given[30:]:
        each[2] += shift_s if each[0] == five_cameras.names[2] else 0.0
    play(live, given)
    assert live.report().frames == FRAMES and live.report().jumps == 0
    said = [(each.camera, each.state) for each in live.camera_changes()]
    assert (
        five_cameras.names[2],
        CameraState.OFF_CLOCK,
    ) not in said  # eight views are too few to say
    again = list(views(five_cameras, seen, range(FRAMES, 2 * FRAMES)))
    for each in again:
        each[2] += shift_s if each[0] == five_cameras.names[2] else 0.0
    play(live, again)
    said = [(each.camera, each.state) for each in live.camera_changes()]
    assert (five_cameras.names[2], CameraState.OFF_CLOCK) in said
    two_people_are_there(live, (2 * FRAMES - 1) / HZ)


@pytest.mark.slow
@pytest.mark.parametrize("shift_s", [YEAR_S, 5.0, -5.0])
def test_cameras_whose_clocks_are_set_together_go_on(live, five_cameras, seen, shift_s):
    play(live, views(five_cameras, seen))
    names = set(live.people().person.tolist())
    assert play(live, views(five_cameras, seen, range(FRAMES, 2 * FRAMES), shift_s)) == []
    report = live.report()
    assert (report.frames, report.dropped, report.jumps) == (2 * FRAMES, 0, 1)
    two_people_are_there(live, (2 * FRAMES - 1) / HZ + shift_s)
    later = set(live.people().person.tolist())
    # After a short pause they are the same; else nobody is called as somebody before.
    assert later == names if shift_s == 5.0 else not later & names


@pytest.mark.slow
def test_most_cameras_decide_which_clock_is_right(live, five_cameras, seen):
    """Two of five cameras jump together, then three more follow."""
    play(live, views(five_cameras, seen))
    given = list(views(five_cameras, seen, range(FRAMES, 3 * FRAMES)))
    for each in given:
        each[2] += 3600 if each[0] in five_cameras.names[:2] else 0
    play(live, given)
    two_people_are_there(live, (3 * FRAMES - 1) / HZ)
    play(live, views(five_cameras, seen, range(3 * FRAMES, 4 * FRAMES), 3600))
    two_people_are_there(live, (4 * FRAMES - 1) / HZ + 3600)


@pytest.mark.slow
@pytest.mark.parametrize("shift_s", [YEAR_S, -YEAR_S])
def test_whole_frames_of_another_time_are_survived(live, five_cameras, seen, shift_s):
    for frame in range(8):
        live.push(seen, frame / HZ)
    live.push(seen, shift_s)
    for frame in range(8, 30):
        live.push(seen, frame / HZ)
    live.finish()
    two_people_are_there(live, 29 / HZ)
    with pytest.raises(ValueError, match="must be within 2 s"):
        live.push(seen, np.array([0.5, 0.5, 0.5, 0.5, YEAR_S]))


def shifted(metres: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = metres
    return pose


@pytest.mark.slow
@pytest.mark.parametrize(
    ("which", "pose"),
    [(0, shifted(1e9)), (0, shifted(9e5)), (0, 2 * np.eye(4)), (31, np.eye(4)), (31, shifted(9e5))],
)
def test_one_pose_for_a_camera_that_stands_still(live, five_cameras, seen, which, pose):
    given = list(views(five_cameras, seen, range(40)))
    given.insert(which, [*given[which], pose])
    refused = play(live, given)
    report = live.report()
    assert report.frames == 40
    name = five_cameras.names[given[which][0] == five_cameras.names[1]]
    assert all(name in each for each in refused)
    # A first pose that could be one is believed for a second at the most.
    assert len(refused) == 1 if which > 0 or abs(pose).max() in (1e9, 2) else len(refused) <= 30
    two_people_are_there(live, 39 / HZ)


def lines_of(rig, count: int) -> list[bytes]:
    people = [{"pose_keypoints_2d": [1.0] * 75}]
    return [
        json.dumps({"camera": rig.names[n % len(rig)], "time_s": n / HZ, "people": people}).encode()
        for n in range(count)
    ]


RUBBISH = {
    "not UTF-8": b'{"camera": "\xff\xfe"}',
    "zeros": b"\0\0\0",
    "cut": b'{"camera": "c',
    "deep": b"[" * 100_000,
    "a long number": b'{"time_s": ' + b"9" * 100_000 + b"}",
    "a key twice": b'{"camera": "a", "camera": "a"}',
    "too long": b"x" * 3_000_000,
    "another camera": b'{"camera": "x", "time_s": 0, "people": []}',
    "no time": b'{"camera": "cam0", "time_s": 1e400, "people": []}',
    "a number": b"1",
}


def fed(tmp_path, rig, content: bytes, push=None):
    """Views and notes of a file of lines."""
    taken, notes = [], []
    (tmp_path / "in.jsonl").write_bytes(content)
    take = push or (lambda *view: taken.append(view))
    feed(str(tmp_path / "in.jsonl"), rig, BODY_25, notes.append, take)
    return taken, notes


@pytest.mark.parametrize("what", RUBBISH)
def test_a_line_of_rubbish_is_left_out_and_named(tmp_path, five_cameras, what):
    lines = lines_of(five_cameras, 9)
    taken, notes = fed(tmp_path, five_cameras, b"\n".join([*lines[:4], RUBBISH[what], *lines[4:]]))
    assert [view[2] for view in taken] == [n / HZ for n in range(9)]
    assert len(notes) == 1 and "in.jsonl, line 5" in notes[0] and "left out" in notes[0]
    with pytest.raises(InputError, match=r"in\.jsonl, line 1"):
        fed(tmp_path, five_cameras, b"\n".join([RUBBISH[what], *lines]))
    with pytest.raises(InputError, match=r"in\.jsonl, line 14"):
        fed(tmp_path, five_cameras, b"\n".join([*lines[:4], *[RUBBISH[what]] * 20]))


def test_marks_of_editors_and_empty_lines_are_no_rubbish(tmp_path, five_cameras):
    lines = lines_of(five_cameras, 9)
    for content in (
        b"\xef\xbb\xbf" + b"\r\n".join(lines),
        b"\n\n".join(lines),
        b"\n \n" + b"\n".join(lines),
    ):
        assert len(fed(tmp_path, five_cameras, content)[0]) == 9


def test_a_file_of_which_no_line_is_taken_is_refused(tmp_path, five_cameras):
    def push(*view):
        raise ValueError("it moves")

    with pytest.raises(InputError, match=r"in\.jsonl, line 1: it moves"):
        fed(tmp_path, five_cameras, b"\n".join(lines_of(five_cameras, 20)), push)


@pytest.mark.slow
def test_a_line_without_end_takes_no_memory(tmp_path, five_cameras):
    with (tmp_path / "in.jsonl").open("wb") as stream:
        stream.write(b"\n".join([*lines_of(five_cameras, 4), b""]))
        stream.truncate(2**28)  # zeros: takes no room on the disk
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    notes: list[str] = []
    feed(str(tmp_path / "in.jsonl"), five_cameras, BODY_25, notes.append, lambda *view: None)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**16  # KiB
    assert "longer than" in notes[0]


def test_notes_do_not_flood():
    told: list[str] = []
    with SparingNotes(told.append) as note:
        for n in range(1000):
            note(str(n))
    assert (
        told[:3] == ["0", "1", "2"]
        and 10 < len(told) < 20
        and "more notes were left out" in told[-1]
    )


class Served:
    """A socket that is fed from, in a thread, and what came of it."""

    def __init__(self, rig, push=None):
        self.port, self.taken, self.notes, self.rig = None, [], [], rig
        self.push = push or (lambda *view: self.taken.append(view))
        listening = sockets.listen("tcp://:0")
        self.port = listening.getsockname()[1]
        listening.close()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self):
        feed(f"tcp://:{self.port}", self.rig, BODY_25, self.notes.append, self.push)

    def client(self) -> socket.socket:
        for _ in range(200):
            try:
                return socket.create_connection(("127.0.0.1", self.port), timeout=60)
            except ConnectionRefusedError:
                time.sleep(0.05)
        raise TimeoutError

    def wait_for(self, count: int) -> None:
        self._wait(lambda: len(self.taken) >= count)
        assert len(self.taken) == count

    def wait_for_note(self, words: str) -> None:
        """Notes are written by the thread that lets clients in: nothing orders them against frames
        taken.
        """
        self._wait(lambda: any(words in each for each in self.notes))
        assert any(words in each for each in self.notes), self.notes

    def _wait(self, until: Callable[[], bool]) -> None:
        last = time.monotonic() + 60
        while not until() and time.monotonic() < last:
            time.sleep(0.01)


def test_a_client_s_rubbish_is_named_and_the_others_go_on(five_cameras):
    served, lines = Served(five_cameras), lines_of(five_cameras, 60)
    with served.client() as good:
        good.sendall(b"\n".join([*lines[:5], b""]))
        served.wait_for(5)
        for number, rubbish in enumerate(RUBBISH.values()):
            with served.client() as bad:  # cut off at once
                try:
                    bad.sendall(rubbish + b"\n")
                    assert bad.recv(1) == b""
                except ConnectionError:
                    pass
            good.sendall(lines[5 + number] + b"\n" + rubbish + b"\n")  # its lines are left out
            good.sendall(lines[15 + number] + b"\n")
            served.wait_for(7 + 2 * number)
        with served.client() as once_good:
            once_good.sendall(b"\n".join([lines[30], *[b"x"] * 10, b""]))
            assert once_good.recv(1) == b""
        served.wait_for(26)
        assert all(each.count("127.0.0.1:") == 1 and "line" in each for each in served.notes)
    served.thread.join(timeout=60)
    assert not served.thread.is_alive()


def test_idle_connections_make_room_and_clients_may_come_again(five_cameras):
    served, lines = Served(five_cameras), lines_of(five_cameras, 9)
    with served.client() as good:
        good.sendall(lines[0] + b"\n")
        served.wait_for(1)
        idle = [served.client() for _ in range(MOST_CLIENTS + 20)]
        good.sendall(lines[1] + b"\n")
        served.wait_for(2)
        served.wait_for_note("at most 64 clients are served")
        with served.client() as other:
            other.sendall(lines[2] + b"\n")
            served.wait_for(3)
    with served.client() as again:
        again.sendall(lines[3])
    served.wait_for(4)
    served.thread.join(timeout=60)  # although the idle ones are still there
    assert not served.thread.is_alive()
    for each in idle:
        each.close()


def test_what_is_refused_because_of_others_cuts_nobody_off(five_cameras):
    taken = list[tuple]()

    def push(*view):
        taken.append(view)
        if len(taken) <= 30:
            raise ValueError("it moves")
        served.taken.append(view)

    served = Served(five_cameras, push)
    with served.client() as good:
        good.sendall(b"\n".join([*lines_of(five_cameras, 31), b""]))
        served.wait_for(1)
    served.thread.join(timeout=60)


def test_readers_are_bounded(monkeypatch):
    from shapepose_fg.live import outputs

    monkeypatch.setattr(outputs, "MOST_CLIENTS", 3)
    notes: list[str] = []
    listening = sockets.listen("tcp://:0")
    port = listening.getsockname()[1]
    with outputs._Listeners(listening, notes.append) as listeners:
        # Nothing is sent yet: far more than the system would let wait are answered at once.
        clients = [socket.create_connection(("127.0.0.1", port), timeout=60) for _ in range(300)]
        first, late = clients[:3], clients[3:]
        assert [each.recv(1) for each in late] == [b""] * 297
        for _ in range(400):
            listeners.send("b" * 100_000 + "\n")
            first[0].recv(2**20)
    assert sum("rejected" in each for each in notes) == 297
    assert sum("too slow" in each for each in notes) == 2
    for each in clients:
        each.close()
