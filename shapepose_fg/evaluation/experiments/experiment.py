"""What an experiment is: cases that are measured one by one, and the table that is made of their figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

Figures = dict[str, Any]
"""What a case measured: numbers, texts, lists and dicts of them, as JSON has them."""


Basis = Literal["pipeline", "bodies", "detector"]
"""What figures depend on: every setting and all data that ship, or only those of fitting bodies, or of the
simulated detector."""


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
    basis: Basis = "pipeline"
    """What makes the figures old when it changes."""

    def only(self, cases: Sequence[Case]) -> "Experiment":
        """The same with some of its cases."""
        return replace(self, cases=cases)


def whole(name: str, table: Callable[[], list[str]], basis: Basis = "pipeline") -> Experiment:
    """An experiment of one case, whose figures are the lines of its table."""
    return Experiment(name, (Case("table", lambda: {"lines": table()}),), lambda f: f["table"]["lines"], basis)
