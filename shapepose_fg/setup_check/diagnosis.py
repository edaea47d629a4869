"""What is wrong with a set-up: one finding after the other, gross mistakes first.

Duplicates, the people's build and the sizes of pictures are told without comparing places.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Axis, Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.trust import BELIEVED, Trust
from shapepose_fg.io.footage.footage import glance, open_footage
from shapepose_fg.io.footage.placement import read_used_footage
from shapepose_fg.io.footage.places import VIDEOS, find_footage
from shapepose_fg.setup_check.belief import trust_of
from shapepose_fg.setup_check.evidence import Evidence, Look, gather
from shapepose_fg.setup_check.findings import SURE, Finding, Kind, one_of
from shapepose_fg.setup_check.fit import difference
from shapepose_fg.setup_check.hypotheses import GOOD_PAIR, Lag, lag_of, lags, mistake_of_cameras
from shapepose_fg.setup_check.joint_order import order_of_joints
from shapepose_fg.setup_check.matching import same_frame
from shapepose_fg.setup_check.over_time import parted
from shapepose_fg.setup_check.small import Problem

_SAME_PX = 0.6
"""Detections of one picture, stored with a pixel's accuracy, lie no farther apart."""
_SAME_SHARE = 0.8
_SAME_PLACE, _SAME_ANGLE_DEG = 0.002, 0.05
"""Poses that differ by less, of the cameras' mean distance and in degrees, are one: no stand is so exact."""
_BONES = (
    ("Shoulder", "Hip", 0.311, 0.52),
    ("Hip", "Knee", 0.227, 0.15),
    ("Knee", "Ankle", 0.231, 0.15),
    ("Shoulder", "Elbow", 0.155, 0.08),
    ("Elbow", "Wrist", 0.153, 0.10),
)
"""Lengths between joints as parts of stature, of the body model's mean person, and how much each tells: the best
linear estimate for four people, by the model's shape space and a detector that is off by 2 cm."""
_AXES: tuple[Axis, ...] = ("x", "-x", "y", "-y", "z", "-z")


def duplicates(rig: Rig, evidence: Evidence) -> list[Finding]:
    """Pairs of cameras with one pose, or with the same detections."""
    spread = np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1).mean()
    findings = []
    for first, second in combinations(range(len(rig)), 2):
        angle_deg, away = difference(rig.cTw[first], rig.cTw[second])
        pose = away <= _SAME_PLACE * spread and angle_deg < _SAME_ANGLE_DEG and len(rig) > 2
        seen = _same_detections(evidence, rig, first, second)
        if pose or seen:
            same = "" if pose and seen else "pose" if pose else "detections"
            findings.append(Finding(Kind.DUPLICATE, (first, second), same=same))
    return findings


def _same_detections(evidence: Evidence, rig: Rig, first: int, second: int) -> bool:
    """Whether two cameras saw the same pixels; as the pictures were, with the bend of their lenses."""
    every = evidence.sightings
    every = every.rows(np.isin(every.frame, evidence.anchors))
    one, other = (every.rows(every.view == view) for view in (first, second))
    if min(len(one), len(other)) < 5:
        return False
    i, j = same_frame(one.frame, other.frame)
    raw = [rig.cameras[view].distort(seen.xy.reshape(-1, 2)) for seen, view in ((one, first), (other, second))]
    distance = np.linalg.norm(raw[0].reshape(one.xy.shape)[i] - raw[1].reshape(other.xy.shape)[j], axis=-1)
    there = ~np.isnan(distance)
    alike = (there & (distance < _SAME_PX)).sum(axis=1) >= 0.9 * np.maximum(there.sum(axis=1), 1)
    alike &= there.sum(axis=1) >= 3
    return bool(len(np.unique(i[alike])) >= _SAME_SHARE * len(one))


def other_sizes(given: Sequence[str], rig: Rig) -> tuple[Finding, ...]:
    """Cameras whose videos, or pictures, are not of the calibrated size; `given` as `find_footage` takes it."""
    return _unlike(
        {
            name: glance(path)[0] if path.suffix.lower() in VIDEOS and path.is_file() else open_footage(path).size
            for name, path in zip(rig.names, find_footage(given, rig.names)[0], strict=True)
        },
        rig,
    )


def detected_sizes(file: Path, rig: Rig) -> tuple[Finding, ...]:
    """Cameras that `detect` was told another calibrated size of, by the footage.json that it wrote."""
    return _unlike({each.name: each.placement.calibrated_size for each in read_used_footage(file)}, rig)


