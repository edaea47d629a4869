"""OpenCV's FileStorage, YAML and XML, as plain values and arrays.

Not by cv2.FileStorage: it corrupts memory on files that are cut or faulty (OpenCV 5.0, found by mutating files).
"""

import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import bounded

_XML_DECLARATION = re.compile(r"<!(DOCTYPE|ENTITY)")
_YAML_VERSION = re.compile(r"\A%YAML[^\n]*\n")
_ARRAY_TAGS = ("opencv-matrix", "opencv-nd-matrix")
_AGAIN = "correct it there or write the file again"
_MOST_CHARACTERS = 2**23
"""A camera has a thousand."""
_MOST_DEPTH = 64
"""Nodes in nodes: libyaml's loader calls itself and crashes the interpreter on very deep ones."""
_MOST_DIGITS = 100
"""Of a number: YAML's base 60 takes the square of them."""


def parse_yaml(path: Path, text: str) -> Any:
    """The first document that is not empty, by a loader that makes plain values and OpenCV's matrices only."""
    # OpenCV's first line, %YAML:1.0, is no YAML.
    text = _YAML_VERSION.sub("\n", text)
    _refuse_long(path, text)
    try:
        _refuse_hostile(path, text)
        documents = [each for each in yaml.load_all(text, _Loader) if each is not None]
    except InputError:
        raise
    except (yaml.YAMLError, RecursionError, ValueError, TypeError, OverflowError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f"line {mark.line + 1} column {mark.column + 1}" if mark is not None else "the file"
        raise InputError(f"{path}: {line} is not YAML; {_AGAIN}") from None
    return bounded(documents[0], path) if documents else None


def _refuse_long(path: Path, text: str) -> None:
    if len(text) > _MOST_CHARACTERS:
        raise InputError(f"{path}: {len(text)} characters are too many for cameras; check that this is the file")


def _refuse_hostile(path: Path, text: str) -> None:
    """InputError where nodes are very deep, or named again: a few names can stand for more than fits memory."""
    depth = 0
    for event in yaml.parse(text, _Safe):
        line = f"{path}: line {event.start_mark.line + 1}"
        if isinstance(event, yaml.AliasEvent):
            raise InputError(f"{line} repeats a node by *name; write it out")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        if isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > _MOST_DEPTH:
            raise InputError(f"{line}: nodes are over {_MOST_DEPTH} deep; write the file again")


def parse_xml(path: Path, text: str) -> ET.Element:
    """The root of XML without a document type: entities could make it read other files, or grow without end."""
    if _XML_DECLARATION.search(text):
        raise InputError(f"{path}: XML with a document type or entities is not read; delete the <!DOCTYPE")
    _refuse_long(path, text)
    try:
        return _shallow(ET.fromstring(text), path)
    except ET.ParseError as error:
        line, column = error.position
        raise InputError(f"{path}: line {line} column {column + 1} is not XML; {_AGAIN}") from None
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as XML ({error}); write the file again") from None


def _shallow(root: ET.Element, path: Path) -> ET.Element:
    """`root`, if its elements are not absurdly deep."""
    level = [root]
    for _ in range(_MOST_DEPTH):
        level = [child for each in level for child in each]
        if len(level) == 0:
            return root
    raise InputError(f"{path}: elements are over {_MOST_DEPTH} deep; write the file again")


def load_storage(path: Path, text: str) -> dict[str, Any]:
    """Every node of a FileStorage by name: matrices as arrays, others as they are; InputError naming the line."""
    value = _of_xml(parse_xml(path, text)) if text.lstrip().startswith("<") else parse_yaml(path, text)
    if not isinstance(value, dict):
        raise InputError(f"{path}: OpenCV's FileStorage has named values, here is none; write the file again")
    return {str(key): each for key, each in value.items()}


_Safe: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Safe):
    """A safe loader that knows OpenCV's matrices."""


def _array_of_yaml(loader: Any, node: yaml.Node) -> Any:
    return _array(loader.construct_mapping(node, deep=True))


def _short_number(loader: Any, node: yaml.ScalarNode) -> Any:
    if len(node.value) > _MOST_DIGITS:
        raise yaml.constructor.ConstructorError(problem="a number is too long", problem_mark=node.start_mark)
    make = loader.construct_yaml_int if node.tag.endswith("int") else loader.construct_yaml_float
    return make(node)


def _unique_keys(loader: Any, node: yaml.MappingNode) -> Iterator[dict[Any, Any]]:
    keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
    twice = next((key for key, count in Counter(keys).items() if count > 1), None)
    if twice is not None:
        raise yaml.constructor.ConstructorError(problem="a key occurs twice", problem_mark=node.start_mark)
    yield from loader.construct_yaml_map(node)


for _tag in _ARRAY_TAGS:
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _array_of_yaml)
for _tag in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _short_number)
_Loader.add_constructor("tag:yaml.org,2002:map", _unique_keys)


def _of_xml(node: ET.Element) -> Any:
    """A node and all below it: a matrix, a map, a list, text or a number."""
    if node.get("type_id") in _ARRAY_TAGS:
        return _array({child.tag: _of_xml(child) for child in node})
    if len(node) > 0:
        if all(child.tag == "_" for child in node):
            return [_of_xml(child) for child in node]
        return {child.tag: _of_xml(child) for child in node}
    words = (node.text or "").split()
    if len(words) != 1 or words[0].startswith('"'):
        try:
            return [float(word) for word in words]
        except ValueError:
            return " ".join(words).strip('"')
    try:
        return float(words[0])
    except ValueError:
        return words[0]


def _array(node: dict[str, Any]) -> np.ndarray | None:
    """The matrix of a node; None where its numbers do not fill its shape."""
    data = node.get("data")
    sizes = node.get("sizes", [node.get("rows"), node.get("cols")])
    try:
        values = np.array(data if isinstance(data, list) else [data], dtype=np.float64)
        shape = [int(float(size)) for size in (sizes if isinstance(sizes, list) else [sizes])]
        # The numbers of several channels stand beside each other.
        return values.reshape(shape if values.size == np.prod(shape) else [*shape, -1])
    except (TypeError, ValueError, OverflowError):
        return None
