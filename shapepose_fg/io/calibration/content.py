"""What lies at a path, told by its first characters and parsed: JSON, TOML, XML, YAML, text, or a folder."""

import re
import tomllib
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import yaml

from shapepose_fg.errors import InputError
from shapepose_fg.files import read_json, read_text

Syntax = Literal["JSON", "TOML", "XML", "OpenCV", "YAML", "text", "folder", "pickle"]
"""How a file is written; "OpenCV" is cv2.FileStorage's YAML or XML."""

_TOML_LINE = re.compile(r"""\s*(\[\[?\s*[\w."' -]*[A-Za-z_."'][\w."' -]*\]\]?\s*(#.*)?$|[\w."'-]+\s*=)""")
_YAML_LINE = re.compile(r"\s*(- )?[\w/.\"' -]+:(\s|$)")
_XML_DECLARATION = re.compile(r"<!(DOCTYPE|ENTITY)")


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
        return _xml(path, text)
    if first.startswith("%YAML"):
        return _yaml_with_header(path, text)
    if _TOML_LINE.match(first):
        return Content(path, "TOML", _toml(path, text))
    if first.lstrip()[:1] in ("{", "["):
        return Content(path, "JSON", read_json(path))
    if _YAML_LINE.match(first) or first.strip() == "---":
        return Content(path, "YAML", _yaml(path, text))
    return Content(path, "text", text)


def load_opencv(path: Path, text: str) -> dict[str, Any]:
    """Every node of a cv2.FileStorage: matrices as arrays, numbers as floats. It runs no code."""
    # OpenCV also writes to stderr what it raises.
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        value = _node(storage.root())
    except (cv2.error, SystemError) as error:
        place = re.search(r"\((\d+)\):", str(error.__cause__ or error))
        line = f"line {place[1]} " if place is not None else "the file "
        raise InputError(f"{path}: {line}cannot be read by OpenCV's FileStorage; write the file again") from None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not isinstance(value, dict):
        raise InputError(f"{path}: OpenCV's FileStorage finds no named value in it; write the file again")
    return value


def _is_pickle(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(1) == b"\x80"


def _xml(path: Path, text: str) -> Content:
    """XML without a document type: entities could make it read other files, or grow without end."""
    if _XML_DECLARATION.search(text):
        raise InputError(
            f"{path}: XML with a document type or entities is not read; delete the <!DOCTYPE ...> part"
        )
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        line, column = error.position
        raise InputError(
            f"{path}: line {line} column {column + 1} is not XML; correct it there or write the file again"
        ) from None
    if root.tag == "opencv_storage":
        return Content(path, "OpenCV", load_opencv(path, text))
    return Content(path, "XML", root)


def _yaml_with_header(path: Path, text: str) -> Content:
    """OpenCV's YAML, which other parsers do not take, or any other YAML that names its version."""
    if text.startswith("%YAML:") or "!!opencv-" in text:
        return Content(path, "OpenCV", load_opencv(path, text))
    return Content(path, "YAML", _yaml(path, text))


def _yaml(path: Path, text: str) -> Any:
    """The first document that is not empty, by the loader that makes plain values only."""
    try:
        documents = [each for each in yaml.safe_load_all(text) if each is not None]
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f"line {mark.line + 1} column {mark.column + 1}" if mark is not None else "the file"
        raise InputError(f"{path}: {line} is not YAML; correct it there or write the file again") from None
    return documents[0] if documents else None


def _toml(path: Path, text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not TOML: {error}; correct it there or write the file again") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as TOML ({error}); write the file again") from None


def _node(node: cv2.FileNode) -> Any:
    """A node of a FileStorage and all below it."""
    if node.isMap():
        keys = node.keys()
        if {"dt", "data"} <= set(keys) and ({"rows", "cols"} <= set(keys) or "sizes" in keys):
            matrix = _matrix(node)
            if matrix is not None:
                return matrix
        return {key: _node(node.getNode(key)) for key in keys}
    if node.isSeq():
        return [_node(node.at(index)) for index in range(node.size())]
    if node.isString():
        return node.string()
    return node.real() if node.isInt() or node.isReal() else None


def _matrix(node: cv2.FileNode) -> np.ndarray | None:
    """The matrix of a node; None where it is empty, or a plain map that looks like one."""
    try:
        matrix = node.mat()
    except (cv2.error, SystemError):
        return None
    return None if matrix is None or matrix.size == 0 else np.asarray(matrix, dtype=np.float64)
