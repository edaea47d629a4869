"""The numbers of a report: each camera's detections, how joints are known, and the five key
figures.
"""

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.biomechanics.joint_angles import NAMES, JointAngles, joint_angles
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.arrays import Array, Index, Mask, Real, Whole
from shapepose_fg.core.camera import Axis
from shapepose_fg.core.frame_times import ASSUMED_FPS
from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Known, Reconstruction, sigma_m
from shapepose_fg.core.run_summary import CameraEntry, covered_frames
from shapepose_fg.viz.report.facts import entries_of

KINDS = (Known.SEEN, Known.WEAK, Known.BODY, Known.MOTION, Known.UNKNOWN)
"""How joints are known, from the most to the least certain."""


@dataclass(frozen=True)
class Residual:
    """Distances of projected joints to their detections, pixels."""

    median_px: float | None
    """Median; None without distances."""
    high_px: float | None
    """90th percentile; None without distances."""

    @classmethod
    def of(cls, px: Real) -> "Residual":
        """Compute median and 90th percentile of the finite distances `px`."""
        px = px[np.isfinite(px)]
        return cls(*np.quantile(px, [0.5, 0.9]).tolist()) if len(px) > 0 else cls(None, None)


@dataclass(frozen=True)
class Curve:
    """An angle of both sides over time, as SVG paths in a box of 200 x 60."""

    name: str
    """Name of the angle."""
    low: float
    """Smallest angle of both sides, degrees."""
    high: float
    """Largest angle of both sides, degrees."""
    lines: tuple[str, ...]
    """Path of the right side, and of the left one."""
    bands: tuple[str, ...]
    """Bands of two standard deviations around each path."""
    frames: tuple[int, int]
    """The first and the last frame that are drawn."""

    @classmethod
    def of(cls, name: str, angles: JointAngles, frame: Whole) -> "Curve":
        """Draw `name` of rows in the increasing frames `frame` (N,)."""
        places = [NAMES.index(f"{side}_{name}") for side in ("right", "left")]
        middle, spread = angles.degrees[:, places], 2 * np.nan_to_num(angles.sigma[:, places])
        margin = max(5.0, float(np.median(spread)))  # single uncertain frames are cut off
        low, high = float(np.nanmin(middle)), float(np.nanmax(middle))
        x = 200 * (frame - frame[0]) / max(float(np.ptp(frame)), 1)

        def path(values: Array, x: Array) -> str:
            y = (60 * (high + margin - values) / (high - low + 2 * margin)).clip(0, 60)
            pairs = zip(x.tolist(), y.tolist(), strict=True)
            return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in pairs if b == b)

        lines = tuple(path(each, x) for each in middle.T)
        bands = tuple(
            path(np.concatenate([each + two, (each - two)[::-1]]), np.concatenate([x, x[::-1]]))
            for each, two in zip(middle.T, spread.T, strict=True)
        )
        ends = int(frame[0]), int(frame[-1])
        return cls(name.replace("_", " "), low, high, lines, bands, ends)


@dataclass(frozen=True)
class CameraStatistics:
    """Statistics of one camera's detections."""

    name: str
    """Name of the camera."""
    given: int
    """Number of detections that were assigned to people."""
    gates: dict[Gate, int]
    """Number of assigned detections by gate: used, or the reason why not."""
    all: Residual
    """Residuals of all detections that were assigned to people."""
    used: Residual
    """Residuals of the detections that were used."""
    trend_px: list[float | None]
    """Time series: median residual of all assigned detections, in equal segments of the
    recording."""
    offered: int | None = None
    """Number of all detections, assigned or not; None if run.json does not have it."""
    left_out_px: float | None = None
    """Median distance to the joint as estimated without this camera, pixels; None if run.json does
    not have it."""
    left_out_mm: float | None = None
    """Median of the same distances as lengths at the joint's depth, mm; None if run.json does not
    have it."""


def camera_figures(people: Reconstruction) -> list[CameraStatistics]:
    """One entry for each camera; empty if the result has no observations."""
    table = people.observations
    if table is None:
        return []
    px, segment = np.linalg.norm(table.residual_px, axis=-1), _segments(table)
    entries = {each.camera: each for each in entries_of(people.run).cameras}
    made = []
    for view, name in enumerate(table.view_names.tolist()):  # only a few cameras
        gate, error = table.gate[..., view], px[..., view]
        more = entries.get(name, CameraEntry())
        made.append(
            CameraStatistics(
                name,
                int((gate != Gate.NOT_SEEN).sum()),
                {each: int((gate == each).sum()) for each in Gate if each != Gate.NOT_SEEN},
                Residual.of(error),
                Residual.of(error[gate == Gate.USED]),
                [
                    Residual.of(error[segment == index]).median_px
                    for index in range(segment.max(initial=-1) + 1)
                ],
                more.offered,
                more.left_out.median_px,
                more.left_out.median_mm,
            )
        )
    return made


