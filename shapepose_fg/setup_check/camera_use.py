"""What a reconstruction used of each camera's detections, and how far they are from the result."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.setup_check.sightings import size_of
from shapepose_fg.setup_check.structure import triangulate

Array = NDArray[np.float64]

_WIDE = 12
"""Longest name of a camera that is written out; of a longer one the end is, which tells cameras apart."""
_ROWS = 300
"""Rows that are enough to say how far a camera is from the others."""


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
        """Of all finite distances px (N,) and mm (N,)."""
        finite = np.isfinite(px) & np.isfinite(mm)
        if not finite.any():
            return cls(0, None, None, None, None)
        quantiles = [float(np.quantile(each[finite], part)) for each in (px, mm) for part in (0.5, 0.9)]
        return cls(int(finite.sum()), *quantiles)


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


def camera_use(people: Reconstruction, detections: DetectionSequence, rig: Rig, frames: range) -> list[CameraUse]:
    """One entry for each camera; without observations in the result, an empty list."""
    table = people.observations
    if table is None:
        return []
    offered = np.zeros(len(rig), dtype=np.int64)
    for frame in frames:
        offered += np.bincount(detections[frame].view, minlength=len(rig))
    views = Views.of(rig)
    depth = np.moveaxis(rig.project(people.joints)[1], 0, 2)
    px = np.linalg.norm(table.residual_px.astype(np.float64), axis=-1)
    mm = 1e3 * px * depth / views.focal_px
    used = table.gate == Gate.USED
    out_px, out_mm = _left_out(table, rig)
    return [
        CameraUse(
            name,
            int(offered[view]),
            int(used[..., view].sum()),
            Distances.of(px[..., view].ravel(), mm[..., view].ravel()),
            Distances.of(px[..., view][used[..., view]], mm[..., view][used[..., view]]),
            Distances.of(out_px[..., view].ravel(), out_mm[..., view].ravel()),
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
    px, mm = np.full(gate.shape, np.nan), np.full(gate.shape, np.nan)
    views = Views.of(rig)
    for view in range(len(rig)):  # a handful of cameras
        rest = (gate == Gate.USED) & (np.arange(len(rig)) != view)
        kept = np.where(rest[..., None], xy, np.nan)
        structure = triangulate(kept, np.where(rest, confidence, 0.0), size, views, steps=3)
        at, depth = (each[view] for each in rig.project(structure.points))
        px[..., view] = np.linalg.norm(at - xy[..., view, :], axis=-1)
        mm[..., view] = 1e3 * px[..., view] * depth / views.focal_px[view]
    return px, mm


def use_table(uses: Sequence[CameraUse]) -> Table:
    """A row for each camera, for a terminal of 80 columns."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    heads = ("camera", "offered", "used", "error px", "mm", "used px", "left out px", "mm")
    for name in heads:
        table.add_column(name, justify="left" if name == "camera" else "right", no_wrap=True)
    for each in uses:
        table.add_row(
            short(each.camera),
            f"{each.offered}",
            f"{100 * each.used / max(each.offered, 1):.0f} %",
            _both(each.given.median_px, each.given.high_px),
            _both(each.given.median_mm, each.given.high_mm),
            _both(each.after_gates.median_px, each.after_gates.high_px),
            f"{_two(each.left_out.median_px)}",
            f"{_two(each.left_out.median_mm)}",
        )
    return table


def short(name: str) -> str:
    """A camera's name, its end where it is long."""
    return name if len(name) <= _WIDE else f"…{name[1 - _WIDE :]}"


def _both(median: float | None, high: float | None) -> str:
    return f"{_two(median)} / {_two(high)}" if median is not None else "-"


def _two(value: float | None) -> str:
    """A figure with two digits."""
    if value is None:
        return "-"
    return f"{value:.1f}" if value < 9.95 else f"{value:.0f}"
