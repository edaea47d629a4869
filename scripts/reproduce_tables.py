"""Measure the tables of docs/evaluation/people.md again.

    python scripts/reproduce_tables.py --mocap cmu_smpl24.npz                    # all tables: hours
    python scripts/reproduce_tables.py --mocap cmu_smpl24.npz --case crowd --split tune
    python scripts/reproduce_tables.py --mocap cmu_smpl24.npz --only time --update

Scenes come from fixed seeds. Without `--mocap`, only recordings of two people are measured. Figures
of a case are kept in `--results`, so that an interrupted measurement continues; give another folder
after a change of the code. `--update` writes tables between the marks `<!-- NAME -->` and
`<!-- end -->` of the page.
"""

import json
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from typer import Option, Typer

from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.tracking import score_tracks
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.files import truth_of
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import SEQUENCES, Split, sequence
from shapepose_fg.simulation.training.motions import split_of

PAGE = Path(__file__).parent.parent / "docs" / "evaluation" / "people.md"
OVER_TIME = PipelineConfig()
MODES = {"with time": OVER_TIME, "without time": replace(OVER_TIME, temporal=False)}
SEGMENTS: dict[Split, dict[str, tuple[int, int]]] = {
    "report": {"salsa": (108, 618), "crossing": (0, 726), "crowd": (0, 826)},
    "tune": {"salsa": (0, 564), "crossing": (0, 564), "crowd": (241, 900)},
}
"""First frames of the segments of the named sequences; each has 300 frames without a cut."""
POOLS: dict[str, Callable[..., Any]] = {"mean": np.average, "least": np.min, "sum": np.sum}


class Case(NamedTuple):
    """One independent measurement."""

    row: str
    """Name of the row in which its figures are combined with those of other cases."""
    name: str
    """Name, unique in the table."""
    make: Callable[[], Scene]
    """Function that makes the people and cameras."""
    span: range
    """Frames of the scene."""
    seed: int = 0
    """Seed of the detector's errors."""
    config: PipelineConfig = OVER_TIME
    """Settings of the reconstruction."""


class Column(NamedTuple):
    """A column of a table."""

    heading: str
    figure: str
    """Name of the figure that it shows."""
    decimals: int = 1
    pool: str = "mean"
    """How the figures of a row's cases are combined. Shares of joints are weighted by their
    count."""

    def cell(self, cases: Sequence[dict[str, Any]]) -> str:
        """Text in a row of these cases; a dash if none has the figure."""
        those = [case for case in cases if case.get(self.figure) is not None]
        if len(those) == 0:
            return "-"
        count = f"joints_{self.figure.partition('_inside_')[0].removesuffix('_log_score')}"
        weighted = self.pool == "mean" and all(case.get(count) for case in those)
        how = {"weights": [case[count] for case in those]} if weighted else {}
        return f"{POOLS[self.pool]([case[self.figure] for case in those], **how):.{self.decimals}f}"


COLUMNS = [
    Column(*each) for each in list[tuple[Any, ...]]((
        ("F1", "f1"), ("least", "f1", 1, "least"), ("recall", "recall"), ("IDF1", "idf1"),
        ("MPJPE", "mpjpe_mm"), ("accel", "acceleration_error"), ("FP", "false_positives", 0, "sum"),
        ("missed", "people_missed", 0, "sum"), ("switches", "switches", 0, "sum"),
        ("wrist", "fast_wrist_error_mm"), ("body", "body_mpjpe_mm"),
        ("b accel", "body_acceleration_error"),
        *((f"{words} {level} %", f"{name}_inside_{level}") for words, name in (
            ("2 views", "seen"), ("1", "one_view"), ("0", "no_view"), ("u", "unseen"),
            ("v", "velocity")) for level in (50, 95)),
        ("u", "joints_unseen", 0, "sum"), ("v", "velocity_error", 2), ("ms", "cpu_ms", 0),
    ))
]  # fmt: skip
"""Columns of all tables: lengths in mm, accelerations in m/s², velocities in m/s, `u`: joints that
no view has seen for ten frames; ms: processor time per frame."""


def in_time(mocap: Mocap, split: Split) -> Iterator[Case]:
    """Two segments of each sequence."""
    for name, starts in SEGMENTS[split].items():
        for span in (range(start, start + 300) for start in starts):
            label = f"{name} {span.start}:{span.stop}"
            make = partial(sequence, name, split, mocap, until=span.stop)
            yield Case(label, label, make, span)


def held_back(mocap: Mocap) -> Iterator[Case]:
    """Held-out people, in sequences that were created after all settings had been chosen.

    The dancers are the same recordings as in the reported segments, which are not used for
    training. People who stand and walk around them are test subjects only. Positions, bodies,
    cameras and the detector's errors are from other random draws.
    """
    learnt_from = frozenset(each for each in mocap.subjects if split_of(each) != "test")
    for mode, config in MODES.items():
        for name, start in {"salsa": 0, "crossing": 108, "crowd": 0}.items():
            made, span = (
                replace(SEQUENCES[name], seed=1001, without=learnt_from),
                range(start, start + 300),
            )
            make = partial(sequence, name, "report", mocap, until=span.stop, config=made)
            label = f"{name} {span.start}:{span.stop}, {mode}"
            yield Case(label, label, make, span, 1001, config)


