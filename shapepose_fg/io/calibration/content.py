"""Recognises the syntax of a file by its first characters, and parses it: JSON, TOML, XML, YAML,
text, or a folder.

YAML and XML of OpenCV's FileStorage are converted to plain values and arrays. cv2.FileStorage is
not used, because damaged files can corrupt its memory (OpenCV 5.0, found by fuzzing).
"""

import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import (
    MIDDLE,
    MOST_DEPTH,
    bounded,
    parse_toml,
    read_bytes,
    read_json,
    read_text,
)

Syntax = Literal["JSON", "TOML", "XML", "OpenCV", "YAML", "text", "folder", "pickle"]
"""Syntax of a file; "OpenCV" is the YAML or XML of its FileStorage."""

_TOML_LINE = re.compile(
    r"""\s*(\[\[?\s*[\w."' -]*[A-Za-z_."'][\w."' -]*\]\]?\s*(#.*)?$|[\w."'-]+\s*=)"""
)
_YAML_LINE = re.compile(r"\s*(- )?[\w/.\"' -]+:(\s|$)")
_XML_DECLARATION = re.compile(r"<!(DOCTYPE|ENTITY)")
_YAML_VERSION = re.compile(r"\A%YAML[^\n]*\n")
_ARRAY_TAGS = ("opencv-matrix", "opencv-nd-matrix")


@dataclass(frozen=True)
class Content:
    """Parsed content of a file or folder."""

    path: Path
    """The file or folder that the user named."""
    syntax: Syntax
    """Syntax of the content."""
    value: Any
    """The parsed value: object, table, XML element, or text; for a folder, its sorted paths."""


def load(path: Path) -> Content:
    """Recognise the syntax of the file at `path`, and parse it; InputError naming the line that is
    wrong.
    """
    if path.is_dir():
        return Content(
            path, "folder", sorted(each for each in path.iterdir() if not each.name.startswith("."))
        )
    if read_bytes(path, MIDDLE)[:1] == b"\x80":
        return Content(path, "pickle", None)
    text = read_text(path, most=MIDDLE)
    lines = [
        line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")
    ]
    # Number of characters that are used to recognise the syntax; the time of the patterns
    # is quadratic in it.
    first = lines[0][:1000] if lines else ""
    if first.lstrip().startswith("<"):
        root = _parse_xml(path, text)
        storage = root.tag == "opencv_storage"
        return (
            Content(path, "OpenCV", _named(path, _of_xml(root)))
            if storage
            else Content(path, "XML", root)
        )
    if first.startswith("%YAML:") or "!!opencv-" in text:
        return Content(path, "OpenCV", _named(path, _parse_yaml(path, text)))
    if _TOML_LINE.match(first):
        return Content(path, "TOML", parse_toml(path, text))
    if first.lstrip()[:1] in ("{", "["):
        return Content(path, "JSON", read_json(path, most=MIDDLE))
    if _YAML_LINE.match(first) or first.startswith(("%YAML", "---")):
        return Content(path, "YAML", _parse_yaml(path, text))
    return Content(path, "text", text)


def _named(path: Path, value: Any) -> dict[str, Any]:
    """All nodes of a FileStorage, by name."""
    if not isinstance(value, dict):
        raise InputError(
            f"{path}: this OpenCV FileStorage has no named values; write the file again"
        )
    return {str(key): each for key, each in value.items()}


