"""Reads an ONNX file that contains all of its weights.

ONNX runtimes open external files that a tensor names, relative to the working directory. Every
tensor of the file is therefore checked, by the wire format of protobuf and the messages of
onnx.proto, before the bytes are passed to a library.
"""

from pathlib import Path

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import read_bytes

MOST_BYTES = 2**29
"""Largest file, bytes; networks of people's joints have 2 to 400 MB."""
_MOST_DEPTH = 100
"""Maximum depth of nested messages; protobuf's own limit."""
_MOST_FIELDS = 2**20
"""Maximum number of fields of the visited messages; networks have ten thousand to a hundred
thousand."""
_FIXED_BYTES = {1: 8, 5: 4}
"""Lengths, bytes, of protobuf's wire types with a fixed length."""

_MESSAGES: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse tensor"},
    "node": {5: "attribute"},
    "attribute": {
        5: "tensor",
        6: "graph",
        10: "tensor",
        11: "graph",
        22: "sparse tensor",
        23: "sparse tensor",
    },
    "sparse tensor": {1: "tensor", 2: "tensor"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "tensor": {},
}
"""The messages of onnx.proto that lead to tensors, with the fields that hold messages."""


class _Broken(Exception):
    """The bytes are not a valid protobuf message."""


def read_onnx(file: Path) -> bytes:
    """Content of the ONNX file at `file`, at most `MOST_BYTES`, in which no tensor names another
    file.

    InputError if the file cannot be read, is no ONNX network, or has weights in other files.
    Encodings that two parsers may read differently (tags of more bytes than needed, groups) are
    refused: no program writes them.
    """
    content = read_bytes(file, MOST_BYTES)
    try:
        whole = _is_whole(memoryview(content))
    except _Broken as error:
        raise InputError(
            f"{file}: cannot be read as an ONNX network ({error}); give the ONNX file of a network"
        ) from None
    if not whole:
        raise InputError(
            f"{file}: its weights are in another file; give a network that contains them, as "
            "written by onnx.save_model(onnx.load(FILE), NEW)"
        )
    return content


def _is_whole(content: memoryview) -> bool:
    """Whether no tensor of a ModelProto has external data."""
    waiting, fields = [("model", 0, len(content), 0)], 0
    while len(waiting) > 0:
        message, at, end, depth = waiting.pop()
        if depth > _MOST_DEPTH:
            raise _Broken(f"its graphs are over {_MOST_DEPTH} messages deep")
        inner = _MESSAGES[message]
        while at < end:
            fields += 1
            if fields > _MOST_FIELDS:
                raise _Broken(f"it has over {_MOST_FIELDS} fields")
            start, (tag, at) = at, _varint(content, at, end)
            field, kind = tag >> 3, tag & 7
            if field == 0 or tag >= 2**32 or at - start > max(1, -(-tag.bit_length() // 7)):
                raise _Broken(f"there is no field at byte {start}")
            value = 1
            if kind == 0:
                value, at = _varint(content, at, end)
            elif kind == 2:
                length, at = _varint(content, at, end)
                # Size of a field, bytes, exclusive; protobuf's own limit.
                if length >= 2**31:
                    raise _Broken(f"the field at byte {start} ends beyond its message")
                if field in inner:
                    waiting.append((inner[field], at, at + length, depth + 1))
                at += length
            elif kind in _FIXED_BYTES:
                at += _FIXED_BYTES[kind]
            else:
                raise _Broken(f"byte {start} begins a group")
            if at > end:
                raise _Broken(f"the field at byte {start} ends beyond its message")
            # Fields of a tensor: the place of external data, and whether there is any.
            if message == "tensor" and (field == 13 or (field == 14 and value != 0)):
                return False
    return True


def _varint(content: memoryview, at: int, end: int) -> tuple[int, int]:
    """An integer at byte `at`, and the position after it."""
    value = shift = 0
    while at < end and shift < 70:
        byte = content[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
    raise _Broken(f"there is no whole number at byte {at}")
