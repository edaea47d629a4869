"""MCAP files made to do harm: definitions that lack fields, and chunks that are not as large as
they say.
"""

import struct
import tracemalloc

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.ros.definitions import check_definition, definition
from shapepose_fg.io.ros.mcap_files import read_views
from shapepose_fg.io.trajectories import read_trajectory

pytest.importorskip("mcap_ros2", reason='needs pip install "shapepose-fg[ros]"')
from mcap.writer import CompressionType, Writer

KINDS = (
    "geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped", "nav_msgs/Odometry",
    "tf2_msgs/TFMessage", "shapepose_msgs/Detections",
)  # fmt: skip
LINES = [
    (kind, line)
    for kind in KINDS
    for line in sorted({*definition(kind).splitlines()})
    if line[:1].islower()
]


def write(path, kind: str, text: str, data: bytes, count: int = 2):
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start("ros2", "x")
        schema = writer.register_schema(kind.replace("/", "/msg/"), "ros2msg", text.encode())
        channel = writer.register_channel("/p", "cdr", schema)
        for n in range(count):
            writer.add_message(channel, n, data, n)
        writer.finish()
    return path


def said_of(path, rig) -> str:
    """What both readers say of a file that they refuse."""
    with pytest.raises(InputError) as caught:
        list(read_views(path, rig, BODY_25, print))
    with pytest.raises(InputError):
        read_trajectory(path)
    return str(caught.value)


@pytest.mark.parametrize(
    ("kind", "line"), LINES, ids=[f"{kind}-{line}".replace("/", ".") for kind, line in LINES]
)
def test_a_definition_that_lacks_a_field_is_named(tmp_path, five_cameras, kind, line):
    """Each field of each message that is read, left out, called otherwise, or of another type."""
    check_definition(kind, definition(kind))
    word, name = line.split()
    data = b"\0\1\0\0" + bytes(600)
    other = "uint8" if word != "uint8" and not word.startswith(("int", "uint")) else "float64"
    for text in (
        "",
        f"{word} {name}_other",
        f"{other} {name}",
        f"{word}[3] {name}",
        f"{word}[] {name}",
    ):
        if f"{word}[] {name}" == line:
            continue
        lacks = definition(kind).replace(f"\n{line}\n", f"\n{text}\n")
        lacks = text + lacks[len(line) :] if lacks.startswith(f"{line}\n") else lacks
        with pytest.raises(ValueError, match=rf"has no {name} of|has no field"):
            check_definition(kind, lacks)
        said = said_of(write(tmp_path / "a.mcap", kind, lacks, data), five_cameras)
        assert "a.mcap: cannot be read" in said and ("has no" in said)


def test_definitions_may_have_more_and_be_written_otherwise():
    text = definition("geometry_msgs/PoseStamped")
    check_definition(
        "geometry_msgs/PoseStamped", text.replace("std_msgs/Header header", "Header header  # when")
    )
    check_definition("geometry_msgs/PoseStamped", text.replace("float64 x\n", "float64 x 0.5\n"))
    check_definition(
        "geometry_msgs/PoseStamped", f"uint8 A=1\nstring NAME='a # b'\n# int8 b\n\n{text}"
    )
    check_definition(
        "geometry_msgs/PoseStamped", text.replace("MSG: geometry_msgs/", "MSG: geometry_msgs/msg/")
    )
    check_definition(
        "geometry_msgs/PoseStamped", text.replace("\n", "\r\n") + "string<=5[<=10] more\n"
    )
    apart = text.index("=" * 80 + "\nMSG: builtin_interfaces/Time")
    rest = text[apart:].partition("\n" + "=" * 80)[2]
    check_definition(
        "geometry_msgs/PoseStamped", text[:apart] + "=" * 80 + rest
    )  # the library knows Time


@pytest.mark.parametrize("length", [4_000_000_000, 100_000])
def test_arrays_of_nothing_are_refused(tmp_path, five_cameras, length):
    text = definition("geometry_msgs/PoseStamped")
    nothing = "=" * 80 + "\nMSG: geometry_msgs/Nothing\n"
    head = b"\0\1\0\0" + struct.pack("<iII", 1, 0, 2) + b"a\0\0\0"
    for array in ("[]", f"[{length}]"):
        lied = text.replace(
            "geometry_msgs/Pose pose\n",
            f"geometry_msgs/Nothing{array} a\ngeometry_msgs/Pose pose\n",
            1,
        )
        data = (
            head
            + (struct.pack("<I", length) if array == "[]" else b"")
            + struct.pack("<7d", *[0] * 6, 1)
        )
        said = said_of(
            write(tmp_path / "a.mcap", "geometry_msgs/PoseStamped", lied + nothing, data),
            five_cameras,
        )
        assert "an array of" in said or "has no field" in said


def record(code: int, body: bytes) -> bytes:
    return bytes([code]) + struct.pack("<Q", len(body)) + body


def chunk(how: str, data: bytes, size: int) -> bytes:
    name = how.encode()
    return record(
        6,
        struct.pack("<QQQII", 0, 0, size, 0, len(name))
        + name
        + struct.pack("<Q", len(data))
        + data,
    )


@pytest.mark.parametrize("how", ["lz4", "zstd"])
def test_chunks_that_do_not_say_their_size_are_not_unpacked_whole(tmp_path, five_cameras, how):
    import lz4.frame
    import zstandard

    zeros = bytes(2**22)
    packing = (
        lz4.frame.LZ4FrameCompressor() if how == "lz4" else zstandard.ZstdCompressor().compressobj()
    )
    begin = packing.begin() if how == "lz4" else b""
    data = begin + b"".join(packing.compress(zeros) for _ in range(80)) + packing.flush()  # 320 MiB
    head = record(1, struct.pack("<I", 4) + b"ros2" + struct.pack("<I", 1) + b"x")
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + head + chunk(how, data, 1000))
    tracemalloc.start()
    said = said_of(tmp_path / "a.mcap", five_cameras)
    assert "over 67108864 bytes" in said
    assert tracemalloc.get_traced_memory()[1] < 2**28
    tracemalloc.stop()


@pytest.mark.parametrize(
    "records",
    [
        record(5, b"") * 2**20,
        record(5, b"\0" * 5),
        b"\5" + b"\xff" * 8,
        b"\5\0",
        record(5, b"\xff" * 22),
        record(3, b"\0\0\xff\xff\xff\xff"),
    ],
)
def test_records_are_as_long_as_they_say(tmp_path, five_cameras, records):
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + chunk("", records, len(records)))
    assert "cannot be read" in said_of(tmp_path / "a.mcap", five_cameras)


def test_the_files_that_attacked(shared_data, five_cameras):
    for case in sorted((shared_data.parent / "cases" / "hostile" / "mcap").glob("*.mcap")):
        assert "cannot be read" in said_of(case, five_cameras)


def test_covariances_that_say_that_nothing_is_known():
    from shapepose_fg.io.ros.poses import _covariance

    unknown = np.diag([0.1, 0.1, 1e6, 1.7e308, 1.7e308, 0.1]).ravel()
    assert np.isfinite(_covariance(unknown, np.array([0, 0, 0, 0, 0, 0, 1.0]), "here")).all()