def _parse_yaml(path: Path, text: str) -> Any:
    """The first non-empty document, read by a loader that makes only plain values and OpenCV's
    matrices.
    """
    text = _YAML_VERSION.sub("\n", text)  # OpenCV's first line %YAML:1.0 is invalid YAML
    _refuse_long(path, text)
    try:
        _refuse_hostile(path, text)
        documents = [each for each in yaml.load_all(text, _Loader) if each is not None]
    except InputError:
        raise
    except (yaml.YAMLError, RecursionError, ValueError, TypeError, OverflowError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f"line {mark.line + 1} column {mark.column + 1}" if mark is not None else "the file"
        raise InputError(
            f"{path}: {line} is not YAML; correct it or write the file again"
        ) from None
    return bounded(documents[0], path) if documents else None


def _refuse_long(path: Path, text: str) -> None:
    # Maximum number of characters of a calibration file; a camera takes about a thousand.
    if len(text) > 2**23:
        raise InputError(
            f"{path}: the file has {len(text)} characters, too many for a calibration; check the "
            "path"
        )


def _refuse_hostile(path: Path, text: str) -> None:
    """Raise InputError for deeply nested nodes, and for aliases: a few of them can expand to more
    than fits into memory.
    """
    depth = 0
    for event in yaml.parse(text, _Safe):
        line = f"{path}: line {event.start_mark.line + 1}"
        if isinstance(event, yaml.AliasEvent):
            raise InputError(f"{line} refers to a node by *name; write it out")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(
            event, yaml.CollectionEndEvent
        )
        if depth > MOST_DEPTH:
            raise InputError(f"{line}: nodes are over {MOST_DEPTH} deep; write the file again")


def _parse_xml(path: Path, text: str) -> ET.Element:
    """The root of an XML text without a document type: its entities could include other files, or
    expand without limit.
    """
    if _XML_DECLARATION.search(text):
        raise InputError(
            f"{path}: XML with a document type or entities is not accepted; delete the <!DOCTYPE"
        )
    _refuse_long(path, text)
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        line, column = error.position
        cure = "correct it or write the file again"
        raise InputError(f"{path}: line {line} column {column + 1} is not XML; {cure}") from None
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as XML ({error}); write the file again") from None
    level = [root]
    for _ in range(MOST_DEPTH):
        level = [child for each in level for child in each]
    if len(level) > 0:
        raise InputError(f"{path}: elements are over {MOST_DEPTH} deep; write the file again")
    return root


_Safe: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Safe):
    """A safe YAML loader that also reads OpenCV's matrices, and numbers as Python prints them
    (1e-05).
    """


def _array_of_yaml(loader: Any, node: yaml.Node) -> Any:
    return _array(loader.construct_mapping(node, deep=True))


def _short_number(loader: Any, node: yaml.ScalarNode) -> Any:
    # Maximum number of digits of a number: the time to parse YAML's base-60 numbers is
    # quadratic in it.
    if len(node.value) > 100:
        raise yaml.constructor.ConstructorError(
            problem="a number is too long", problem_mark=node.start_mark
        )
    make = loader.construct_yaml_int if node.tag.endswith("int") else loader.construct_yaml_float
    return make(node)


def _unique_keys(loader: Any, node: yaml.MappingNode) -> Iterator[dict[Any, Any]]:
    keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
    if max(Counter(keys).values(), default=0) > 1:
        raise yaml.constructor.ConstructorError(
            problem="a key occurs twice", problem_mark=node.start_mark
        )
    yield from loader.construct_yaml_map(node)


for _tag in _ARRAY_TAGS:
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _array_of_yaml)
for _tag in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _short_number)
_Loader.add_constructor("tag:yaml.org,2002:map", _unique_keys)
_PRINTED = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _PRINTED, list("-+0123456789"))


def _of_xml(node: ET.Element) -> Any:
    """Convert an XML node with its children: to a matrix, a map, a list, text or a number."""
    if node.get("type_id") in _ARRAY_TAGS:
        return _array({child.tag: _of_xml(child) for child in node})
    if len(node) > 0:
        if all(child.tag == "_" for child in node):
            return [_of_xml(child) for child in node]
        return {child.tag: _of_xml(child) for child in node}
    words = (node.text or "").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return " ".join(words).strip('"')
    return numbers[0] if len(numbers) == 1 else numbers


def _array(node: dict[str, Any]) -> np.ndarray:
    """The matrix of a node; NaN, which later checks refuse, if the number of values does not match
    its shape.
    """
    data = node.get("data")
    sizes = node.get("sizes", [node.get("rows"), node.get("cols")])
    try:
        values = np.array(data if isinstance(data, list) else [data], dtype=np.float64)
        shape = [int(float(size)) for size in (sizes if isinstance(sizes, list) else [sizes])]
        # Values of several channels are interleaved.
        return values.reshape(shape if values.size == np.prod(shape) else [*shape, -1])
    except (TypeError, ValueError, OverflowError):
        return np.full(1, np.nan)
