"""The command `evaluate`: scores results against a truth, as tables for terminals and papers."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from shapepose_fg.cli.options import (
    INPUT,
    REQUIRED,
    RESULT,
    Hertz,
    argument,
    frames_option,
    grouped,
    option,
    result_frames,
)
from shapepose_fg.cli.terminal import note, show, table
from shapepose_fg.core.bounds import Axis

if TYPE_CHECKING:
    from shapepose_fg.evaluation.score import Score


@grouped
def evaluate(
    results: list[Path] = argument(
        "RESULTS...", "Folders of reconstructions, or people in any layout that --truth reads."
    ),
    truth: Path = option(
        INPUT,
        "True people: folder of simulated truth, of CMU Panoptic or AMASS files; actorsGT.mat of "
        "Shelf or Campus; Shelf's annotation (.txt); .npz with joints.",
        REQUIRED,
    ),
    frames: str | None = frames_option(),
    offset: int = option(INPUT, "Number of the truth's frame at frame 0 of the results.", 0),
    up: Axis | None = option(
        INPUT, "World axis that points up, for AMASS, if cameras.json is missing.", metavar="AXIS"
    ),
    fps: Hertz | None = option(INPUT, "Frame rate of the results, Hz, to which AMASS is thinned."),
    body: Path | None = option(INPUT, "Body model of AMASS's shapes."),
    format: Literal["text", "markdown", "latex", "json"] = option(
        RESULT, "text, markdown, latex or json.", "text"
    ),
) -> None:
    """Score results against a truth: PCP, MPJPE, PA-MPJPE, MOTA, IDF1, HOTA, and the coverage of
    the covariances.
    """
    from dataclasses import replace
    from typing import Any

    from shapepose_fg.core.rig_file import CAMERAS
    from shapepose_fg.evaluation.score import score
    from shapepose_fg.evaluation.truth import read_people
    from shapepose_fg.io.calibration import read_rig

    cameras = results[0] / CAMERAS
    axis: Any = up or (read_rig(cameras).up if cameras.is_file() else None)
    how: Any = {"up": axis, "fps": fps, "body": body}
    true = read_people(truth, **how)
    spans = [range(span.start - offset, span.stop - offset) for span in true.covered or ()]
    true = replace(true, frame=true.frame - offset, covered=spans or None)
    scores = {
        str(path): score(read_people(path, **how), true, result_frames(frames)) for path in results
    }
    show_scores(scores, format)


def show_scores(scores: "Mapping[str, Score]", format: str = "text") -> None:
    """Print scores by the names of the results, as text, markdown, latex or json."""
    from shapepose_fg.evaluation.score import FIGURES

    if format == "json":
        every = {name: each.as_dict() for name, each in scores.items()}
        print(json.dumps(every if len(every) > 1 else next(iter(every.values())), indent=2))
        return
    note(*dict.fromkeys(message for each in scores.values() for message in each.notes))
    tables = [
        (["result", *FIGURES.values()], [[n, *_cells(e.figures)] for n, e in scores.items()]),
        _pcp("limb", scores, limbs=True),
        _pcp("person", scores, limbs=False),
    ]
    for number, (heads, rows) in enumerate(tables):
        if number > 0:
            print()
        if format == "text":  # a column for each result, because terminals are narrow
            turned = [list(column) for column in zip(heads, *rows, strict=True)]
            show(table(turned[0], turned[1:]))
        else:
            print(written_table(heads, rows, format))


def _pcp(
    kind: str, scores: "Mapping[str, Score]", *, limbs: bool
) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of the PCP by limb or by person."""
    every = {name: each.limbs if limbs else each.people for name, each in scores.items()}
    columns = list(dict.fromkeys(key for each in every.values() for key in each))
    rows = [[name, *_cells({key: each.get(key, np.nan) for key in columns})]  # type: ignore[call-overload]
            for name, each in every.items()]  # fmt: skip
    return [f"PCP by {kind}, %", *map(str, columns)], rows


def _cells(values: "dict[str, float] | dict[int, float]") -> list[str]:
    """Values with one digit, - for NaN."""
    return [f"{value:.1f}" if np.isfinite(value) else "-" for value in values.values()]


def written_table(heads: Sequence[str], rows: Iterable[Sequence[str]], format: str) -> str:
    """A table in Markdown or LaTeX (booktabs); the first column is text, the others are numbers."""
    if format == "markdown":
        lines = [heads, ["---", *["---:"] * (len(heads) - 1)], *rows]
        return "\n".join(f"| {' | '.join(_escaped(c, '|') for c in line)} |" for line in lines)
    head, *body = (
        " & ".join(_escaped(c, "%&_#$") for c in line) + r" \\" for line in (heads, *rows)
    )
    ends = (r"\begin{tabular}{l" + "r" * (len(heads) - 1) + "}", r"\end{tabular}")
    return "\n".join((ends[0], r"\toprule", head, r"\midrule", *body, r"\bottomrule", ends[1]))


def _escaped(text: str, special: str) -> str:
    """The text with a backslash before each `special` character."""
    return "".join(f"\\{letter}" if letter in special else letter for letter in text)
