"""`shapepose-fg live`: lines of detections in, lines of people out."""

import json
import resource
import socket
import threading
import time

import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.ros.mcap_files import McapWriter
from shapepose_fg.live.sockets import listen


@pytest.fixture
def cameras(tmp_path, five_cameras):
    write_rig(five_cameras, tmp_path / "calibration.json")
    return str(tmp_path / "calibration.json")


def lines(rig, people, frames: int) -> str:
    """What an OpenPose of each camera would write of people who stand still, 10 pictures a
    second.
    """
    xy, _ = rig.project(people)
    rng, written = np.random.default_rng(0), []
    for frame in range(frames):
        for view, name in enumerate(rig.names):
            noisy = xy[view] + rng.normal(0, 1, xy[view].shape)
            flat = np.concatenate([noisy, np.full((*noisy.shape[:2], 1), 0.9)], axis=-1).reshape(
                len(people), -1
            )
            seen = [{"pose_keypoints_2d": each.tolist()} for each in flat]
            written.append(json.dumps({"camera": name, "time_s": frame / 10, "people": seen}))
    return "\n".join(written) + "\n"


@pytest.mark.slow
def test_people_come_out_as_lines(tmp_path, cameras, five_cameras, two_people):
    (tmp_path / "in.jsonl").write_text(lines(five_cameras, two_people, 8))
    given = [
        "live",
        "--calibration",
        cameras,
        "--detections",
        str(tmp_path / "in.jsonl"),
        "--workers",
        "1",
    ]
    with pytest.raises(SystemExit) as ended:
        main([*given, "--output", str(tmp_path / "out.jsonl")])
    assert ended.value.code == 0
    told = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    now, settled = ([each for each in told if each["kind"] == kind] for kind in ("now", "settled"))
    assert [each["time_s"] for each in now] == pytest.approx(np.arange(8) / 10)
    assert [each["time_s"] for each in settled] == pytest.approx(np.arange(8) / 10)
    for frame in (now[-1], settled[4]):
        assert [person["person"] for person in frame["people"]] == [0, 1]
        joints = np.array([person["joints"] for person in frame["people"]])
        order = np.argsort(joints[:, :, 0].mean(axis=1))
        # Pixels are good to 1; a pixel is some 4 mm, of five views.
        assert np.linalg.norm(joints[order] - two_people, axis=-1).mean() < 0.01


def test_frames_without_people_have_a_line(tmp_path, cameras, five_cameras):
    """A reader of the lines notices that everybody has left, and that the program runs."""
    empty = [
        json.dumps({"camera": name, "time_s": frame / 10, "people": []})
        for frame in range(4)
        for name in five_cameras.names
    ]
    (tmp_path / "in.jsonl").write_text("\n".join(empty))
    given = ["--calibration", cameras, "--detections", str(tmp_path / "in.jsonl")]
    with pytest.raises(SystemExit) as ended:
        main(["live", *given, "--workers", "1", "--output", str(tmp_path / "out.jsonl")])
    assert ended.value.code == 0
    told = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert [each["kind"] for each in told] == ["now"] * 4
    assert [each["time_s"] for each in told] == pytest.approx(np.arange(4) / 10)
    assert all(each["people"] == [] for each in told)


def test_times_in_milliseconds_are_said(tmp_path, cameras, five_cameras, capsys):
    views = [(frame, name) for frame in range(4) for name in five_cameras.names]
    given = [json.dumps({"camera": name, "time_s": 4000 * n, "people": []}) for n, name in views]
    (tmp_path / "in.jsonl").write_text("\n".join(given))
    options = ["--calibration", cameras, "--detections", str(tmp_path / "in.jsonl")]
    with pytest.raises(SystemExit) as ended:
        main(["live", *options, "--workers", "1", "--output", str(tmp_path / "out.jsonl")])
    assert ended.value.code == 0
    assert "time_s must be in seconds" in capsys.readouterr().err


@pytest.mark.slow
def test_all_frames_of_a_file_are_refined(tmp_path, cameras, five_cameras, two_people):
    """A file is read faster than its windows are solved."""
    (tmp_path / "in.jsonl").write_text(lines(five_cameras, two_people, 60))
    given = ["--calibration", cameras, "--detections", str(tmp_path / "in.jsonl")]
    with pytest.raises(SystemExit) as ended:
        main(["live", *given, "--workers", "2", "--output", str(tmp_path / "out.jsonl")])
    assert ended.value.code == 0
    told = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    settled = [each["time_s"] for each in told if each["kind"] == "settled"]
    assert settled == pytest.approx(np.arange(60) / 10)