def overall(people: Reconstruction) -> dict[str, Any]:
    """The key figures of a result, by the names in the template; shares are 0 to 1, None if
    undefined.
    """
    table, known = people.observations, people.known[people.known != Known.UNKNOWN]
    sigma = sigma_m(people.covariance)
    sigma = sigma[np.isfinite(sigma)]
    spans = [np.arange(span.start, span.stop) for span in covered_frames(people.run) or []]
    gate = np.zeros(0) if table is None else table.gate[table.gate != Gate.NOT_SEEN]
    cameras = entries_of(people.run).cameras
    counts = [each.offered for each in cameras if each.offered is not None]
    offered = sum(counts) if 0 < len(counts) == len(cameras) else None
    count = sum(each.used for each in cameras)
    return {
        "placed": bool(np.isfinite(people.joints).all(axis=-1).any()),
        "seen": _share(known == Known.SEEN),
        "error": Residual.of(
            np.zeros(0) if table is None else np.linalg.norm(table.residual_px, axis=-1)
        ),
        "used": _share(gate == Gate.USED) if offered is None else min(count / max(offered, 1), 1.0),
        "used_of_given": None if offered is None else _share(gate == Gate.USED),
        "sigma_mm": 1e3 * float(np.median(sigma)) if len(sigma) > 0 else None,
        "solved": _share(people.status == "ok"),
        "rows": len(people),
        "people": len(np.unique(people.person)),
        "frames": len(np.unique(np.concatenate([people.frame, *spans]))),
        "status": ", ".join(
            f"{count} {name}" for name, count in Counter(people.status.tolist()).items()
        ),
    }


CURVES = (
    "hip_flexion", "hip_adduction", "knee_flexion", "ankle_flexion", "shoulder_elevation",
    "elbow_flexion",
)  # fmt: skip
"""Angles that the report draws, of both sides."""


def angle_curves(people: Reconstruction, up: Axis, model: BodyModel) -> dict[int, list[Curve]]:
    """The curves of the people with the most rows, by number of the person."""
    numbers, counts = np.unique(people.person, return_counts=True)
    drawn = dict[int, list[Curve]]()
    chosen = np.sort(numbers[np.argsort(-counts, kind="stable")[:8]]).tolist()
    # Maximum number of rows of a person, so that the page stays small and quick to make: 2 ms per
    # row. Of longer recordings the beginning is drawn: steps over 0.15 s would not show a gait.
    most, times_s = 640 // max(len(chosen), 1), people.time_s
    times_s = np.where(np.isfinite(times_s), times_s, people.frame / ASSUMED_FPS)
    for person in chosen:
        rows = np.flatnonzero(people.person == person)
        rows = rows[np.argsort(people.frame[rows], kind="stable")]
        longest = max(1, int(0.15 * len(rows) / max(float(np.ptp(times_s[rows])), 0.15)))
        rows = rows[:: min(-(-len(rows) // most), longest)][:most]
        angles = joint_angles(people.rows(rows), up, model)
        drawn[person] = [
            Curve.of(name, angles, people.frame[rows])
            for name in CURVES
            if np.isfinite(angles.degrees).any()
        ]
    return {person: curves for person, curves in drawn.items() if curves}


def known_counts(people: Reconstruction, by: Whole | None = None) -> NDArray[np.int64]:
    """Number of joints in each of `KINDS`: (J, 5) by joint, or (G, 5) by groups `by` (N,) of the
    rows.
    """
    kinds = people.known[..., None] == np.array(KINDS)
    if by is None:
        return kinds.sum(axis=0)
    counts = np.zeros((int(by.max(initial=-1)) + 1, len(KINDS)), dtype=np.int64)
    np.add.at(counts, by, kinds.sum(axis=1))
    return counts


def _share(true: Mask) -> float | None:
    return float(true.mean()) if true.size > 0 else None


def _segments(table: ObservationTable) -> Index:
    """(N,) segment of the recording of each row."""
    if len(table) == 0:
        return np.zeros(0, dtype=np.intp)
    first, last = int(table.frame.min()), int(table.frame.max())
    # Number of points of a time series: as many as can be distinguished in a table cell.
    bins = min(60, last - first + 1)
    return np.asarray((table.frame - first) * bins // (last - first + 1), dtype=np.intp)
