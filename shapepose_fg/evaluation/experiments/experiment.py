"""What an experiment is: cases that are measured one by one, and the table that is made of their figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Figures = dict[str, Any]
"""What a case measured: numbers, texts, lists and dicts of them, as JSON has them."""


@dataclass(frozen=True)
class Case:
    """One measurement, which can be done without the others."""

    name: str
    """Unlike that of the experiment's other cases."""
    measure: Callable[[], Figures]
    """Does it. Nothing is computed before it is called."""


@dataclass(frozen=True)
class Experiment:
    """A table of the documents."""

    name: str
    """That of its marks in the documents."""
    cases: Sequence[Case]
    """What is measured; the order is that of the time it is done in."""
    table: Callable[[Mapping[str, Figures]], list[str]]
    """The lines of Markdown that the figures of all cases, by name, make."""
