"""Measured numbers that ship with the package, in files that scripts of `scripts/` write."""

from functools import cache
from importlib.resources import as_file, files
from typing import Any

from shapepose_fg.core.storage.files import read_json


@cache
def shipped_numbers(package: str, name: str) -> dict[str, Any]:
    """Content of `data/NAME.json` of a package of `shapepose_fg`; its entry `about` says which
    script wrote it, and from which recordings.
    """
    with as_file(files("shapepose_fg") / package / "data" / f"{name}.json") as path:
        return read_json(path)
