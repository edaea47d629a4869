"""Measure a detector's lasting biases (`shapepose_fg/cameras/check/biases.py`) on a recording with
well-calibrated cameras.

    python scripts/measure_biases.py calibration.json detections [--up z]

Prints the maximum-likelihood sizes of the biases, as shares of a person's size: of a joint of one
person in one view, of shifts and scalings of whole people, and of the part that all people have in
common.
"""

import argparse
from itertools import product
from pathlib import Path

from shapepose_fg.cameras.check.biases import COMMON, LEVELS
from shapepose_fg.cameras.check.evidence import Look, gather
from shapepose_fg.cameras.check.small_errors import Problem
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections

RATIOS = (0.3, 1.0, 3.0)
"""Standard deviations of shifts and scalings, relative to that of a joint's bias."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("calibration", type=Path)
    parser.add_argument("detections", type=Path)
    parser.add_argument("--up", help="the axis that is up, where the calibration does not say it")
    arguments = parser.parse_args()
    rig = read_rig(arguments.calibration, up=arguments.up)
    detections = read_detections(arguments.detections, rig)
    problem = Problem.of(Look.given(gather(detections, range(len(detections)), len(rig)), rig))
    found, levels = [], [level / 2 for level in LEVELS]
    for shift, larger in product(RATIOS, RATIOS):
        marginals = problem.residuals.marginals(problem.given, levels, shift, larger, COMMON)
        for (level, common), each in zip(product(levels, COMMON), marginals, strict=True):
            found.append((each.log, level, shift * level, larger * level, common * level))
    best = max(found)[0]
    print("log likelihood  joint  shift  enlargement  common")
    for log, *sizes in sorted(found, reverse=True)[:6]:
        print(f"{log - best:14.1f}", *(f"{size:8.4f}" for size in sizes))


if __name__ == "__main__":
    main()
