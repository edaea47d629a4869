"""Networks that name other files are refused, in every spelling and place of the format."""

import os
import time

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.detection2d.onnx_file import read_onnx
from shapepose_fg.detection2d.onnx_network import OnnxNetwork
from tests.detection2d.conftest import blob, node, onnx_file, onnx_model, varint

WEIGHTS = np.ones((3, 3, 8, 8), dtype=np.float32)


def long(content: bytes, field: int, *extra: int) -> bytes:
    """A field whose tag has more bytes than it needs."""
    tag = field << 3 | 2
    return bytes([tag & 127 | 128, tag >> 7 | 128, *extra]) + content


def entry(name: bytes = b"location", value: bytes = b"secret") -> bytes:
    return blob(1, name) + blob(2, value)


NUMBERS = varint(1, 3) + varint(2, 1) + blob(8, b"w")
"""A tensor's shape, type and name."""
ELSEWHERE = {
    "as onnx writes it": blob(13, entry()) + varint(14, 1),
    "the location's key behind its value": blob(13,
                                                blob(2, b"secret") + blob(1,
                                                                          b"location")) + varint(14,
                                                                                                 1),
    "without a place": varint(14, 1),
    "without saying so": blob(13, entry()),
    "another key": blob(13, entry(b"offset", b"0")),
    "a number that 32 bits make 1": bytes([14 << 3, *[0x81, 0x80, 0x80, 0x80, 0x10]]),
    "first elsewhere, then here": varint(14, 1) + varint(14, 0),
    "a key in more bytes": blob(13,
                                b"\x8a\x80\x80\x80\x10" + blob(1, b"location")[1:] + blob(2,
                                                                                          b"secret")),
    "a length in more bytes": bytes([13 << 3 | 2, 0x80 | len(entry()), 0x80,
                                     0x00]) + entry() + varint(14, 1),
}  # fmt: skip
PLACES = {
    "an initializer": lambda tensor: blob(7, blob(5, tensor)),
    "a sparse one's values": lambda tensor: blob(7, blob(15, blob(1, tensor))),
    "a sparse one's indices": lambda tensor: blob(7, blob(15, blob(2, tensor))),
    "an attribute": lambda tensor: blob(7, blob(1, blob(5, blob(5, tensor)))),
    "an attribute's list": lambda tensor: blob(7, blob(1, blob(5, blob(10, tensor)))),
    "an attribute's sparse": lambda tensor: blob(7, blob(1, blob(5, blob(22, blob(1, tensor))))),
    "its sparse list": lambda tensor: blob(7, blob(1, blob(5, blob(23, blob(2, tensor))))),
    "a graph within": lambda tensor: blob(7, blob(1, blob(5, blob(6, blob(5, tensor))))),
    "graphs within": lambda tensor: blob(7, blob(1, blob(5, blob(11, blob(5, tensor))))),
    "a function": lambda tensor: blob(25, blob(7, blob(5, blob(5, tensor)))),
    "a function's default": lambda tensor: blob(25, blob(11, blob(5, tensor))),
    "training": lambda tensor: blob(20, blob(1, blob(5, tensor))),
    "a training step": lambda tensor: blob(20, blob(2, blob(5, tensor))),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("spelling", ELSEWHERE)
def test_weights_elsewhere_are_refused(tmp_path, spelling, place):
    file = onnx_file(tmp_path / "n.onnx", WEIGHTS)
    file.write_bytes(file.read_bytes() + PLACES[place](NUMBERS + ELSEWHERE[spelling]))
    with pytest.raises(
        InputError, match="its weights are in another file; give a network that contains them"
    ):
        OnnxNetwork.open(file, "opencv")
    file.write_bytes(
        PLACES[place](ELSEWHERE[spelling] + NUMBERS) + onnx_file(file, WEIGHTS).read_bytes()
    )
    with pytest.raises(InputError, match="its weights are in another file"):
        OnnxNetwork.open(file, "opencv")


@pytest.mark.parametrize(
    "content",
    [
        b"\xba\x80\x80\x80\x10"
        + blob(7, blob(5, NUMBERS + varint(14, 1)))[1:],  # bits that 32 bits do not have
        b"\xba\x00" + blob(7, blob(5, NUMBERS + varint(14, 1)))[1:],  # zeros behind
        blob(7, b"\xaa\x80\x00" + blob(5, NUMBERS + varint(14, 1))[1:]),
        b"\x3b" + blob(5, NUMBERS + varint(14, 1)) + b"\x3c",  # a group
        b"\x3c",
        b"\x00",
        b"\x06\x00",
        b"\x3a\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01",
        b"\x3a\x80\x80\x80\x80\x80\x80\x80\x80\x80\x80\x80\x01",
        b"\x08" + b"\x80" * 11,
        b"\x3a\x05ab",
        b"\x0d\x00",
    ],
)
def test_spellings_that_no_program_writes_are_refused(tmp_path, content):
    file = onnx_file(tmp_path / "n.onnx", WEIGHTS)
    for changed in (content, file.read_bytes() + content):
        file.write_bytes(changed)
        with pytest.raises(InputError, match="cannot be read as an ONNX network"):
            OnnxNetwork.open(file, "opencv")


@pytest.mark.slow
@pytest.mark.parametrize(
    "content",
    [
        blob(7, blob(5, b"\x25" + bytes(4)) * 2**20),
        blob(7, (b"\x0a\x00") * 2**22),
        b"\x08\x01" * 2**22,
    ],
    ids=["numbers one by one", "empty nodes", "versions"],
)
def test_many_small_parts_take_no_long_time(tmp_path, content):
    (tmp_path / "n.onnx").write_bytes(content)
    start = time.process_time()
    with pytest.raises(InputError, match="cannot be read as an ONNX network"):
        read_onnx(tmp_path / "n.onnx")
    assert time.process_time() - start < 20


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a system with pipes in folders")
def test_files_that_attacked(tmp_path, shared_data):
    for case in sorted((shared_data.parent / "cases" / "hostile" / "onnx").glob("*.onnx")):
        with pytest.raises(InputError, match="its weights are in another file"):
            OnnxNetwork.open(case, "opencv")
    os.mkfifo(tmp_path / "n.onnx")
    with pytest.raises(InputError, match="a pipe"):
        OnnxNetwork.open(tmp_path / "n.onnx", "opencv")


def test_a_file_that_looks_like_onnxruntime_s_own_format_is_read_as_onnx(tmp_path):
    pytest.importorskip("onnxruntime", reason="onnxruntime is an extra: shapepose-fg[detect]")
    file = onnx_file(tmp_path / "n.onnx", WEIGHTS)
    file.write_bytes(blob(2, b"abORTM") + file.read_bytes())
    assert file.read_bytes()[4:8] == b"ORTM"
    given = np.ones((1, 3, 8, 8), dtype=np.float32)
    assert OnnxNetwork.open(file).run(given)[0].ravel().tolist() == [192.0] * 3


@pytest.mark.slow
def test_weights_within_are_read_in_every_spelling(tmp_path):
    """Numbers as bytes, packed, and one by one; a length in more bytes than needed; a place that
    says: here.
    """
    halves = np.full(3, 0.5, dtype="<f4")
    packed, single = (
        blob(4, halves.tobytes()),
        b"".join(b"\x25" + each.tobytes() for each in halves),
    )
    for numbers in (blob(9, halves.tobytes()), packed, single, packed + varint(14, 0)):
        add = node("Add", "x w", "y")
        file = onnx_model(tmp_path / "n.onnx", [add], {}, (1, 3, 1, 1), {"y": (1, 3, 1, 1)})
        tensor = (
            b"".join(varint(1, n) for n in (1, 3, 1, 1)) + varint(2, 1) + blob(8, b"w") + numbers
        )
        file.write_bytes(file.read_bytes() + blob(7, blob(5, tensor)))
        given = np.ones((1, 3, 1, 1), dtype=np.float32)
        np.testing.assert_allclose(OnnxNetwork.open(file, "opencv").run(given)[0].ravel(), 1.5)
    content = blob(2, b"abc")
    file.write_bytes(content[:1] + b"\x83\x80\x00" + content[2:] + file.read_bytes())
    assert len(read_onnx(file)) == file.stat().st_size