def test_cameras_that_are_not_wanted_are_passed_over(
    tmp_path, cameras, five_cameras, two_people, capsys
):
    (tmp_path / "in.jsonl").write_text(lines(five_cameras, two_people, 4))
    given = [
        "live",
        "--calibration",
        cameras,
        "--detections",
        str(tmp_path / "in.jsonl"),
        "--workers",
        "1",
    ]
    with pytest.raises(SystemExit) as ended:
        main([*given, "--without", five_cameras.names[0], "--output", str(tmp_path / "out.jsonl")])
    assert ended.value.code == 0
    told = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert [len(each["people"]) for each in told if each["kind"] == "now"] == [2] * 4
    assert "the line is left out" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("{", "standing.jsonl, line 1: line 1 column 2 is not JSON"),
        ('{"camera": "9", "time_s": 0, "people": []}', "there is no camera 9"),
        ('{"camera": "CAM", "people": []}', "time_s is missing"),
        (
            '{"camera": "CAM", "time_s": 0, "people": [{"pose_keypoints_2d": [1, 2]}]}',
            "75 numbers per person",
        ),
    ],
)
def test_a_line_that_is_none_is_named(tmp_path, cameras, five_cameras, capsys, line, said):
    file = tmp_path / "standing.jsonl"
    file.write_text(line.replace("CAM", five_cameras.names[0]) + "\n")
    with pytest.raises(SystemExit) as ended:
        main(["live", "--calibration", cameras, "--detections", str(file), "--workers", "1"])
    assert ended.value.code == 2
    told = " ".join(capsys.readouterr().err.split())
    assert said in told and "line 1" in told and "Traceback" not in told


@pytest.mark.parametrize("content", ["", "\n\n"])
def test_an_input_without_detections_is_said(tmp_path, cameras, capsys, content):
    (tmp_path / "seen.jsonl").write_text(content)
    given = ["--calibration", cameras, "--detections", str(tmp_path / "seen.jsonl")]
    with pytest.raises(SystemExit) as ended:
        main(["live", *given, "--workers", "1"])
    assert ended.value.code == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "seen.jsonl: the input ended without detections; check" in told


def started(arguments: list[str]) -> threading.Thread:
    """The command in a thread, which ends with its input."""

    def run() -> None:
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == 0

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def connected(port: int) -> socket.socket:
    """To a command that is about to listen."""
    for _ in range(600):
        try:
            return socket.create_connection(("127.0.0.1", port), timeout=60)
        except ConnectionRefusedError:
            time.sleep(0.1)
    raise TimeoutError


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def test_detections_come_and_people_go_by_sockets(
    tmp_path, cameras, five_cameras, two_people, capsys
):
    inward, outward, text = free_port(), free_port(), lines(five_cameras, two_people, 8)
    ends = ["--detections", f"tcp://:{inward}", "--output", f"tcp://:{outward}", "--workers", "1"]
    thread = started(["live", "--calibration", cameras, *ends])
    with connected(outward) as people, connected(inward) as sender:
        with connected(inward) as stranger:  # who talks nonsense is cut off, the others go on
            stranger.sendall(b"GET / HTTP/1.1\n")
            assert stranger.recv(1) == b""
        sender.sendall(text.encode())
        sender.shutdown(socket.SHUT_WR)
        told = [json.loads(line) for line in people.makefile()]
    thread.join(timeout=60)
    assert [each["time_s"] for each in told if each["kind"] == "now"] == pytest.approx(
        np.arange(8) / 10
    )
    assert len(told[-1]["people"]) == 2
    assert "the connection is closed" in capsys.readouterr().err


@pytest.mark.slow
def test_detections_and_people_are_mcap(tmp_path, cameras, five_cameras, two_people):
    pytest.importorskip("mcap_ros2", reason='needs pip install "shapepose-fg[ros]"')
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    text, seen, out = (
        lines(five_cameras, two_people, 8),
        tmp_path / "seen.mcap",
        tmp_path / "out.mcap",
    )
    with seen.open("wb") as stream, McapWriter(stream, None) as writer:
        for line in map(json.loads, text.splitlines()):
            flat = [each["pose_keypoints_2d"] for each in line["people"]]
            writer.detections(line["camera"], flat, line["time_s"], five_cameras)
    (tmp_path / "in.jsonl").write_text(text)
    given = ["live", "--calibration", cameras, "--workers", "1", "--detections"]
    for source, target in (
        (str(seen), str(out)),
        (str(tmp_path / "in.jsonl"), str(tmp_path / "out.jsonl")),
    ):
        with pytest.raises(SystemExit) as ended:
            main([*given, source, "--output", target])
        assert ended.value.code == 0
    with out.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = [
            message
            for *_, message in reader.iter_decoded_messages(
                topics=["/people/now", "/people/settled"]
            )
        ]
    told = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    for kind in ("now", "settled"):
        mine = [each for each in found if each.kind == kind]
        theirs = [each for each in told if each["kind"] == kind]
        assert len(mine) == len(theirs) == 8
        for here, there in zip(mine, theirs, strict=True):
            joints = [np.reshape(list(each.joints), (25, 3)) for each in here.people]
            # Lines are rounded to 0.1 mm, and stamps to nanoseconds.
            expected = [
                np.array([[np.nan] * 3 if x is None else x for x in p["joints"]], float)
                for p in there["people"]
            ]
            np.testing.assert_allclose(joints, expected, rtol=1e-5, atol=1e-4)


