"""Converts validation errors of pydantic to plain sentences."""

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.errors import InputError

Model = TypeVar("Model", bound=BaseModel)


def validated(
    model: type[Model], value: object, place: object, cure: str | Mapping[str, str]
) -> Model:
    """Validate `value`, from a file, as a `model`; InputError that names place, key and cure if it
    is invalid.

    If `cure` is a mapping by key, that of the innermost known key is used.
    """
    try:
        return model.model_validate(value)
    except ValidationError as error:
        keys, problem = first_problem(error)
    if not isinstance(cure, str):
        default = "see docs/conventions.md for the format"
        cure = next((cure[str(key)] for key in reversed(keys) if key in cure), default)
    raise InputError(f"{place}: {key_text(keys)} {problem}; {cure}")


def first_problem(error: ValidationError) -> tuple[tuple[int | str, ...], str]:
    """The first problem in `error`: its place (keys and indices), and its description.

    For example `(("RT",), "must hold 12 values, got 11")`.
    """
    problem: Any = error.errors(include_url=False)[0]
    kind, got, context = problem["type"], describe(problem["input"]), problem.get("ctx", {})
    what = f"is not valid: {problem['msg'][:1].lower()}{problem['msg'][1:]}, got {got}"
    if kind in _SAYINGS:
        what = _SAYINGS[kind]
    elif kind in ("too_short", "too_long"):
        bound = context["min_length" if kind == "too_short" else "max_length"]
        what = f"must hold {bound} value{'s' if bound != 1 else ''}, got {len(problem['input'])}"
    elif kind == "greater_than":
        what = f"must be greater than {context['gt']}, got {got}"
    elif kind in ("literal_error", "enum"):
        what = f"must be {context['expected']}, got {got}"
    elif kind in _WANTED:
        what = f"must be {_WANTED[kind]}, got {got}"
    elif kind in ("value_error", "assertion_error"):
        what = f"is not valid: {context.get('error', problem['msg'])}"
    return problem["loc"], what


def key_text(place: tuple[int | str, ...]) -> str:
    """`("cameras", 1, "K", 0)` as `cameras[1].K[0]`; "the whole file" if there is no key."""
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return key.removeprefix(".") or "the file"


def describe(value: object) -> str:
    """Short description of a value of a JSON or TOML file: "a list of 3", "text 'abc'", "null"."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    if isinstance(value, str):
        return f"text {value[:20]!r}" + ("..." if len(value) > 20 else "")
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return str(value)[:40]


def numbers(value: object, name: str, cure: str, *, may_lack: bool = False) -> Array:
    """One or more numbers: of a list, whose rows have equal lengths, or a single one. InputError
    naming the entry that is none. With `may_lack`, an entry may be NaN.
    """
    found = np.zeros(0, dtype=object)
    with suppress(ValueError):  # rows of different lengths
        found = np.array(value)
    # Detections are millions of numbers, which are not looked at one by one.
    fine = may_lack and found.dtype.kind in "iuf" and not np.isinf(found).any()
    problem = None if fine else _no_number(value, name, may_lack)
    if problem is None and found.dtype != object:
        return np.atleast_1d(found.astype(np.float64))
    raise InputError(f"{problem or f'{name} must have rows of equal length'}; {cure}")


def _no_number(value: object, name: str, may_lack: bool) -> str | None:
    """The first entry of nested lists that is no finite number, in words."""
    if isinstance(value, list | np.ndarray):
        entries = (_no_number(each, f"{name}[{n}]", may_lack) for n, each in enumerate(value))
        return next(filter(None, entries), None)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return f"{name} must be a number, got {describe(value)}"
    fine = math.isfinite(value) or (may_lack and math.isnan(value))
    return None if fine else f"{name} must be a finite number, got {describe(value)}"


def is_number(word: str) -> bool:
    """Whether `word` can be read as a finite number."""
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


_SAYINGS = {"missing": "is missing", "extra_forbidden": "is not a known key"}
_WANTED = {
    "float_type": "a number",
    "float_parsing": "a number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "string_type": "text",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "an object",
    "model_type": "an object",
    "dataclass_type": "a table",
    "finite_number": "a finite number",
}
"""The expected value for each of pydantic's type errors, in words."""
