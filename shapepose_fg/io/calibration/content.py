"""What lies at a path, told by its first characters and parsed: JSON, TOML, XML, YAML, text, or a folder."""

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from shapepose_fg.errors import InputError
from shapepose_fg.files import read_json, read_text
from shapepose_fg.io.calibration.filestorage import load_storage, parse_xml, parse_yaml

Syntax = Literal["JSON", "TOML", "XML", "OpenCV", "YAML", "text", "folder", "pickle"]
"""How a file is written; "OpenCV" is the YAML or XML of its FileStorage."""

_TOML_LINE = re.compile(r"""\s*(\[\[?\s*[\w."' -]*[A-Za-z_."'][\w."' -]*\]\]?\s*(#.*)?$|[\w."'-]+\s*=)""")
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
    if path.is_file() and _is_pickle(path):
        return Content(path, "pickle", None)
    text = read_text(path)
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    first = lines[0] if lines else ""
    if first.lstrip().startswith("<"):
        root = parse_xml(path, text)
        storage = root.tag == "opencv_storage"
        return Content(path, "OpenCV", load_storage(path, text)) if storage else Content(path, "XML", root)
    if first.startswith("%YAML:") or "!!opencv-" in text:
        return Content(path, "OpenCV", load_storage(path, text))
    if _TOML_LINE.match(first):
        return Content(path, "TOML", _toml(path, text))
    if first.lstrip()[:1] in ("{", "["):
        return Content(path, "JSON", read_json(path))
    if _YAML_LINE.match(first) or first.startswith(("%YAML", "---")):
        return Content(path, "YAML", parse_yaml(path, text))
    return Content(path, "text", text)


def _is_pickle(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(1) == b"\x80"


def _toml(path: Path, text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not TOML: {error}; correct it there or write the file again") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as TOML ({error}); write the file again") from None
