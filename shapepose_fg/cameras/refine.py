"""Refines cameras by the people of a recording: alternating association and adjustment; held-out
validation.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from shapepose_fg.body.model.rotation import exp_so3
from shapepose_fg.cameras.bundle import (
    LENS,
    Adjusted,
    Freedom,
    Steps,
    halves,
    scaled,
    settle,
)
from shapepose_fg.cameras.check.diagnosis import correct_gross_mistakes
from shapepose_fg.cameras.check.evidence import gather
from shapepose_fg.cameras.check.findings import SURE, Finding, Kind
from shapepose_fg.cameras.check.small_errors import SmallErrors
from shapepose_fg.cameras.parameters import CENTRE, FOCAL, MOVE, TURN, Q, difference
from shapepose_fg.cameras.people import LEAST_PEOPLE, Footage, missed_px
from shapepose_fg.cameras.resection import ROUNDS
from shapepose_fg.cameras.stature import build_of
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.decompositions import rigid
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import FrameTimes

_UNKNOWN = 0.8
"""Ratio of posterior to prior standard deviation above which a parameter is undetermined."""

_BUMPED_DEG = 2.5
"""Rotation, degrees, above which a camera was bumped: its prior is then centred at the pose that
fits the others' people."""

PARTS = {"turn": TURN, "move": MOVE, "focal": FOCAL, "centre": CENTRE, "lens": LENS}
"""Parameters of a camera that may change."""
_UNITS = {"turn": float(np.degrees(1)), "move": 1e3, "focal": 100.0, "centre": 1.0}
"""Factors to degrees, millimetres, percent and pixels."""


@dataclass(frozen=True)
class Refinement:
    """The result of refining a rig."""

    given: Rig
    """The given cameras."""
    adjusted: Adjusted
    """The cameras adjusted to the people."""
    freedom: Freedom
    """Prior standard deviations of the cameras' parameters."""
    before_px: float
    """Median distance of a detection from the joint predicted by the other cameras only, on
    held-out frames, pixels; with the given cameras."""
    after_px: float
    """Median distance of a detection from the joint predicted by the other cameras only, on
    held-out frames, pixels; with cameras refined on the other half of the recording."""
    counts: Index
    """(V,) number of people, one per frame, from which each camera was adjusted."""
    notes: tuple[str, ...] = field(default=())
    """Notes on parameters that motion does not determine, a sentence each."""
    missed_px: tuple[Array, Array] = (np.zeros((0, 1)), np.zeros((0, 1)))
    """(N, V) distances of detections on held-out frames from joints predicted by the other cameras,
    with the given and the refined cameras; NaN if unknown."""
    stature_m: float = float("nan")
    """Median of the people's statures from their bones, in the adjusted cameras' metres."""
    probability: float = 1.0
    """Probability that the given cameras are wrong. The alternative is that the detector is biased,
    with biases common to frames of a person."""

    @property
    def better(self) -> bool:
        """Whether the refined cameras fit held-out people better, and no bias explains it."""
        return self.after_px < self.before_px and self.probability > SURE

    @property
    def rig(self) -> Rig:
        """The refined cameras if they are better, else the given ones."""
        return self.adjusted.rig if self.better else self.given

    def of_stature(self, stature_m: float) -> Rig:
        """Return `rig` scaled so that people have the median stature `stature_m`."""
        return scaled(self.rig, stature_m / self.stature_m, self.rig.centres.mean(axis=0))

    def change(self) -> dict[str, Array]:
        """(V,) change of each camera: rotation in degrees, translation in mm, focal length in %,
        principal point in pixels.
        """
        old, new = self.given, self.adjusted.rig
        turn, move = difference(old.cTw, new.cTw)
        focal = new.K[:, 0, 0] / old.K[:, 0, 0] - 1
        centre = np.linalg.norm(new.K[:, :2, 2] - old.K[:, :2, 2], axis=1)
        return {"turn": turn, "move": 1e3 * move, "focal": 100 * focal, "centre": centre}

    def sigma(self) -> dict[str, Array]:
        """(V,) standard deviations of what `change` gives, in the same units."""
        return {name: self.adjusted.sigma(PARTS[name]) * unit for name, unit in _UNITS.items()}

    def as_dict(self) -> dict[str, Any]:
        """All figures as plain values."""
        change, sigma = self.change(), self.sigma()
        cameras = [
            {
                "camera": camera.name,
                "people": int(self.counts[view]),
                **{name: round(float(change[name][view]), 4) for name in _UNITS},
                **{f"sigma_{name}": round(float(sigma[name][view]), 4) for name in _UNITS},
            }
            for view, camera in enumerate(self.given.cameras)
        ]
        held_out = {"before_px": round(self.before_px, 3), "after_px": round(self.after_px, 3)}
        about = {
            "better": self.better,
            "probability": round(self.probability, 4),
            "stature_m": round(self.stature_m, 3),
            "notes": list(self.notes),
        }
        return {"cameras": cameras, "held_out": held_out, **about}


