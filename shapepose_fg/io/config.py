"""Settings as TOML: nested dataclasses as tables, each setting with its docstring as a comment."""

import ast
import inspect
import json
import textwrap
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar, cast, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from shapepose_fg.core.bounds import interval_of, range_of, violated
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.storage.files import read_toml
from shapepose_fg.core.validation import describe, first_problem

T = TypeVar("T")

_STRICT = ConfigDict(strict=True, allow_inf_nan=False)


def read_config(path: str | Path, kind: type[T]) -> T:
    """Read settings of the dataclass `kind` from a TOML file; settings that are missing in the file
    have their defaults.

    A field that is a dataclass corresponds to a table. Raises InputError naming the file, the key
    and the cure for bad TOML, an unknown key, a wrong type, or a value that the dataclass refuses.
    """
    return config_from(read_toml(Path(path), may_be_empty=True), kind, path)


_CURE = "`shapepose-fg config` prints the defaults"
ANOTHER_VERSION = (
    "it was written by another version of this program; reconstruct the recording again"
)
"""Advice for errors in settings that this program wrote."""


def config_from(
    table: dict[str, Any], kind: type[T], path: str | Path, *, place: str = "", cure: str = _CURE
) -> T:
    """Settings of the dataclass `kind` from nested plain values (`asdict`), such as those in the
    run.json at `path`.

    `place` is the dotted name of the table in the file. Raises InputError naming file and key, as
    `read_config` does, with `cure` at its end.
    """
    hints, prefix = get_type_hints(kind), f"{place}." if place else ""
    bounded = get_type_hints(kind, include_extras=True)
    known = [field.name for field in fields(cast(Any, kind)) if field.init]
    replaced: dict[str, str] = getattr(kind, "replaced", {})
    values = {}
    for key, value in table.items():
        name = f"{prefix}{key}"
        if key in replaced:
            raise InputError(f"{path}: {name} {replaced[key]}; {cure}")
        if key not in known:
            near = get_close_matches(key, known, n=1, cutoff=0)[0]
            meant = cure if cure == ANOTHER_VERSION else f"did you mean {prefix}{near}?"
            raise InputError(f"{path}: {name} is not a known key; {meant}")
        hint = hints[key]
        if is_dataclass(hint) and not isinstance(value, dict):
            raise InputError(
                f"{path}: {name} must be a table, got {describe(value)}; write [{name}] above "
                "its keys"
            )
        if is_dataclass(hint):
            values[key] = config_from(value, cast(type, hint), path, place=name, cure=cure)
            continue
        try:
            # Validated as JSON, so that in strict mode lists are still accepted for tuples, and
            # texts for enumerations.
            values[key] = _adapter(hint).validate_json(json.dumps(value, default=str))
        except ValidationError as error:
            inside, problem = first_problem(error)
            index = "".join(f"[{part}]" for part in inside if isinstance(part, int))
            raise InputError(f"{path}: {name}{index} {problem}; {cure}") from None
        interval = interval_of(bounded[key])
        if interval and values[key] is not None and (problem := violated(interval, values[key])):
            raise InputError(f"{path}: {name} must {problem}, got {values[key]}; {cure}")
    with naming(path, cure, f"{prefix}{{}}"):
        return kind(**values)


def toml_text(config: object) -> str:
    """`config` (a dataclass) as TOML for `read_config`; the docstring of each field is a comment
    above it.
    """
    return "\n".join(_lines(config)).strip() + "\n"


@cache
def _adapter(hint: Any) -> TypeAdapter[Any]:
    """The validator of a type; cached, because it takes a millisecond to make."""
    return TypeAdapter(hint, config=_STRICT)


def _lines(config: Any, table: str = "") -> list[str]:
    """TOML lines of a dataclass: first its settings, then its tables."""
    comments = _field_docstrings(type(config))
    settings, tables = [], []
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value):
            name = f"{table}.{field.name}" if table else field.name
            tables += ["", *_comment(comments.get(field.name)), f"[{name}]", *_lines(value, name)]
        else:
            bounds = range_of(type(config), field.name)
            words = [comments.get(field.name), None if bounds is None else f"({bounds})"]
            settings += _comment(" ".join(filter(None, words)) or None)
            settings.append(
                f"# {field.name} is not set" if value is None else f"{field.name} = {_toml(value)}"
            )
    return settings + tables


def _comment(text: str | None) -> list[str]:
    """`text` as comment lines."""
    return (
        [] if text is None else [f"# {line}" for line in textwrap.wrap(" ".join(text.split()), 100)]
    )


def _toml(value: Any) -> str:
    """A plain value as TOML."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, float):
        return repr(value)  # inf and nan are spelled the same in TOML
    return json.dumps(value)


def _field_docstrings(kind: type) -> dict[str, str]:
    """The docstring below each field of a dataclass, from the source, because Python does not keep
    it.
    """
    try:
        body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    except (OSError, TypeError):  # no source file
        return {}
    comments = {}
    for statement, following in pairwise(cast(ast.ClassDef, body).body):
        if isinstance(statement, ast.AnnAssign) and isinstance(following, ast.Expr):
            text = (
                ast.literal_eval(following.value)
                if isinstance(following.value, ast.Constant)
                else None
            )
            comments[cast(ast.Name, statement.target).id] = text
    return {name: text for name, text in comments.items() if isinstance(text, str)}