@pytest.mark.slow
def test_people_can_be_looked_at_while_they_go_elsewhere(
    tmp_path, cameras, five_cameras, two_people, capfd
):
    """One person leaves after six of 30 pictures: rerun is told who is known in the newest
    moment.
    """
    rerun = pytest.importorskip("rerun")
    both, one = lines(five_cameras, two_people, 6), lines(five_cameras, two_people[:1], 30)
    later = [json.loads(line) for line in one.splitlines()][6 * len(five_cameras) :]
    (tmp_path / "in.jsonl").write_text(both + "\n".join(map(json.dumps, later)))
    out, looked = tmp_path / "out.jsonl", tmp_path / "people.rrd"
    given = [
        "live",
        "--calibration",
        cameras,
        "--detections",
        str(tmp_path / "in.jsonl"),
        "--workers",
        "1",
    ]
    with pytest.raises(SystemExit) as ended:
        main([*given, "--output", str(out), "--output", str(looked)])
    assert ended.value.code == 0 and "WARN" not in capfd.readouterr().err
    told = [json.loads(line) for line in out.read_text().splitlines()]
    now = {each["time_s"]: each["people"] for each in told if each["kind"] == "now"}
    chunks = list(rerun.chunk.RrdReader(looked).stream())
    assert {"/world/people/1/body/head", "/world/people/0/bones", "/world/cameras/cam2"} < {
        each.entity_path for each in chunks
    }
    assert all(any(person["joints"]) for people in now.values() for person in people)
    for who in (0, 1):
        tables = [
            each.to_record_batch()
            for each in chunks
            if each.entity_path == f"/world/people/{who}/joints"
        ]
        rows = [row for table in tables for row in table.to_pylist()]
        shown = {row["time"].total_seconds(): row["Points3D:positions"] for row in rows}
        expected = {
            time_s: [joint for joint in person["joints"] if joint]
            for time_s, people in now.items()
            for person in people
            if person["person"] == who
        }
        assert sorted(shown) == pytest.approx(sorted(expected)) and len(shown) >= 6
        for time_s, joints in zip(
            sorted(shown), (expected[each] for each in sorted(expected)), strict=True
        ):
            np.testing.assert_allclose(shown[time_s], joints, atol=1e-4)
    (stays,) = (each["person"] for each in now[2.9])
    cleared = {
        each.entity_path
        for each in chunks
        if each.entity_path in ("/world/people/0", "/world/people/1")
    }
    assert cleared == {f"/world/people/{1 - stays}"}


def test_a_socket_listens_on_this_machine_only_unless_told_otherwise():
    with listen("tcp://:0") as own, listen("tcp://0.0.0.0:0") as everybody:
        assert own.getsockname()[0] == "127.0.0.1" and everybody.getsockname()[0] == "0.0.0.0"
    for wrong in ("tcp://", "tcp://:70000", "tcp://:5000/way", "tcp://no.such.host.invalid:5000"):
        with pytest.raises(InputError, match="cannot be opened"):
            listen(wrong)


@pytest.mark.parametrize(
    ("seen", "out", "said"),
    [
        ("in.jsonl", "in.jsonl", "in.jsonl: this is the input; give another file"),
        ("in.jsonl", "link.jsonl", "link.jsonl: this is the input; give another file"),
        ("none.jsonl", "old.jsonl", "none.jsonl: there is no such file"),
        (".", "old.jsonl", "this is a folder"),
    ],
)
def test_no_file_is_emptied_by_a_wrong_name(
    tmp_path, cameras, five_cameras, two_people, capsys, seen, out, said
):
    text = lines(five_cameras, two_people, 2)
    for name in ("in.jsonl", "old.jsonl"):
        (tmp_path / name).write_text(text)
    (tmp_path / "link.jsonl").symlink_to(tmp_path / "in.jsonl")
    given = ["--detections", str(tmp_path / seen), "--output", str(tmp_path / out)]
    with pytest.raises(SystemExit) as ended:
        main(["live", "--calibration", cameras, "--workers", "1", *given])
    assert ended.value.code == 2 and said in capsys.readouterr().err
    assert (tmp_path / out).read_text() == text


@pytest.mark.parametrize("name", ["out.jsonl", "out.mcap"])
def test_a_full_disk_names_the_output(tmp_path, cameras, five_cameras, two_people, capsys, name):
    """A limit on file sizes stands for the full disk."""
    if name.endswith(".mcap"):
        pytest.importorskip("mcap_ros2")
    (tmp_path / "in.jsonl").write_text(lines(five_cameras, two_people, 4))
    given = ["--calibration", cameras, "--detections", str(tmp_path / "in.jsonl")]
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(SystemExit) as ended:
            main(["live", *given, "--workers", "1", "--output", str(tmp_path / name)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert ended.value.code == 2
    assert f"error: {tmp_path / name}: File too large; check" in capsys.readouterr().err
