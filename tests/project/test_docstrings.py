"""Docstrings stand alone: editors show each of them without the one before."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CONTINUES = r"\s*(\([^)]*\)(,? or )?)*[,;:]?\s*(and|of|or(?! \()|so|the same|likewise)\b"
"""Shapes, "(V,) or (N, V)" say, and the first words of a docstring that is understood only after
another one."""


def stands_alone(docstring: str) -> bool:
    """Whether the first words of a docstring, shapes aside, do not continue another docstring."""
    return re.match(CONTINUES, docstring, re.IGNORECASE) is None


def continuing(text: str) -> Iterator[tuple[int, str]]:
    """Line and text of the docstrings that continue another one, in Python code; also of constants
    and fields.
    """
    if re.search(rf"^\s*r?[\"']+{CONTINUES}", text, re.IGNORECASE | re.MULTILINE) is None:
        return  # parsing all files takes seconds
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.Expr(value=ast.Constant(value=str(docstring))) if not stands_alone(docstring):
                yield node.lineno, docstring


def test_docstrings_stand_alone() -> None:
    found = []
    for top in ("shapepose_fg", "factors", "scripts"):
        for file in sorted((ROOT / top).rglob("*.py")):
            for line, text in continuing(file.read_text(encoding="utf-8")):
                found.append(f"{file.relative_to(ROOT)}:{line}: {text.strip().splitlines()[0]}")
    assert found == [], "say what it is, in a sentence that needs no other docstring"


@pytest.mark.parametrize(
    "docstring",
    [
        '"""And at its end."""',
        '"""Of each camera."""',
        '"""(N, V) of the same, in the same units."""',
        '"""(V,) or (N, V), the same as `focal_px`."""',
        '"""The same people with other names."""',
        '"""\n    So often it is tried again."""',
        'r"""Likewise."""',
        '"Of the row."',
    ],
)
def test_docstrings_that_continue_are_noticed(docstring: str) -> None:
    assert [line for line, _ in continuing(f"class A:\n    field: int\n    {docstring}\n")] == [3]


@pytest.mark.parametrize(
    "docstring",
    [
        "Offsets, s.",
        "(V,) or (N, V) focal lengths.",
        "(N,) order of rows.",
        "Solve.",
        "Sort; the same.",
    ],
)
def test_other_docstrings_are_not_refused(docstring: str) -> None:
    assert stands_alone(docstring)
