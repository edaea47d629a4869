"""An ONNX file from outside, read within bounds and looked through before any library sees it."""

import os
from collections.abc import Iterator
from pathlib import Path

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import open_regular

MOST_BYTES = 2**29
"""Networks of OpenPose's kind have 2 to 200 MB."""
_MOST_FIELDS = 2_000_000
"""Entries of the messages that are looked through: large networks have some ten thousand."""
_MOST_DEPTH = 32
"""Graphs in graphs, each of which is three messages deep."""

# Which fields of which message hold which message, by their numbers in onnx.proto. Other fields are passed over.
_INSIDE = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse tensor"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse tensor", 23: "sparse tensor"},
    "sparse tensor": {1: "tensor", 2: "tensor"},
    "tensor": {13: "external data"},
    "external data": {},
}


def read_onnx(file: Path) -> bytes:
    """The bytes of a network's file.

    InputError where it is missing, larger than any such network, no ONNX, or where its weights lie in other files:
    their paths would be looked up wherever this program happens to run, and may lead anywhere.
    """
    with open_regular(file, "give the ONNX file of a network") as stream:
        size = os.fstat(stream.fileno()).st_size
        content = b"" if size > MOST_BYTES else stream.read(MOST_BYTES + 1)
    if max(size, len(content)) > MOST_BYTES:
        raise InputError(
            f"{file}: over {MOST_BYTES >> 20} MiB are too much for a network of this kind; check that it is one"
        )
    try:
        other = next(_external(memoryview(content)), None)
    except (ValueError, IndexError):
        raise InputError(f"{file}: not an ONNX network; give the ONNX file of a network") from None
    if other is not None:
        raise InputError(
            f"{file}: its weights lie in another file ({other!r}); give a network that holds them itself, as"
            " onnx.save_model(onnx.load(FILE), NEW) writes it"
        )
    return content


def _external(content: memoryview) -> Iterator[str]:
    """Where tensors of a model say that their numbers are.

    ValueError, or IndexError at an end that comes too early, where it is no model.
    """
    waiting, looked_at = [("model", content, 0)], 0
    while waiting:
        kind, message, depth = waiting.pop()
        if kind == "external data":
            yield _location(message)
            continue
        if depth > 3 * _MOST_DEPTH:
            raise ValueError("graphs in graphs in graphs")
        for number, value in _fields(message):
            looked_at += 1
            if looked_at > _MOST_FIELDS:
                raise ValueError("more entries than a network has")
            if isinstance(value, memoryview) and number in _INSIDE[kind]:
                waiting.append((_INSIDE[kind][number], value, depth + 1))


def _location(entry: memoryview) -> str:
    """The value of an entry of a key and a value, short."""
    values = [bytes(value[:100]) for number, value in _fields(entry) if number == 2 and not isinstance(value, int)]
    return values[0].decode(errors="replace") if len(values) > 0 else ""


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Number and value of each field of a message in protobuf's encoding: a number, or bytes."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        number, kind = key >> 3, key & 7
        if kind == 0:
            value, at = _varint(message, at)
            yield number, value
            continue
        if kind not in (1, 2, 5) or number == 0:
            raise ValueError("no field begins so")
        size, at = _varint(message, at) if kind == 2 else (8 if kind == 1 else 4, at)
        if at + size > len(message):
            raise ValueError("a field is longer than its message")
        yield number, message[at : at + size]
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """A whole number of up to 64 bits, seven to a byte, and where the next field begins."""
    value = 0
    for shift in range(0, 70, 7):
        byte = message[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    raise ValueError("a number has over 64 bits")