def _unlike(sizes: Mapping[str, tuple[int, int]], rig: Rig) -> tuple[Finding, ...]:
    """Cameras whose pictures have other `sizes`, by name, than the calibrated."""
    found = [(view, sizes.get(each.name, each.image_size)) for view, each in enumerate(rig.cameras)]
    return tuple(
        Finding(Kind.PICTURE_SIZE, (view,), shift_px=((float(width), float(height)),))
        for view, (width, height) in found
        if (width, height) != rig.cameras[view].image_size
    )


@dataclass(frozen=True)
class Build:
    """What people look like, in the calibration's frame and unit."""

    stature: float
    """Median stature that their bones say, the calibration's unit; NaN where too few are seen."""
    up: Array
    """(3,) mean direction from their hips to their necks; its length is 1 where all stand alike, else less."""
    count: int
    """People and frames that it is made of."""

    @property
    def axis(self) -> Axis:
        """The world axis nearest to the people's up."""
        return _AXES[int(np.argmax(np.ravel(np.column_stack([self.up, -self.up]))))]

    @property
    def are_children(self) -> bool:
        """Whether all or most are as tall as children, which adults in a rig that is too small are as well."""
        return self.count >= MIN_SIGHTINGS and _SHORTEST <= self.stature < _CHILD


def build_of(points: Array, skeleton: Skeleton) -> Build:
    """The build of people (P, J, 3), J the core joints of `skeleton`."""
    place = {skeleton.joints[joint]: index for index, joint in enumerate(skeleton.core)}
    nowhere = np.full((len(points), 3), np.nan)

    def joint(name: str) -> Array:
        return points[:, place[name]] if name in place else nowhere

    sides = [[joint(s + a) - joint(s + b) for s in "RL"] for a, b, *_ in _BONES]
    lengths = np.linalg.norm(sides, axis=-1)  # (bones, 2, P)
    enough = np.isfinite(lengths).sum(axis=(0, 1)) >= 3
    said = [
        (np.log(np.nanmedian(each) / share), weight)
        for each, (*_, share, weight) in zip(lengths[..., enough], _BONES, strict=True)
        if np.isfinite(each).any()
    ]
    logs, weights = np.array(said).reshape(-1, 2).T
    stature = float(np.exp(np.average(logs, weights=weights))) if said else np.nan
    trunk = (joint("RShoulder") + joint("LShoulder") - joint("RHip") - joint("LHip")) / 2
    trunk = trunk[~np.isnan(trunk).any(axis=1)]
    trunk = trunk / np.maximum(np.linalg.norm(trunk, axis=1, keepdims=True), 1e-12)
    up = trunk.mean(axis=0) if len(trunk) > 0 else np.zeros(3)
    return Build(stature, up, int(enough.sum()))


_MOST_FINDINGS, _MOST_BIASED = 4, 3
"""More mistakes than this are not told apart."""
_UNFIT = 0.15
"""A camera that fits the others' people no better, and nothing explains it, does not fit."""
_CROWD = 8.0
"""With more people in a picture, who hide each other, cameras that do not fit are no mistake of the set-up."""
MIN_SIGHTINGS = 20
"""With fewer people seen, nothing is said of a camera."""
_LEAST_DEG, _LEAST_FOCAL = 0.25, 0.04
"""Smaller turns and focal lengths of one camera are not named."""
_NOBODY = 0.05
"""With fewer people than this for each sighting, cameras see no people in common."""
_STOPPED = 0.02
"""Share of pictures shown twice from which on a camera is named: fewer fill up dropped frames."""
_LAG_ROUNDS, _LAG_NEAR = 6, 8
_SHORTEST, _TALLEST = 0.45, 2.4
"""Median statures outside of which the calibration's unit is wrong, not the people, metres: newborn children are
0.5 m tall, the tallest people 2.5, and bones tell a stature to a tenth."""
_CHILD = 1.2
"""Median stature below which the people are children, metres, or else the calibration's lengths are too short."""


@dataclass(frozen=True)
class Diagnosis:
    """Everything that the check found, and what it was made of."""

    findings: tuple[Finding, ...]
    look: Look
    """The set-up as it was given."""
    corrected: Look
    """The set-up with the findings put right, but for small errors."""
    lags: tuple[Lag, ...] = ()
    """Each camera's offset in time that remains; none with too few people."""
    build: Build | None = None
    """The people, in the corrected set-up."""
    biased: tuple[Finding, ...] = ()
    """Single people whom a camera sees beside where they are; nothing of the set-up."""
    trust: Trust = BELIEVED
    """Which cameras a reconstruction is better without."""


