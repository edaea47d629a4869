"""The check of a set-up as one value: what is wrong in words, and the figures; for run.json and the terminal."""

from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.setup_check.diagnosis import Diagnosis, diagnose
from shapepose_fg.setup_check.evidence import Look
from shapepose_fg.setup_check.findings import Finding, sentence
from shapepose_fg.setup_check.fit import match
from shapepose_fg.setup_check.matching import GATE, residuals

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CameraFigures:
    """How one camera fits the others. Lengths are at the joints' depth."""

    camera: str
    """Its name."""
    people: int
    """People that it saw in the frames that were looked at."""
    matched: float
    """Share of them that another camera sees too."""
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
    """Share of the people seen by the others that the camera could match and does match."""
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


@dataclass(frozen=True)
class SetupReport:
    """What is wrong with a set-up, and how its cameras fit."""

    findings: tuple[Finding, ...]
    """One after the other, gross mistakes first; none where nothing is wrong."""
    warnings: tuple[str, ...]
    """The same in words, a sentence each."""
    cameras: tuple[CameraFigures, ...]
    """By camera, as the set-up was given."""
    pairs: tuple[PairFigures, ...]
    """By pair of cameras."""
    frames: int
    """Frames that were looked at."""
    stature_m: float | None
    """How tall the people come out, median; None without people."""

    def as_dict(self) -> dict[str, Any]:
        """What run.json holds under `setup`."""
        names = [each.camera for each in self.cameras]
        return {
            "findings": [
                {"kind": str(each.kind), "cameras": [names[view] for view in each.cameras], "says": words}
                for each, words in zip(self.findings, self.warnings, strict=True)
            ],
            "cameras": [rounded(asdict(each)) for each in self.cameras],
            "pairs": [rounded(asdict(each)) for each in self.pairs],
            "frames_looked_at": self.frames,
            "stature_m": None if self.stature_m is None else round(self.stature_m, 4),
        }


def check_setup(
    detections: DetectionSequence, rig: Rig, frames: range | None = None, more: tuple[Finding, ...] = ()
) -> SetupReport:
    """Whether cameras and detections of a recording fit each other, and what it looks like where they do not.

    Looks at frames spread over `frames` (all by default) and needs no reconstruction; takes about a second. `more`
    was found by others.
    """
    diagnosis = diagnose(detections, rig, frames)
    findings, build = (*diagnosis.findings, *more), diagnosis.build
    return SetupReport(
        findings,
        tuple(sentence(finding, rig) for finding in findings),
        _camera_figures(diagnosis, rig),
        tuple(_pair_figures(diagnosis.look, rig, *pair) for pair in combinations(range(len(rig)), 2)),
        len(diagnosis.look.evidence.anchors),
        build.stature if build is not None and build.count > 0 else None,
    )


def _camera_figures(diagnosis: Diagnosis, rig: Rig) -> tuple[CameraFigures, ...]:
    """One entry for every camera."""
    look = diagnosis.look
    groups, structure = look.structure(steps=5)
    px = np.linalg.norm(structure.residual, axis=-1)
    mm = 1e3 * px * structure.depth / look.setup.views.focal_px
    seen = np.bincount(look.sightings.view, minlength=len(rig))
    remaining = [lag.frames if lag.is_offset else 0 for lag in diagnosis.lags] or [0] * len(rig)
    late = diagnosis.corrected.setup.lag + remaining  # what was found, and what remains
    found = []
    for view, name in enumerate(rig.names):
        others, mine, camera = look.others(view), look.seen_by(view), look.setup.camera(view)
        matched = match(others, mine, camera)
        points = others.points[matched.person]
        out_px = np.linalg.norm(residuals(points, mine.xy[matched.sighting], camera.K, camera.cTw), axis=-1)
        depth = points @ camera.cTw[2, :3] + camera.cTw[2, 3]
        out_px = np.where(np.isfinite(out_px), out_px, np.nan)
        figures = CameraFigures(
            name,
            int(seen[view]),
            float((groups.member[:, view] >= 0).sum() / max(seen[view], 1)),
            *quantiles(px[..., view], 0.5, 0.9),
            *quantiles(mm[..., view], 0.5, 0.9),
            *quantiles(out_px, 0.5),
            *quantiles(1e3 * out_px * depth / look.setup.views.focal_px[view], 0.5),
            float(len(matched.person) / max(matched.possible, 1)),
            int(late[view]),
        )
        found.append(figures)
    return tuple(found)


def _pair_figures(look: Look, rig: Rig, first: int, second: int) -> PairFigures:
    names = rig.names[first], rig.names[second]
    groups, error, possible = look.pair(first, second)
    if possible == 0:
        return PairFigures(*names, None, None)
    miss = error * look.sightings.size_px[groups.member[:, first]]
    return PairFigures(*names, float((error < GATE / 2).sum() / possible), *quantiles(miss, 0.5))


def quantiles(values: Array, *parts: float) -> list[float | None]:
    """Of the finite ones; None where there are none."""
    values = values[np.isfinite(values)]
    return [float(np.quantile(values, part)) if len(values) > 0 else None for part in parts]


def rounded(value: Any) -> Any:
    """Floats with four digits, which are enough for run.json, in all objects within."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    return float(f"{value:.4g}") if isinstance(value, float) else value
