"""What lies at a path, told by its first characters and parsed: JSON, TOML, XML, YAML, text, or a folder."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from shapepose_fg.core.storage.files import MIDDLE, parse_toml, read_bytes, read_json, read_text
from shapepose_fg.io.calibration.filestorage import load_storage, parse_xml, parse_yaml

Syntax = Literal["JSON", "TOML", "XML", "OpenCV", "YAML", "text", "folder", "pickle"]
"""How a file is written; "OpenCV" is the YAML or XML of its FileStorage."""

_TOML_LINE = re.compile(r"""\s*(\[\[?\s*[\w."' -]*[A-Za-z_."'][\w."' -]*\]\]?\s*(#.*)?$|[\w."'-]+\s*=)""")
_MOST_OF_A_LINE = 1000
"""Characters that tell how a file is written; these patterns take the square of a line's length."""
_YAML_LINE = re.compile(r"\s*(- )?[\w/.\"' -]+:(\s|$)")


@dataclass(frozen=True)
class Content:
    """What was found at a path."""

    path: Path
    """The file or folder that the user named."""
    syntax: Syntax
    """How it is written."""
    value: Any
    """What it holds: an object, table, XML element, text; of a folder, its sorted paths."""


def load(path: Path) -> Content:
    """Find out how the file at `path` is written, and parse it; InputError naming the line that is wrong."""
    if path.is_dir():
        return Content(path, "folder", sorted(each for each in path.iterdir() if not each.name.startswith(".")))
    if read_bytes(path, MIDDLE)[:1] == b"\x80":
        return Content(path, "pickle", None)
    text = read_text(path, most=MIDDLE)
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    first = lines[0][:_MOST_OF_A_LINE] if lines else ""
    if first.lstrip().startswith("<"):
        root = parse_xml(path, text)
        storage = root.tag == "opencv_storage"
        return Content(path, "OpenCV", load_storage(path, text)) if storage else Content(path, "XML", root)
    if first.startswith("%YAML:") or "!!opencv-" in text:
        return Content(path, "OpenCV", load_storage(path, text))
    if _TOML_LINE.match(first):
        return Content(path, "TOML", parse_toml(path, text))
    if first.lstrip()[:1] in ("{", "["):
        return Content(path, "JSON", read_json(path, most=MIDDLE))
    if _YAML_LINE.match(first) or first.startswith(("%YAML", "---")):
        return Content(path, "YAML", parse_yaml(path, text))
    return Content(path, "text", text)