def put_right(detections: DetectionSequence, rig: Rig, frames: range) -> tuple[Look, Look, list[Finding]]:
    """The set-up as it is given, the same with gross mistakes of cameras put right, and these mistakes."""
    evidence = gather(detections, frames, len(rig))
    given = Look.given(evidence, rig)
    findings, evidence = _twice(given, rig)
    findings += _blind(given) + _stopped(given)
    look = given if evidence is given.evidence else replace(given, evidence=evidence)  # what it found stays
    rng, enough = np.random.default_rng(0), len(rig) > 1 and len(look.sightings) >= MIN_SIGHTINGS
    while enough and len(findings) < _MOST_FINDINGS and (change := mistake_of_cameras(look, rng)) is not None:
        findings.append(change.finding)
        look = change.look
    return given, look, findings


def diagnose(detections: DetectionSequence, rig: Rig, frames: range | None = None) -> Diagnosis:
    """What is wrong with cameras and detections of a recording, all of its `frames` by default."""
    frames = range(len(detections)) if frames is None else frames
    given, look, findings = put_right(detections, rig, frames)
    if len(rig) < 2 or len(look.sightings) < MIN_SIGHTINGS:
        return Diagnosis(tuple(findings), given, look)
    if len(look.groups()) < MIN_SIGHTINGS // 2:
        none = look.cameras_used > 1 and len(look.groups()) < _NOBODY * len(look.sightings)
        findings += _nobody(look) if none else _unfit(look, {view for f in findings for view in f.cameras})
        trust = trust_of(findings, given, look, frames)
        return Diagnosis(tuple(findings), given, look, trust=trust)
    problem = Problem.of(look)
    remaining = lags(refined := replace(look, views=problem.relaxed()))
    for _ in range(_MOST_FINDINGS):
        late = [view for view, lag in enumerate(remaining) if abs(lag.frames) >= 2 and lag.is_offset]
        if len(late) == 0:
            break
        view = max(late, key=lambda view: remaining[view].gain)
        before, settled = look.lag[view], _settled(look, view, remaining[view].frames)
        if abs(settled[0].lag[view]) > look.evidence.most_lag:  # it would run on: chance, and no offset
            break
        look, problem = settled
        findings = _with_late(findings, view, int(look.lag[view] - before))
        remaining = lags(refined := replace(look, views=problem.relaxed()))
    known = {view for finding in findings for view in finding.cameras}
    unfit = _unfit(look, known)
    known |= {view for finding in unfit for view in finding.cameras}
    small, biased = _small_findings(problem, known)
    findings += [*(small if look.cameras_used > 2 else []), *unfit]
    build = build_of(refined.structure()[1].points, detections.skeleton)
    order = order_of_joints(detections, refined)
    findings += order or _of_people(build, rig)  # joints that are others say nothing of unit and up
    trust = trust_of(findings, given, refined, frames)
    return Diagnosis(tuple(findings), given, look, tuple(remaining), build, tuple(biased), trust)


def _twice(look: Look, rig: Rig) -> tuple[list[Finding], Evidence]:
    """Cameras that are listed twice, and what was seen without one of each two, which fits the others less."""
    findings, evidence, gone = list[Finding](), look.evidence, set[int]()
    for found in duplicates(rig, evidence):
        if gone.isdisjoint(found.cameras):
            gone.add(min(found.cameras[::-1], key=lambda view: look.scores[view] - 1e-6 * view))
            findings.append(found)
    if gone:
        seen = evidence.sightings
        evidence = replace(evidence, sightings=seen.rows(~np.isin(seen.view, list(gone))))
    return findings, evidence


def _blind(look: Look) -> list[Finding]:
    """Cameras without people, where others have some; or that no camera sees any."""
    seen = np.bincount(look.sightings.view, minlength=look.view_count)
    if seen.sum() == 0:
        return _nobody(look)
    gone = (seen == 0) & (look.evidence.stopped < _STOPPED) & (seen.sum() >= MIN_SIGHTINGS)
    gone = np.flatnonzero(gone).tolist()
    return [Finding(Kind.NOBODY, tuple(gone))] if gone else []


def _stopped(look: Look) -> list[Finding]:
    """Cameras whose recording stops."""
    share = look.evidence.stopped
    return [Finding(Kind.STOPPED, (v,), float(share[v])) for v in np.flatnonzero(share >= _STOPPED).tolist()]


