"""What is wrong with a set-up: one finding after the other, gross mistakes first."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.setup_check.changes import Change, Kind, gross_mistake, lag_of, lags, latest
from shapepose_fg.setup_check.duplicates import Duplicate, duplicates
from shapepose_fg.setup_check.evidence import Evidence, Look, Setup, gather
from shapepose_fg.setup_check.lag import Lag
from shapepose_fg.setup_check.people import Build, build_of
from shapepose_fg.setup_check.small import SHIFT, SmallErrors, other_pose, small_errors, with_small_errors

Array = NDArray[np.float64]

_MOST_FINDINGS = 4
"""More mistakes than this are not told apart."""
_UNFIT = 0.15
"""A camera that fits the others' people no better, and nothing explains it, does not fit."""
MIN_SIGHTINGS = 20
"""With fewer people seen, nothing is said of a camera."""
_OFF_DEG, _OFF_FOCAL = 0.45, 0.04
"""Turns and focal lengths that are named where people tell them surely. In simulated recordings without any error
few come out larger (docs/setup_checks.md)."""
_SURE, _SIGMAS = 1.2, 2.2
"""How many sigmas make sure of a turn (the sparse prior shrinks it; a roll needs twice as many: a detector's
errors left and right of a body look like one), and of a focal length."""
_MOST_COST = 0.86
"""Small errors that leave more than this of the residuals' cost are the detector's."""
_OUTLIER_DEG, _OUTLIER_RATIO = 0.8, 1.5
"""Where several cameras have small errors, one that is off by so much, and so many times the next, is turned."""
_NOTABLE_DEG = 0.25
_LEAST_GAIN = 0.02
"""Where no pose of one camera takes away so much of the residuals' cost, none is tried."""
_POSE_GAIN = 0.04
"""Another pose of one camera, six numbers, is named where it leaves so much less of the residuals' cost than small
errors of all cameras do."""
_SINGLE = 0.7
"""One camera is said to be turned where it alone explains so much of what small errors of all cameras explain."""
_TURN_DEG = 0.6
"""Less is said of the principal point: of a calibration, and not of a camera that was knocked."""
_NOBODY = 0.05
"""With fewer people than this for each sighting, cameras see no people in common."""
_LAG_ROUNDS, _LAG_NEAR = 6, 8
_PLAIN_TURN_DEG = 3.0
"""A camera that is turned by more is called turned, wherever it is."""
_SHORTEST, _TALLEST = 0.9, 2.4
"""Median statures, metres, outside of which it is the calibration's unit and not the people."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a set-up."""

    kind: Kind
    """What it looks like."""
    cameras: tuple[int, ...]
    """Cameras that it is about; none where it is about people, all where all share it."""
    amount: float = 0.0
    """Degrees, frames (positive is late), the factor of a focal length or picture, the stature in metres."""
    shift_px: tuple[tuple[float, float], ...] = ()
    """For each camera, how far its principal point seems to be off: right and down, pixels."""
    moved: float = 0.0
    """How far the camera was moved, metres."""
    axis: str = ""
    """The axis that is up for the people."""
    duplicate: Duplicate | None = None
    """Which two cameras are one."""


@dataclass(frozen=True)
class Diagnosis:
    """Everything that the check found, and what it was made of."""

    findings: tuple[Finding, ...]
    look: Look
    """The set-up as it was given."""
    corrected: Look
    """The set-up with the findings put right, but for small errors."""
    small: SmallErrors | None
    """Small errors of all cameras that remain after that; None with too few people."""
    lags: tuple[Lag, ...] = field(default=())
    """Each camera's offset in time that remains."""
    build: Build | None = None
    """The people, in the corrected set-up."""


