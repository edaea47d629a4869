"""recordings.toml: reads the recordings of an archive, and the options of each."""

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from shapepose_fg.cli.reconstruct.request import Request
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.joint_names import layouts_called
from shapepose_fg.core.run_summary import plain
from shapepose_fg.core.storage.files import is_inside, read_toml
from shapepose_fg.core.validation import describe
from shapepose_fg.io.config import config_from

LOG = "log.txt"
"""Name of the log in a recording's folder."""
_NAME = re.compile(r"\w[\w.-]{0,99}")
_MOST = 10_000
"""Maximum number of recordings in a table."""
_PATHS = ("calibration", "detections", "project", "config", "body", "timestamps", "shapes")
_CURE = "docs/batch.md describes the table"


@dataclass(frozen=True)
class Entry:
    """One recording of the table."""

    name: str
    """Name of the recording, and of its results folder."""
    request: Request
    """Options of the recording."""
    after: str | None = None
    """Name of an earlier recording with the same file of shapes, for which this one has to wait."""


def read_table(path: Path) -> list[Entry]:
    """Read the recordings of a table, in its order.

    Paths are relative to the table's folder. They must not lead out of it, unless they are
    absolute. InputError that names the file, the recording and the cure.
    """
    tables = read_toml(path)
    for key in tables.keys() - {"defaults", "recordings"}:
        raise InputError(
            f"{path}: {key} is not a known table; write [defaults] and [recordings.NAME]"
        )
    defaults = _table(tables.get("defaults", {}), path, "defaults")
    recordings = _table(tables.get("recordings", {}), path, "recordings")
    if not 1 <= len(recordings) <= _MOST:
        raise InputError(
            f"{path}: the table has {len(recordings)} recordings; give 1 to {_MOST}, each as "
            "[recordings.NAME]"
        )
    _check_names(list(recordings), path)
    config_from(defaults, Request, path, place="defaults", cure=_CURE)
    entries = []
    for name, own in recordings.items():
        place = f"recordings.{name}"
        own = _table(own, path, place)
        # The times of frames are given by one option only.
        less = {"fps", "timestamps"} if own.keys() & {"fps", "timestamps"} else set()
        values = {key: value for key, value in defaults.items() if key not in less} | own
        request = config_from(values, Request, path, place=place, cure=_CURE)
        entries.append(Entry(name, _located(request, path, place)))
    return _in_turn(entries, path)


def _table(value: Any, path: Path, place: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{path}: {place} must be a table, got {describe(value)}; {_CURE}")
    return value


def _check_names(names: list[str], path: Path) -> None:
    """Raise InputError for names that are not valid for a folder, or that are equal on some file
    systems.
    """
    seen = {"batch.json": "batch.json"}
    for name in names:
        if _NAME.fullmatch(name) is None:
            raise InputError(
                f"{path}: recordings.{name[:100]}: the name is also that of a folder, so it must "
                "have up to 100 letters, digits, dots, - and _, and begin with a letter or "
                "digit; rename it"
            )
        if name.lower() in seen:
            other = seen[name.lower()]
            raise InputError(
                f"{path}: recordings.{name}: some file systems do not distinguish this name from"
                f" {other}; rename it"
            )
        seen[name.lower()] = name


def _located(request: Request, path: Path, place: str) -> Request:
    """Return the request with relative paths resolved against the table's folder."""
    given = {name: getattr(request, name) for name in _PATHS}
    if request.skeleton is not None and not layouts_called(request.skeleton):
        given["skeleton"] = Path(request.skeleton)
    found = {
        name: _inside(value, path, f"{place}.{name}")
        for name, value in given.items()
        if value is not None
    }
    return replace(
        request,
        **{name: str(value) if name == "skeleton" else value for name, value in found.items()},
    )


def _inside(given: Path, path: Path, place: str) -> Path:
    """Resolve a path: relative to the table's folder and inside it, or absolute."""
    if "\0" in str(given):
        raise InputError(
            f"{path}: {place}: {str(given)[:80]!r} is not a valid file name; correct it"
        )
    if not (is_inside(path.parent, given) or given.is_absolute()):
        raise InputError(
            f"{path}: {place}: {given} is outside the table's folder; if this is intended, give "
            "an absolute path"
        )
    return path.parent / given  # an absolute path stays unchanged


def _in_turn(entries: list[Entry], path: Path) -> list[Entry]:
    """Set `after`, so that entries with the same file of shapes wait for each other, in the order
    of the table.
    """
    last: dict[Path, str] = {}
    projects: dict[tuple[Path, str | None], str] = {}
    found = []
    for each in entries:
        shapes, project = each.request.shapes, each.request.project
        if project is not None:
            other = projects.setdefault((project.resolve(), each.request.frames), each.name)
            if other != each.name:
                raise InputError(
                    f"{path}: recordings.{each.name}: {project} is also the project of {other}, "
                    "and their TRC files would overwrite each other; remove one of them"
                )
        if shapes is not None:
            each = replace(each, after=last.get(shapes.resolve()))
            last[shapes.resolve()] = each.name
        found.append(each)
    return found


def options_of(request: Request) -> dict[str, Any]:
    """The options as plain values, which are equal for equal requests."""
    usual = vars(Request())
    given = {name: value for name, value in vars(request).items() if value != usual[name]}
    return json.loads(json.dumps(given, default=plain))