def crowds_and_crossings(mocap: Mocap | None, split: Split, seeds: Sequence[int]) -> Iterator[Case]:
    """4 s of crowds of eight people and crossings of seven with 2 to 8 cameras, at 10 to 60 frames
    a second, and of two people; single frames at 30 frames a second only, since they are
    independent of the rate.
    """
    rates = {2: (10, 15, 20, 30, 60), 3: (10, 15, 20, 30, 60), 4: (10, 15, 20, 30, 60),
             6: (10, 15, 20, 30, 60), 8: (30,)}  # fmt: skip
    kinds = [(cameras, rate) for cameras, every in rates.items() for rate in every]
    for seed in seeds:
        for mode, config in MODES.items():
            two = partial(built_in_scene, seed, people=2, cameras=2, frames=120, fps=30)
            named = f"two people, {mode}"
            yield Case(named, f"{seed} {named}", two, range(120), seed, config)
            if mocap is None:
                continue
            for name in ("crowd", "crossing"):
                made = replace(SEQUENCES[name], seed=seed)
                for cameras, rate in kinds if config.temporal else [(n, 30) for n in rates]:
                    make = partial(
                        sequence, name, split, mocap, cameras=cameras, until=4 * rate, fps=rate,
                        config=made,
                    )  # fmt: skip
                    row = f"{name}, {cameras} cameras {rate} Hz, {mode}"
                    yield Case(row, f"{seed} {row}", make, range(4 * rate), seed, config)


def measure(case: Case) -> dict[str, Any]:
    """The figures of `score_tracks` for a case, and `cpu_ms` a frame."""
    scene = case.make().part(case.span)
    detections = simulate(scene, seed=case.seed)
    began = time.process_time()
    times = FrameTimes.from_fps(scene.fps, len(scene))
    people = reconstruct(detections, scene.rig, case.config, times=times, cuts=scene.cuts)
    cpu_ms = 1e3 * (time.process_time() - began) / len(scene)
    score = score_tracks(people, truth(scene), scene.fps, identities=case.config.temporal)
    return score | {"cpu_ms": cpu_ms}


def truth(scene: Scene) -> Reconstruction:
    """The people as a result, in which identities change at a cut."""
    found = truth_of(scene)
    part = np.searchsorted(scene.cuts, found.frame, side="right")
    return replace(found, person=found.person + part * (int(found.person.max(initial=0)) + 1))


def table(cases: Sequence[Case], figures: Sequence[dict[str, Any]]) -> str:
    """A Markdown table: a row for each name of rows, and one for all cases."""
    rows = {row: [f for c, f in zip(cases, figures, strict=True) if c.row == row]
            for row in dict.fromkeys(case.row for case in cases)}  # fmt: skip
    rows |= {"**all**": list(figures)} if len(rows) > 1 else {}
    lines = [["", *(column.heading for column in COLUMNS)], ["---"] * (1 + len(COLUMNS))]
    lines += [[row, *(column.cell(those) for column in COLUMNS)] for row, those in rows.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


app = Typer(add_completion=False)


@app.command(help=__doc__)
def main(
    mocap: Annotated[Path | None, Option(help="File of recorded motions.")] = None,
    only: Annotated[list[str] | None, Option(help="Name of a table.")] = None,
    case: Annotated[list[str] | None, Option(help="Only cases whose names have this text.")] = None,
    seed: Annotated[list[int] | None, Option(help="Of `who is there`: 6101 to 6105.")] = None,
    split: Literal["tune", "report"] = "report",
    results: Path = PAGE.parents[2] / "build" / "figures",
    update: Annotated[bool, Option("--update", help="Write the tables into the page.")] = False,
) -> None:
    """Measure the requested tables, and print or write them."""
    motions = None if mocap is None else Mocap.load(mocap)
    tables = {"who is there": crowds_and_crossings(motions, split, seed or range(6101, 6106))}
    if motions is not None:
        tables = {"time": in_time(motions, split), "held back": held_back(motions), **tables}
    for name in only or tables:
        cases = [each for each in tables[name] if all(text in each.name for text in case or ())]
        figures = []
        for each in cases:
            named = re.sub(r"[^\w+-]+", "_", f"{name} {split} {each.name}")
            file = results / f"{named}.json"
            if not file.is_file():
                file.parent.mkdir(parents=True, exist_ok=True)
                content = json.dumps(measure(each), indent=1)
                file.write_text(content, encoding="utf-8")
            figures.append(json.loads(file.read_text(encoding="utf-8")))
        text = f"<!-- {name} -->\n\n{table(cases, figures)}\n\n<!-- end -->"
        print(f"{text}\n", flush=True)
        if update:
            page, marks = PAGE.read_text(encoding="utf-8"), rf"<!-- {name}\b.*?<!-- end -->"
            PAGE.write_text(re.sub(marks, lambda _, t=text: t, page, flags=re.DOTALL), "utf-8")


if __name__ == "__main__":
    app()