def diagnose(detections: DetectionSequence, rig: Rig, frames: range | None = None) -> Diagnosis:
    """What is wrong with cameras and detections of a recording, all of its `frames` by default."""
    evidence = gather(detections, range(len(detections)) if frames is None else frames)
    given = Look(evidence, Setup.given(rig))
    findings, evidence = _twice(given, rig)
    look = Look(evidence, given.setup)
    if len(rig) < 2 or len(look.sightings) < MIN_SIGHTINGS:
        return Diagnosis((*findings, *_blind(given)), given, look, None)
    findings += _blind(given)
    rng = np.random.default_rng(0)
    while len(findings) < _MOST_FINDINGS:
        change = gross_mistake(look, rng)
        if change is None:
            break
        findings.append(_finding(change))
        look = Look(evidence, change.setup)
    if len(look.groups()) < MIN_SIGHTINGS // 2:
        none = look.cameras_used > 1 and len(look.groups()) < _NOBODY * len(look.sightings)
        return Diagnosis((*findings, *(_nobody(look) if none else [])), given, look, None)
    small = small_errors(look)
    refined = with_small_errors(look, small)
    found = lags(refined)
    for _ in range(_MOST_FINDINGS):
        late = latest(refined, found)
        if late is None:
            break
        view, before = late.cameras[0], look.setup.lag
        look, small, refined = _settled(look, view, int(late.amount))
        findings = _with_late(findings, view, int(look.setup.lag[view] - before[view]))
        found = lags(refined)
    known = {view for finding in findings for view in finding.cameras}
    findings += _small_findings(look, small, known)
    findings += _unfit(look, known)
    build = build_of(refined.structure()[1].points, detections.skeleton)
    findings += _of_people(build, rig)
    return Diagnosis(tuple(findings), given, look, small, tuple(found), build)


def _twice(look: Look, rig: Rig) -> tuple[list[Finding], Evidence]:
    """Cameras that are listed twice, and what was seen without one of each two, which fits the others less."""
    findings, evidence = list[Finding](), look.evidence
    gone: set[int] = set()
    for pair in duplicates(rig, evidence):
        if {pair.first, pair.second} & gone:
            continue
        gone.add(min(pair.second, pair.first, key=lambda view: look.scores[view] - 1e-6 * view))
        findings.append(Finding(Kind.DUPLICATE, (pair.first, pair.second), duplicate=pair))
    if gone:
        seen = evidence.sightings
        evidence = replace(evidence, sightings=seen.only(~np.isin(seen.view, list(gone))))
    return findings, evidence


def _blind(look: Look) -> list[Finding]:
    """Cameras without people, where others have some; or that no camera sees any."""
    seen = np.bincount(look.sightings.view, minlength=look.view_count)
    if seen.sum() == 0:
        return _nobody(look)
    gone = [] if seen.sum() < MIN_SIGHTINGS else np.flatnonzero(seen == 0).tolist()
    return [Finding(Kind.NOBODY, tuple(gone))] if gone else []


def _nobody(look: Look) -> list[Finding]:
    """No person could be placed."""
    return [Finding(Kind.NOBODY, (), amount=float(len(look.sightings)))]


def _finding(change: Change) -> Finding:
    """A change as a finding: a focal length is what the calibration has over what fits."""
    amount = 1 / change.amount if change.kind == Kind.FOCAL else change.amount
    cameras = tuple(sorted(change.cameras))
    kind = Kind.TURNED if change.kind == Kind.MOVED and amount > _PLAIN_TURN_DEG else change.kind
    return Finding(kind, cameras, amount, moved=change.moved)


def _settled(look: Look, view: int, frames: int) -> tuple[Look, SmallErrors, Look]:
    """The recording with a camera late by about `frames`, its small errors, and both together.

    People who move mostly one way look as if the camera was turned, so offset and turn are found in turns.
    """
    for _ in range(_LAG_ROUNDS):
        look = Look(look.evidence, look.setup.later(view, frames))
        small = small_errors(look)
        refined = with_small_errors(look, small)
        more = lag_of(refined, view, _LAG_NEAR)
        frames = more.frames
        if frames == 0 or more.agreement < 0:
            break
    return look, small, refined


def _with_late(findings: list[Finding], view: int, frames: int) -> list[Finding]:
    """The findings with an offset in time; a second one of the same camera mends the first."""
    before = sum(f.amount for f in findings if f.kind == Kind.LATE and f.cameras == (view,))
    rest = [f for f in findings if not (f.kind == Kind.LATE and f.cameras == (view,))]
    total = before + frames
    return [*rest, Finding(Kind.LATE, (view,), total)] if total != 0 else rest