def _nobody(look: Look) -> list[Finding]:
    """No person could be placed."""
    return [Finding(Kind.NOBODY, (), amount=float(len(look.sightings)))]


def _settled(look: Look, view: int, frames: int) -> tuple[Look, Problem]:
    """The recording with a camera late by about `frames`, and its residuals.

    People who move mostly one way look as if the camera was turned, so offset and turn are found in turns.
    """
    for _ in range(_LAG_ROUNDS):
        look = look.later(view, frames)
        problem = Problem.of(look)
        more = lag_of(replace(look, views=problem.relaxed()), view, _LAG_NEAR)
        frames = more.frames
        if frames == 0 or more.agreement < 0:
            break
    return look, problem


def _with_late(findings: list[Finding], view: int, frames: int) -> list[Finding]:
    """The findings with an offset in time; a second one of the same camera mends the first."""
    same = [f for f in findings if f.kind == Kind.LATE and f.cameras == (view,)]
    total = sum(f.amount for f in same) + frames
    rest = [f for f in findings if f not in same]
    return [*rest, Finding(Kind.LATE, (view,), total)] if total != 0 else rest


def _small_findings(problem: Problem, known: set[int]) -> tuple[list[Finding], list[Finding]]:
    """Small errors of cameras that are surer than no error, and than a detector's bias; and such biases."""
    biased = list[Finding]()
    while True:
        told = [(each.person, each.finding) for each in problem.causes if each.finding is not None]
        of_cameras = [finding for person, finding in told if person < 0]
        guilt = sum(each.sure for each in of_cameras)
        nothing = 1 - sum(finding.sure for _, finding in told)
        if guilt > SURE * (1 - nothing) or nothing > 1 - SURE or len(biased) == _MOST_BIASED:
            break
        (person, bias), camera = next(each for each in told if each[0] >= 0), one_of(of_cameras)
        instead = tuple(each for each in (replace(camera, instead=()), *camera.instead) if each.sure > 1 - SURE)
        biased.append(replace(bias, sure=1 - guilt - nothing, instead=instead))
        problem = replace(problem, biased=(*problem.biased, (person, *bias.cameras)))
    of_cameras = [each for each in of_cameras if known.isdisjoint(each.cameras)]
    if guilt <= max(SURE * (1 - nothing), nothing) or len(of_cameras) == 0:
        return [], biased
    found = one_of(of_cameras)
    size, least = (
        (found.amount, _LEAST_DEG) if found.kind != Kind.FOCAL else (abs(np.log(found.amount)), _LEAST_FOCAL)
    )
    return ([found] if size > least or found.kind == Kind.MOVED else []), biased


def _unfit(look: Look, known: set[int]) -> list[Finding]:
    """Cameras that fit nothing, without any explanation."""
    seen = np.bincount(look.sightings.view, minlength=look.view_count)
    everybody = tuple(np.flatnonzero(seen).tolist())
    crowd = float(seen.sum()) / max(len(everybody) * len(look.evidence.anchors), 1)
    if crowd > _CROWD and (look.scores[list(everybody)] < _UNFIT).all():
        return [Finding(Kind.CROWDED, (), crowd)]
    if len(known) == 0 and (frames := parted(look)) is not None:
        return [Finding(Kind.UNFIT, everybody, float(look.scores.min()), frames=frames)]
    if len(everybody) == 2:
        fits = look.scores[0] >= GOOD_PAIR or not known.isdisjoint(everybody)
        return [] if fits else [Finding(Kind.UNFIT, everybody, float(look.scores[0]))]
    bad = np.flatnonzero((look.scores < _UNFIT) & (seen >= MIN_SIGHTINGS)).tolist()
    bad = tuple(view for view in bad if view not in known and look.beside_biases(view) < _UNFIT)
    return [Finding(Kind.UNFIT, bad, float(look.scores[list(bad)].min()))] if bad else []


def _of_people(build: Build, rig: Rig) -> list[Finding]:
    """What people say of the unit and of the up axis."""
    if build.count < MIN_SIGHTINGS:
        return []
    right = _SHORTEST <= build.stature <= _TALLEST
    findings = [] if right else [Finding(Kind.UNIT, (), build.stature)]
    if (length := float(np.linalg.norm(build.up))) > 0.7 and build.axis != rig.up:
        findings.append(Finding(Kind.UP, (), length, axis=build.axis))
    return findings
