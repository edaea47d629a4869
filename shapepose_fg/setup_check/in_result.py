"""What a reconstruction says of its set-up: in run.json, in its summary, and as warnings."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.setup_check.camera_use import CameraUse, camera_use
from shapepose_fg.setup_check.changes import Kind
from shapepose_fg.setup_check.report import SetupReport, rounded

_MOST_BETA = 5.0
"""A shape component so many standard deviations from the mean is no person's."""
_SHARE = 0.1
"""Of so many rows: fewer are single people that hardly any camera saw."""
_WORST = 2.0
"""A camera whose joints are so many times as far from the others' as is usual is said, if nothing else is."""
_FAR_MM = 60.0


@dataclass(frozen=True)
class ResultCheck:
    """A set-up as a reconstruction shows it."""

    report: SetupReport
    """What cameras and detections say by themselves."""
    cameras: tuple[CameraUse, ...]
    """What became of each camera's detections."""
    warnings: tuple[str, ...]
    """Everything that looks wrong, a sentence each."""

    def as_run(self) -> dict[str, Any]:
        """What run.json holds: `setup` and `cameras`."""
        return {
            "setup": {**self.report.as_dict(), "warnings": list(self.warnings)},
            "cameras": [rounded(asdict(each)) for each in self.cameras],
        }


def result_check(
    report: SetupReport, people: Reconstruction, detections: DetectionSequence, rig: Rig, frames: range
) -> ResultCheck:
    """The check of a set-up with what the reconstruction adds to it."""
    uses = tuple(camera_use(people, detections, rig, frames))
    warnings = list(report.warnings)
    kinds = {finding.kind for finding in report.findings}
    if len(people) == 0 and Kind.NOBODY not in kinds:
        warnings.append(
            "Nobody was found; see what the check of the set-up says"
            if warnings
            else "Nobody was found; look with check-calibration whether cameras and detections fit"
        )
    warnings += _shapes(people)
    if len(report.findings) == 0:
        warnings += _outlier(uses)
    return ResultCheck(report, uses, tuple(warnings))


def _shapes(people: Reconstruction) -> list[str]:
    """Bodies of a shape that no person has."""
    there = np.isfinite(people.betas).all(axis=1)
    largest = np.abs(people.betas[there]).max(axis=1, initial=0.0)
    far = largest > _MOST_BETA
    if far.sum() == 0 or far.mean() < _SHARE:
        return []
    return [
        f"{far.sum()} of {len(far)} bodies have a shape that nobody has (a component of {largest.max():.0f}"
        " standard deviations); check the calibration's unit, and whether its poses are inverted"
    ]


def _outlier(uses: Sequence[CameraUse]) -> list[str]:
    """A camera that is much farther from the others than these are from each other."""
    lengths = np.array([np.nan if use.left_out.median_mm is None else use.left_out.median_mm for use in uses])
    if np.isfinite(lengths).sum() < 3:
        return []
    worst = int(np.nanargmax(lengths))
    usual = float(np.nanmedian(np.delete(lengths, worst)))
    if lengths[worst] < max(_WORST * usual, _FAR_MM):
        return []
    return [
        f"{uses[worst].camera} is {lengths[worst]:.0f} mm from where the other cameras put its joints (median),"
        f" they are {usual:.0f} mm from each other; look at its calibration and its pictures"
    ]
