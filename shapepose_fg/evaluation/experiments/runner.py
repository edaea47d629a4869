"""Measure the cases of experiments one after the other; what is measured is kept, and not measured again."""

import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import read_json, write_atomically
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures
from shapepose_fg.evaluation.experiments.made_with import changes, made_with


@dataclass(frozen=True)
class Kept:
    """Figures in a folder, one file a case: a run that was stopped goes on from there."""

    folder: Path
    """Where they are."""
    scale: str = ""
    """How much was measured: figures of another scale are measured again, and so are those that were made with
    other defaults (`made_with`)."""
    afresh: bool = False
    """Whether to measure everything again."""

    def get(self, experiment: Experiment, case: Case) -> tuple[Figures, float] | None:
        """Figures and the seconds they took; None where there are none of now."""
        file = self._file(experiment, case)
        if not file.is_file():
            return None
        kept = read_json(file)
        try:
            same = kept["scale"] == self.scale and not changes(kept["made_with"], made_with(experiment.basis))
            return (kept["figures"], float(kept["seconds"])) if same else None
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{file}: these are not figures of an experiment; delete it") from None

    def put(self, experiment: Experiment, case: Case, figures: Figures, seconds: float) -> None:
        """Keep figures."""
        made = made_with(experiment.basis)
        content = {"seconds": seconds, "figures": figures, "scale": self.scale, "made_with": made}
        text = json.dumps(content, indent=1) + "\n"
        write_atomically(self._file(experiment, case), lambda stream: stream.write(text.encode()))

    def whole(self, experiment: Experiment) -> bool:
        """Whether the figures of every case are kept."""
        return all(self.get(experiment, case) is not None for case in experiment.cases)

    def words(self, experiment: Experiment) -> str:
        """How much of an experiment is kept, and the time that it took."""
        found = [each for case in experiment.cases if (each := self.get(experiment, case)) is not None]
        return f", {len(found)} kept, {sum(seconds for _, seconds in found):.0f} s" if len(found) > 0 else ""

    def _file(self, experiment: Experiment, case: Case) -> Path:
        experiment_, case_ = (re.sub(r"[^A-Za-z0-9.+-]+", "_", each.name) for each in (experiment, case))
        return self.folder / experiment_ / f"{case_}.json"


def measured(
    experiment: Experiment, kept: Kept, told: Callable[[str], None] = print
) -> tuple[dict[str, Figures], float]:
    """The figures of every case by name, and the seconds that all of them took, whenever that was."""
    figures, seconds = dict[str, Figures](), 0.0
    for case in experiment.cases:
        found = None if kept.afresh else kept.get(experiment, case)
        if found is None:
            began = time.perf_counter()
            measure = case.measure()
            spent = time.perf_counter() - began
            kept.put(experiment, case, measure, spent)
            told(f"  {experiment.name}: {case.name}, {spent:.0f} s")
            found = kept.get(experiment, case)  # as JSON gives it back, so that a run that goes on is no other
            assert found is not None
        figures[case.name] = found[0]
        seconds += found[1]
    return figures, seconds
