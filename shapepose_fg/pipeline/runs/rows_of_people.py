"""The rows of one person, or track, out of all parts of a run: read when they are asked for."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.pipeline.runs.parts import Parts


@dataclass(frozen=True)
class RowsOfPeople:
    """Whose the rows of the parts of a run are."""

    parts: Parts
    """The solved windows."""
    whose: Sequence[NDArray[np.integer]]
    """For each part (R,) whose its rows are."""

    @cached_property
    def counts(self) -> dict[int, int]:
        """How many rows everybody has, by number."""
        return {number: sum(count for _, count in places) for number, places in sorted(self._places.items())}

    def pieces(
        self, number: int, columns: Sequence[str], rows: slice = slice(None)
    ) -> Iterator[tuple[NDArray[Any], ...]]:
        """`columns` of somebody's rows, part by part; `rows` counts among somebody's own."""
        start, stop, _ = rows.indices(self.counts[number])
        before = 0
        for n, count in self._places[number]:
            first, last = max(start - before, 0), min(stop - before, count)
            before += count
            if first < last:
                mine = np.flatnonzero(self.whose[n] == number)[first:last]
                yield tuple(self.parts.column(n, name)[mine] for name in columns)

    @cached_property
    def _places(self) -> dict[int, list[tuple[int, int]]]:
        """In which parts everybody is, and in how many rows of each."""
        places: dict[int, list[tuple[int, int]]] = {}
        for n, whose in enumerate(self.whose):
            numbers, counts = np.unique(whose, return_counts=True)
            for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
                places.setdefault(number, []).append((n, count))
        return places
