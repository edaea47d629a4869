"""Figures of a set-up as it is given: by camera, and by pair of cameras."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.setup_check.diagnosis import Diagnosis
from shapepose_fg.setup_check.evidence import Look
from shapepose_fg.setup_check.fit import match, possible_matches
from shapepose_fg.setup_check.lag import is_offset
from shapepose_fg.setup_check.matching import GATE, errors_of, group, residuals

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CameraFigures:
    """How one camera fits the others. Lengths are at the joints' depth."""

    camera: str
    """Its name."""
    people: int
    """People that it saw in the frames that were looked at."""
    matched: float
    """Share of them who are somebody whom another camera sees too."""
    median_px: float | None
    """Median distance of a projected joint to its detection, all that were matched, pixels."""
    high_px: float | None
    """Nine of ten are nearer."""
    median_mm: float | None
    """The same median as a length."""
    high_mm: float | None
    """Nine of ten are nearer."""
    left_out_px: float | None
    """Median distance to where the other cameras alone put the joint, pixels."""
    left_out_mm: float | None
    """The same as a length."""
    left_out_matched: float
    """Share of the people whom the others see and the camera could match that it does match."""
    late_frames: int
    """Frames by which it is late against the others; negative: early."""


@dataclass(frozen=True)
class PairFigures:
    """How two cameras fit each other."""

    first: str
    second: str
    """Their names."""
    matched: float | None
    """Share of the people that both could see who fit; None where they never see anybody at once."""
    miss_px: float | None
    """Median distance by which the rays to one joint miss each other, pixels of the first camera's picture."""


def camera_figures(diagnosis: Diagnosis, rig: Rig) -> tuple[CameraFigures, ...]:
    """One entry for every camera."""
    look = diagnosis.look
    groups, structure = look.structure(steps=5)
    distance = np.linalg.norm(structure.residual, axis=-1)
    distance = np.where(np.isfinite(distance), distance, np.nan)
    length = 1e3 * distance * structure.depth / look.setup.views.focal_px
    seen = np.bincount(look.sightings.view, minlength=len(rig))
    late = _late(diagnosis, len(rig))
    return tuple(
        _camera_figures(
            look, view, name, int(seen[view]), groups.member[:, view], distance[..., view], length[..., view], late
        )
        for view, name in enumerate(rig.names)
    )


def _camera_figures(
    look: Look, view: int, name: str, seen: int, member: NDArray[np.intp], px: Array, mm: Array, late: list[int]
) -> CameraFigures:
    others, mine, camera = look.others(view), look.seen_by(view), look.setup.camera(view)
    found = match(others, mine, camera)
    points = others.points[found.person]
    out_px = np.linalg.norm(residuals(points, mine.xy[found.sighting], camera.K, camera.cTw), axis=-1)
    out_px = np.where(np.isfinite(out_px), out_px, np.nan)
    depth = (points @ camera.cTw[:, :3].T + camera.cTw[:, 3])[..., 2]
    out_mm = 1e3 * out_px * depth / look.setup.views.focal_px[view]
    return CameraFigures(
        name,
        seen,
        float((member >= 0).sum() / max(seen, 1)),
        _quantile(px, 0.5),
        _quantile(px, 0.9),
        _quantile(mm, 0.5),
        _quantile(mm, 0.9),
        _quantile(out_px, 0.5),
        _quantile(out_mm, 0.5),
        float(len(found.person) / max(found.possible, 1)),
        late[view],
    )


def pair_figures(look: Look, names: Sequence[str]) -> tuple[PairFigures, ...]:
    """One entry for every pair of cameras."""
    return tuple(_pair_figures(look, names, a, b) for a, b in combinations(range(len(names)), 2))


def _pair_figures(look: Look, names: Sequence[str], first: int, second: int) -> PairFigures:
    groups = group(look.pairs, len(look.sightings), (first, second))
    seen = look.sightings
    possible = possible_matches(*(seen.frame[seen.view == view] for view in (first, second)))
    if possible == 0:
        return PairFigures(names[first], names[second], None, None)
    error = errors_of(look.pairs, groups, first, second)
    miss = error * seen.size_px[groups.member[:, first]]
    return PairFigures(
        names[first], names[second], float((error < GATE / 2).sum() / possible), _quantile(miss, 0.5)
    )


def _late(diagnosis: Diagnosis, views: int) -> list[int]:
    """Frames by which each camera is late, what was found and what remains together."""
    left = [lag.frames if is_offset(lag) else 0 for lag in diagnosis.lags] or [0] * views
    return [int(found) + more for found, more in zip(diagnosis.corrected.setup.lag.tolist(), left, strict=True)]


def _quantile(values: Array, part: float) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.quantile(values, part)) if len(values) > 0 else None


def plain(figures: Sequence[CameraFigures] | Sequence[PairFigures]) -> list[dict[str, Any]]:
    """As run.json holds them: numbers with four digits are enough."""
    return [
        {key: float(f"{value:.4g}") if isinstance(value, float) else value for key, value in asdict(each).items()}
        for each in figures
    ]
