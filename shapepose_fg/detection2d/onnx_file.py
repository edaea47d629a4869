"""An ONNX file from outside, read within bounds and looked through before any library sees it."""

import os
import re
from pathlib import Path

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import open_regular

MOST_BYTES = 2**29
"""Networks of people's joints have 2 to 400 MB."""
_ELSEWHERE = re.compile(rb"(?:\x0a|\x8a\x80*\0)(?:\x08|\x88\x80*\0)location")
"""How protobuf writes the key under which a tensor says which file its numbers are in: field 1, 8 bytes; both
numbers may be spelt with zeros behind."""


def read_onnx(file: Path) -> bytes:
    """The bytes of a network's file.

    InputError where it is missing, larger than any such network, or where its weights lie in other files: their
    paths would be looked up wherever this program happens to run, and may lead anywhere.
    """
    with open_regular(file, "give the ONNX file of a network") as stream:
        size = os.fstat(stream.fileno()).st_size
        content = b"" if size > MOST_BYTES else stream.read(MOST_BYTES + 1)
    if max(size, len(content)) > MOST_BYTES:
        raise InputError(
            f"{file}: over {MOST_BYTES >> 20} MiB are too much for a network of this kind; check that it is one"
        )
    if b"location" in content and _ELSEWHERE.search(content):
        raise InputError(
            f"{file}: its weights lie in another file; give a network that holds them itself, as"
            " onnx.save_model(onnx.load(FILE), NEW) writes it"
        )
    return content