def _small_findings(look: Look, small: SmallErrors, known: set[int]) -> list[Finding]:
    """Small errors that are worth naming: of one camera, or of several."""
    largest = float(np.hypot(small.shift_deg, small.roll_deg).max())
    if largest < _OFF_DEG and np.abs(np.log(small.focal)).max() < _OFF_FOCAL and small.pose_gain < _LEAST_GAIN:
        return []
    pose, shifted = other_pose(look), small_errors(look, SHIFT)
    if pose.cost < min(small.cost, shifted.cost) - _POSE_GAIN and pose.view not in known:
        kind = Kind.TURNED if pose.turned_deg > 1 else Kind.MOVED
        return [Finding(kind, (pose.view,), pose.turned_deg, moved=pose.moved)]
    turned, focal = _off(small, shifted)
    off = np.flatnonzero(turned | focal)
    if len(off) == 0:
        return []
    # Three cameras cannot tell which of their small errors belong to which.
    if len(off) == 1 and look.cameras_used > 3:
        view = int(off[0])
        if view in known:
            return []
        if focal[view]:
            return [Finding(Kind.FOCAL, (view,), float(1 / small.focal[view]))]
        found = _turned(small, view)
        if pose.view == view and 1 - pose.cost > _SINGLE * (1 - small.cost):
            return [found if found.amount > _TURN_DEG else replace(found, kind=Kind.PRINCIPAL_POINT)]
    if shifted.cost > _MOST_COST:
        return []
    shift = np.where(_known(known, look), 0.0, shifted.shift_deg)
    order = np.argsort(-shift)
    first, second = shift[order[0]], shift[order[1]]
    findings = []
    if look.cameras_used > 3 and first > _OUTLIER_DEG and first > _OUTLIER_RATIO * second:
        findings.append(_turned(shifted, int(order[0])))
        shift[order[0]] = 0.0
    rest = np.flatnonzero(shift > _NOTABLE_DEG)
    if len(rest) > 0:
        shifts = tuple((float(x), float(y)) for x, y in shifted.centre_px[rest])
        findings.append(Finding(Kind.PRINCIPAL_POINT, tuple(rest.tolist()), float(shift.max()), shifts))
    return findings


def _off(small: SmallErrors, shifted: SmallErrors) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(V,) whether each camera is turned, and whether its focal length is wrong, beyond what people can tell."""
    roll = np.abs(small.roll_deg)
    sure = np.hypot(small.shift_deg / small.shift_sigma_deg, roll / (2 * small.roll_sigma_deg)) > _SURE
    turned = (np.hypot(small.shift_deg, roll) > _OFF_DEG) & sure
    turned |= (small.shift_deg > _OFF_DEG) & (shifted.cost < _MOST_COST)
    log = np.abs(np.log(small.focal))
    return turned, (log > _OFF_FOCAL) & (log > _SIGMAS * small.focal_sigma)


def _known(known: set[int], look: Look) -> NDArray[np.bool_]:
    """(V,) cameras of which something is said already."""
    return np.isin(np.arange(look.view_count), list(known))


def _turned(small: SmallErrors, view: int) -> Finding:
    x, y = small.centre_px[view].tolist()
    angle = float(np.hypot(small.shift_deg[view], small.roll_deg[view]))
    return Finding(Kind.TURNED, (view,), angle, ((x, y),))


def _unfit(look: Look, known: set[int]) -> list[Finding]:
    """Cameras that fit nothing, without any explanation."""
    fits = look.scores
    seen = np.bincount(look.sightings.view, minlength=look.view_count)
    bad = [v for v in range(look.view_count) if fits[v] < _UNFIT and seen[v] >= MIN_SIGHTINGS and v not in known]
    return [Finding(Kind.UNFIT, (view,), float(fits[view])) for view in bad]


def _of_people(build: Build, rig: Rig) -> list[Finding]:
    """What people say of the unit and of the up axis."""
    findings = []
    if build.count >= MIN_SIGHTINGS and not _SHORTEST <= build.stature <= _TALLEST:
        findings.append(Finding(Kind.UNIT, (), build.stature))
    length = float(np.linalg.norm(build.up))
    if build.count >= MIN_SIGHTINGS and length > 0.7 and build.axis != rig.up:
        findings.append(Finding(Kind.UP, (), length, axis=build.axis))
    return findings
