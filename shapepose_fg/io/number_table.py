"""Reads tables of numbers from text: a line per row, with an optional header of column names."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import BIG, read_text
from shapepose_fg.core.validation import is_number

What = Callable[[int], str] | str
MISSING = "-"
"""Placeholder of a missing number in the columns that allow it."""


def read_number_table(
    path: Path,
    heads: Callable[[int, list[str]], tuple[list[str], bool]],
    units: str,
    may_lack: Callable[[str], bool] = lambda name: False,
) -> tuple[list[str], Array, Index]:
    """The names of the columns, the numbers (R, C), NaN for missing ones, and the line (R,) of each
    row.

    Words are separated by commas or spaces, and `#` begins a comment. `heads` receives the number
    and the words of the first line, and returns the names of the columns, and whether that line is
    a header. `may_lack` returns whether a column may contain `MISSING`, or be empty after the last
    comma of a line. InputError that names file and line; `units` is the advice for words that are
    no numbers.
    """
    names, rows, lines = list[str](), list[list[float]](), list[int]()
    for line, text in enumerate(read_text(path, most=BIG).splitlines(), start=1):
        words = [word for word in re.split(r"[,\s]+", text.split("#")[0].strip()) if word]
        if len(words) == 0:
            continue
        if len(names) == 0:
            names, is_header = heads(line, words)
            if is_header:
                continue
        if text.rstrip().endswith(","):
            words += [MISSING for name in names[len(words) :] if may_lack(name)]
        if len(words) != len(names):
            cure = "correct the line, or name the columns in the first line"
            raise InputError(
                f"{path}: line {line} must hold {len(names)} numbers, got {len(words)}; {cure}"
            )
        row = list[float]()
        for name, word in zip(names, words, strict=True):
            lacks = word == MISSING and may_lack(name)
            if not (lacks or is_number(word)):
                raise InputError(
                    f"{path}: line {line} must hold numbers, got {word[:20]!r}; {units}"
                )
            row.append(np.nan if lacks else float(word))
        rows.append(row)
        lines.append(line)
    return names, np.array(rows).reshape(len(rows), len(names)), np.array(lines, dtype=np.intp)


def refuse_first(path: Path, lines: Index, bad: Mask, what: What, cure: str) -> None:
    """Raise InputError naming the first line of a table whose row is `bad` (R,), if there is
    one; `lines` (R,). `what` says what is wrong with it, or with a row by its number.
    """
    if bad.any():
        row = int(np.argmax(bad))
        says = what if isinstance(what, str) else what(row)
        raise InputError(f"{path}: line {lines[row]}{says}; {cure}")
