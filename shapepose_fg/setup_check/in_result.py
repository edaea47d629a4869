"""What a reconstruction says of its set-up: what it used of each camera's detections, and what looks wrong."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.setup_check.findings import Kind
from shapepose_fg.setup_check.report import SetupReport, quantiles, rounded
from shapepose_fg.setup_check.sightings import size_of
from shapepose_fg.setup_check.structure import triangulate

Array = NDArray[np.float64]

_ROWS = 300
"""Rows that are enough to say how far a camera is from the others."""
_MOST_BETA = 5.0
"""A shape component so many standard deviations from the mean is no person's."""
_SHARE = 0.1
"""Of so many rows: fewer are single people that hardly any camera saw."""
_WORST = 2.0
"""A camera whose joints are so many times as far from the others' as is usual is said, if nothing else is."""
_FAR_MM = 60.0


@dataclass(frozen=True)
class Distances:
    """Distances of detections, in the picture and at the joint's depth."""

    count: int
    """How many."""
    median_px: float | None
    high_px: float | None
    """Median, and what nine of ten are below, pixels; None without any."""
    median_mm: float | None
    high_mm: float | None
    """The same as lengths, millimetres."""

    @classmethod
    def of(cls, px: Array, mm: Array) -> "Distances":
        """Of all finite distances `px` and `mm`, arrays of one shape."""
        finite = np.isfinite(px) & np.isfinite(mm)
        return cls(int(finite.sum()), *quantiles(px[finite], 0.5, 0.9), *quantiles(mm[finite], 0.5, 0.9))


@dataclass(frozen=True)
class CameraUse:
    """What became of one camera's detections."""

    camera: str
    """Its name."""
    offered: int
    """Joint detections in the frames that were reconstructed."""
    used: int
    """Those that a result was solved from."""
    given: Distances
    """All that were given to people, before gates: from the solved joint."""
    after_gates: Distances
    """Those that were used."""
    left_out: Distances
    """All that were given to people: from where the other cameras alone put the joint."""


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
    if len(people) == 0 and Kind.NOBODY not in {finding.kind for finding in report.findings}:
        warnings.append(
            "Nobody was found; see what the check of the set-up says"
            if warnings
            else "Nobody was found; look with check-calibration whether cameras and detections fit"
        )
    warnings += _shapes(people)
    if len(report.findings) == 0:
        warnings += _outlier(uses)
    return ResultCheck(report, uses, tuple(warnings))


def camera_use(people: Reconstruction, detections: DetectionSequence, rig: Rig, frames: range) -> list[CameraUse]:
    """One entry for each camera; without observations in the result, an empty list."""
    table = people.observations
    if table is None:
        return []
    offered = np.sum(
        [np.bincount(detections[frame].view, minlength=len(rig)) for frame in frames], axis=0, dtype=int
    )
    depth = np.moveaxis(rig.project(people.joints)[1], 0, 2)
    px = np.linalg.norm(table.residual_px.astype(np.float64), axis=-1)
    mm = 1e3 * px * depth / rig.focal_px
    used = table.gate == Gate.USED
    out_px, out_mm = _left_out(table, rig)
    return [
        CameraUse(
            name,
            int(offered[view]),
            int(used[..., view].sum()),
            Distances.of(px[..., view], mm[..., view]),
            Distances.of(px[..., view][used[..., view]], mm[..., view][used[..., view]]),
            Distances.of(out_px[..., view], out_mm[..., view]),
        )
        for view, name in enumerate(rig.names)
    ]


def _left_out(table: ObservationTable, rig: Rig) -> tuple[Array, Array]:
    """(N, J, V) distance of each detection to where the others' used ones put the joint, pixels and millimetres.

    Of rows spread over the result; NaN where fewer than two others saw the joint.
    """
    rows = np.unique(np.linspace(0, len(table) - 1, min(len(table), _ROWS)).astype(np.intp))
    xy, gate = table.xy[rows].astype(np.float64), table.gate[rows]
    confidence, size = table.confidence[rows].astype(np.float64), size_of(np.moveaxis(xy, 2, 1))
    px, mm, views = np.full(gate.shape, np.nan), np.full(gate.shape, np.nan), Views.of(rig)
    for view in range(len(rig)):  # a handful of cameras
        rest = (gate == Gate.USED) & (np.arange(len(rig)) != view)
        kept = np.where(rest[..., None], xy, np.nan)
        structure = triangulate(kept, np.where(rest, confidence, 0.0), size, views, steps=3)
        at, depth = (each[view] for each in rig.project(structure.points))
        px[..., view] = np.linalg.norm(at - xy[..., view, :], axis=-1)
        mm[..., view] = 1e3 * px[..., view] * depth / rig.focal_px[view]
    return px, mm


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
    lengths = np.array([use.left_out.median_mm for use in uses], dtype=np.float64)  # None is NaN
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
