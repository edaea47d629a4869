"""Measure a detector's persistent biases (`shapepose_fg/cameras/check/biases.py`) on a recording
with well-calibrated cameras.

    python scripts/measure_biases.py calibration.json detections [--up z]

Prints the maximum-likelihood sizes of the biases, as shares of a person's size: of a joint of one
person in one view, of shifts and scalings of whole people, and of the part that all people have in
common.
"""

from itertools import product
from pathlib import Path
from typing import Annotated

from typer import Option, Typer

from shapepose_fg.cameras.check.biases import COMMON
from shapepose_fg.cameras.check.evidence import SetupHypothesis, gather
from shapepose_fg.cameras.check.small_errors import SmallErrors
from shapepose_fg.core.bounds import Axis
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections

LEVELS = (0.0025, 0.005, 0.01, 0.02, 0.04)
RATIOS = (0.3, 1.0, 3.0)
"""Standard deviations of shifts and scalings, relative to that of a joint's bias."""


app = Typer(add_completion=False)


@app.command(help=__doc__)
def main(
    calibration: Path,
    detections: Path,
    up: Annotated[Axis | None, Option(help="World axis that points up, if unknown.")] = None,
) -> None:
    """Print the six most likely sizes of biases."""
    rig = read_rig(calibration, up=up)
    seen = read_detections(detections, rig)
    problem = SmallErrors.of(SetupHypothesis.given(gather(seen, range(len(seen)), len(rig)), rig))
    found = []
    for shift, larger in product(RATIOS, RATIOS):
        marginals = problem.residuals.marginals(problem.given, LEVELS, shift, larger, COMMON)
        for (level, common), each in zip(product(LEVELS, COMMON), marginals, strict=True):
            found.append((each.log, level, shift * level, larger * level, common * level))
    best = max(found)[0]
    print("log likelihood  joint  shift  enlargement  common")
    for log, *sizes in sorted(found, reverse=True)[:6]:
        print(f"{log - best:14.1f}", *(f"{size:8.4f}" for size in sizes))


if __name__ == "__main__":
    app()