def refine(
    detections: DetectionSequence,
    rig: Rig,
    times: FrameTimes,
    frames: range,
    freedom: Freedom | None = None,
    reference: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Refinement:
    """Refine the cameras of `rig`, with prior standard deviations `freedom`, from the people in
    `detections`.

    The scale is that of the given cameras. Raises Undetermined if too few people are seen by two
    cameras.
    """
    freedom = Freedom() if freedom is None else freedom
    given, right, findings = correct_gross_mistakes(gather(detections, frames, len(rig)), rig)
    footage, start = (
        Footage.of(detections, rig, times, frames),
        _found_again(findings, right.views, rig),
    )
    fit = partial(
        settle,
        now=start,
        rounds=ROUNDS,
        given=start,
        times=times,
        freedom=freedom,
        advance=Steps(progress, 3 * ROUNDS),
        reference=reference,
    )
    found = fit(footage)
    both = [
        [missed_px(people, each).reshape(-1, len(rig)) for each in (rig, half)]
        for half, people in halves(footage, fit)
    ]
    was_px, now_px = (np.concatenate(each) for each in zip(*both, strict=True))
    known = np.isfinite(was_px) & np.isfinite(now_px)
    missed = (np.where(known, was_px, np.nan), np.where(known, now_px, np.nan))
    if not known.any():
        raise InputError(
            "no joint is seen by three cameras in the frames for validation, so a refinement "
            "cannot be validated; give more frames"
        )
    was, now = (float(np.nanmedian(each)) for each in missed)
    counts = found.people.seen.any(axis=1).sum(axis=0)
    stature = build_of(found.people.points, detections.skeleton).stature
    notes = tuple(_undetermined(found, freedom, counts))
    sure = 1.0
    if np.array_equal(start.wTc, rig.wTc):
        sure = SmallErrors.of(given).off(freedom.sigmas[:Q], reference)
    return Refinement(rig, found, freedom, was, now, counts, notes, missed, stature, sure)


def _found_again(findings: list[Finding], found: Views, rig: Rig) -> Rig:
    """The rig; cameras misaligned by degrees are rotated to fit the people seen by the others."""
    kinds = (Kind.TURNED, Kind.MOVED, Kind.PRINCIPAL_POINT)
    turned = {view for each in findings if each.kind in kinds for view in each.cameras}
    wTc = rig.wTc
    for view in turned:
        K = rig.K[view]
        right, down = (found.K[view] - K)[:2, 2] / K[0, 0]  # similar to a rotation
        cTw = exp_so3(np.array([-down, right, 0.0])) @ found.cTw[view]
        if difference(cTw, rig.cTw[view])[0] > _BUMPED_DEG:
            wTc[view] = rigid(cTw[:, :3].T, -cTw[:, :3].T @ cTw[:, 3])
    return rig.at_poses(wTc)


def _undetermined(adjusted: Adjusted, freedom: Freedom, counts: Index) -> list[str]:
    """Parameters that the people do not determine, in words."""
    prior = {
        name: float(np.sqrt((freedom.sigmas[part] ** 2).sum())) for name, part in PARTS.items()
    }
    words = {
        "turn": "its rotation",
        "move": "its position",
        "focal": "its focal length",
        "centre": "its principal point",
        "lens": "its distortion",
    }
    notes = []
    for view, camera in enumerate(adjusted.rig.cameras):
        if counts[view] < LEAST_PEOPLE:
            shortage = f"shares only {counts[view]} people with other cameras, too few"
            notes.append(f"camera {camera.name}: {shortage}; it is not changed")
            continue
        sigmas = {name: adjusted.sigma(part)[view] for name, part in PARTS.items()}
        unknown = [
            words[name]
            for name in PARTS
            if prior[name] > 0 and sigmas[name] > _UNKNOWN * prior[name]
        ]
        if unknown:
            what = (
                f"the motion of the people determines {' or '.join(unknown)} no better than the "
                "prior"
            )
            cure = "film people who walk through the whole picture, near and far"
            notes.append(f"camera {camera.name}: {what}; {cure}")
    return notes
