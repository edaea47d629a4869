"""The figures of a report: what became of each camera's detections, and how joints are known."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Known, Reconstruction

_BINS = 60
"""Points of a line over time: as many as can be told apart in a cell of a table."""
KINDS = (Known.SEEN, Known.WEAK, Known.BODY, Known.MOTION, Known.UNKNOWN)
"""The ways in which joints are known, the surest first."""
REASONS = tuple(gate for gate in Gate if gate not in (Gate.NOT_SEEN, Gate.USED))
"""Why a detection may not be used."""


@dataclass(frozen=True)
class Residual:
    """Distances of projected joints to their detections, pixels."""

    median_px: float | None
    """Half of them are nearer; None where there are none."""
    high_px: float | None
    """Nine of ten are nearer."""

    @classmethod
    def of(cls, px: NDArray[np.floating]) -> "Residual":
        """Of all finite distances in `px`."""
        px = px[np.isfinite(px)]
        if len(px) == 0:
            return cls(None, None)
        median, high = np.quantile(px, [0.5, 0.9]).tolist()
        return cls(median, high)


@dataclass(frozen=True)
class CameraFigures:
    """What became of one camera's detections."""

    name: str
    """Its name."""
    given: int
    """Detections that were given to people."""
    gates: dict[Gate, int]
    """How many of them were used, and how many were not for which reason."""
    all: Residual
    """Of all that were given to people."""
    used: Residual
    """Of those that were used."""
    trend_px: list[float | None]
    """Median over time of all that were given to people: equal stretches of the recording."""
    offered: float | None = None
    """Detections in all, given to people or not; None where run.json does not say."""
    left_out_px: float | None = None
    """Median distance to where the other cameras alone put the joint; None where run.json does not say."""
    left_out_mm: float | None = None
    """The same as a length at the joint's depth."""


def camera_figures(people: Reconstruction) -> list[CameraFigures]:
    """One entry for each camera; none where the result has no observations."""
    table = people.observations
    if table is None:
        return []
    px = np.linalg.norm(table.residual_px, axis=-1)
    stretch = _stretches(table)
    told = _told_cameras(people.run)
    made = []
    for view, name in enumerate(table.view_names.tolist()):  # a handful of cameras
        gate, error = table.gate[..., view], px[..., view]
        more = told.get(name, {})
        left_out = more.get("left_out")
        left_out = left_out if isinstance(left_out, dict) else {}
        made.append(
            CameraFigures(
                name,
                int((gate != Gate.NOT_SEEN).sum()),
                {each: int((gate == each).sum()) for each in (Gate.USED, *REASONS)},
                Residual.of(error),
                Residual.of(error[gate == Gate.USED]),
                [Residual.of(error[stretch == index]).median_px for index in range(stretch.max(initial=-1) + 1)],
                number(more.get("offered")),
                number(left_out.get("median_px")),
                number(left_out.get("median_mm")),
            )
        )
    return made


def number(value: object) -> float | None:
    """A finite number of run.json; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        return None
    return float(value)


def known_counts(people: Reconstruction, by: NDArray[np.integer] | None = None) -> NDArray[np.int64]:
    """How many joints are known in each of `KINDS`: (J, 5) by joint, or (G, 5) by groups `by` (N,) of the rows."""
    kinds = people.known[..., None] == np.array(KINDS)
    if by is None:
        return kinds.sum(axis=0)
    counts = np.zeros((int(by.max(initial=-1)) + 1, len(KINDS)), dtype=np.int64)
    np.add.at(counts, by, kinds.sum(axis=1))
    return counts


def _stretches(table: ObservationTable) -> NDArray[np.intp]:
    """(N,) which stretch of the recording each row is in."""
    if len(table) == 0:
        return np.zeros(0, dtype=np.intp)
    first, last = int(table.frame.min()), int(table.frame.max())
    bins = min(_BINS, last - first + 1)
    return np.asarray((table.frame - first) * bins // (last - first + 1), dtype=np.intp)


def _told_cameras(run: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """What run.json says of the cameras, by name; anything that is not such a list says nothing."""
    told = run.get("cameras", [])
    entries = [each for each in told if isinstance(each, dict)] if isinstance(told, list) else []
    return {str(each.get("camera")): each for each in entries}
