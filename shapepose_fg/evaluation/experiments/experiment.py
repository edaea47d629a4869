"""An experiment: cases that are measured one by one, and a table with rows that combine their
figures.
"""

import json
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import read_json, write_content

Figures = dict[str, Any]
"""Figures of a case: numbers and texts by name, None if there is nothing to measure; saved as
JSON."""

_POOLED = {"mean": np.average, "least": np.min, "most": np.max, "sum": np.sum}


@dataclass(frozen=True)
class Case:
    """One independent measurement."""

    name: str
    """Name, unique in the experiment."""
    measure: Callable[[], Figures]
    """Function that measures. Nothing is computed before it is called."""


@dataclass(frozen=True)
class Column:
    """A column of the table."""

    heading: str
    """Heading of the column."""
    figure: str
    """Name of the figure that it shows."""
    decimals: int = 1
    """Number of digits after the point."""
    pool: Literal["mean", "least", "most", "sum"] = "mean"
    """How the figures of a row's cases are combined. Shares of joints of a class are weighted by
    their count."""

    def cell(self, cases: Sequence[Figures]) -> str:
        """Text in a row of these cases; a dash if none has the figure."""
        those = [case for case in cases if case.get(self.figure) is not None]
        values = [case[self.figure] for case in those]
        if len(values) == 0 or isinstance(values[0], str):
            return values[0] if len(values) > 0 else "-"
        if self.pool != "mean":
            return f"{_POOLED[self.pool](values):.{self.decimals}f}"
        count = f"joints_{self.figure.partition('_inside_')[0].removesuffix('_log_score')}"
        weights = (
            [case[count] for case in those] if all(case.get(count) for case in those) else None
        )
        return f"{np.average(values, weights=weights):.{self.decimals}f}"


def columns(*given: tuple[Any, ...]) -> tuple[Column, ...]:
    """Columns from tuples of the arguments of `Column`."""
    return tuple(Column(*each) for each in given)


@dataclass(frozen=True)
class Experiment:
    """A measured table in the documentation."""

    name: str
    """Name in the table's marks in the documentation."""
    rows: Mapping[str, Sequence[Case]]
    """For each row, its name and the cases that are combined in it; a case may be in several
    rows."""
    columns: Sequence[Column]
    """Columns of the table after the first, which has the names of the rows."""

    @property
    def cases(self) -> list[Case]:
        """Every case once, in the order of measurement. ValueError for two with one name."""
        every = list({id(case): case for row in self.rows.values() for case in row}.values())
        if len({case.name for case in every}) < len(every):
            raise ValueError(
                f"{self.name}: two cases have one name: {sorted(case.name for case in every)}"
            )
        return every

    def only(self, wanted: Callable[[str], bool]) -> "Experiment":
        """Return the experiment with only those cases for which `wanted(name)` is true."""
        rows = {
            label: [case for case in row if wanted(case.name)] for label, row in self.rows.items()
        }
        return replace(self, rows={label: row for label, row in rows.items() if len(row) > 0})

    def table(self, figures: Mapping[str, Figures]) -> list[str]:
        """The lines of a Markdown table from the figures of all cases, by name."""
        lines = [
            f"| | {' | '.join(column.heading for column in self.columns)} |",
            "|---" * (1 + len(self.columns)) + "|",
        ]
        for label, row in self.rows.items():
            those = [figures[case.name] for case in row]
            lines.append(
                f"| {label} | {' | '.join(column.cell(those) for column in self.columns)} |"
            )
        return lines


def measured(
    experiment: Experiment,
    folder: Path,
    *,
    afresh: bool = False,
    told: Callable[[str], None] = print,
) -> tuple[dict[str, Figures], float]:
    """The figures of every case by name, and the total computing time in seconds, summed over
    interrupted runs.

    Each case has a file in `folder`: an interrupted run is resumed, unless `afresh` is set.
    InputError if a file has no figures.
    """
    figures, seconds = dict[str, Figures](), 0.0
    for case in experiment.cases:
        file = folder.joinpath(
            *(re.sub(r"[^A-Za-z0-9.+-]+", "_", each.name) for each in (experiment, case))
        )
        file = file.with_name(f"{file.name}.json")
        if afresh or not file.is_file():
            began = time.perf_counter()
            found = {"figures": case.measure(), "seconds": time.perf_counter() - began}
            write_content(file, json.dumps(found, indent=1) + "\n")
            told(f"  {experiment.name}: {case.name}, {found['seconds']:.0f} s")
        kept = read_json(
            file
        )  # after a round trip through JSON, so that a resumed run has equal values
        try:
            figures[case.name] = dict(kept["figures"])
            seconds += float(kept["seconds"])
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{file}: these are not figures of an experiment; delete it") from None
    return figures, seconds
