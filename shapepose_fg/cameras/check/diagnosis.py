"""Diagnosis of a set-up: finds mistakes one after the other, gross ones first.

Duplicates, people's build and picture sizes are tested without comparing positions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from shapepose_fg.cameras.check.biases import without_biases
from shapepose_fg.cameras.check.evidence import Evidence, SetupHypothesis, gather
from shapepose_fg.cameras.check.exclusion import trust_of
from shapepose_fg.cameras.check.findings import SURE, Finding, Kind, one_of
from shapepose_fg.cameras.check.hypotheses import GOOD_PAIR, mistake_of_cameras
from shapepose_fg.cameras.check.joint_order import order_of_joints, unlike_bodies
from shapepose_fg.cameras.check.lags import Lag, lag_of, lags
from shapepose_fg.cameras.check.over_time import parted, parting_of
from shapepose_fg.cameras.check.small_errors import LEAST_DEG, SmallErrors
from shapepose_fg.cameras.parameters import difference
from shapepose_fg.cameras.sightings import MIN_SIGHTINGS, same_frame
from shapepose_fg.cameras.stature import SHORTEST_M, TALLEST_M, Build, build_of
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.trust import BELIEVED, Trust
from shapepose_fg.io.footage.footage import glance, open_footage
from shapepose_fg.io.footage.placement import read_used_footage
from shapepose_fg.io.footage.places import VIDEOS, find_footage


def duplicates(rig: Rig, evidence: Evidence) -> list[Finding]:
    """Pairs of cameras with equal poses or equal detections."""
    spread = np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1).mean()
    findings = []
    for first, second in combinations(range(len(rig)), 2):
        angle_deg, distance_m = difference(rig.cTw[first], rig.cTw[second])
        # Maximum differences of two equal poses, as a share of the cameras' mean distance and in
        # degrees; no two stands agree so well.
        pose = distance_m <= 0.002 * spread and angle_deg < 0.05 and len(rig) > 2
        seen = _same_detections(evidence, rig, first, second)
        if pose or seen:
            same = "" if pose and seen else "pose" if pose else "detections"
            findings.append(Finding(Kind.DUPLICATE, (first, second), same=same))
    return findings


def _same_detections(evidence: Evidence, rig: Rig, first: int, second: int) -> bool:
    """Whether two cameras have the same detections, compared in distorted pixels."""
    every = evidence.sightings
    every = every.rows(np.isin(every.frame, evidence.anchors))
    one, other = (every.rows(every.view == view) for view in (first, second))
    if min(len(one), len(other)) < 5:
        return False
    i, j = same_frame(one.frame, other.frame)
    raw = [
        rig.cameras[view].distort(seen.xy.reshape(-1, 2))
        for seen, view in ((one, first), (other, second))
    ]
    distance = np.linalg.norm(
        raw[0].reshape(one.xy.shape)[i] - raw[1].reshape(other.xy.shape)[j], axis=-1
    )
    known = ~np.isnan(distance)
    # Maximum distance, px, between detections of one picture stored with pixel accuracy.
    equal = (known & (distance < 0.6)).sum(axis=1) >= 0.9 * np.maximum(known.sum(axis=1), 1)
    equal &= known.sum(axis=1) >= 3
    return bool(len(np.unique(i[equal])) >= 0.8 * len(one))


def other_sizes(given: Sequence[str], rig: Rig) -> tuple[Finding, ...]:
    """Cameras with videos or pictures of another than the calibrated size; `given` as for
    `find_footage`.
    """
    return _unlike(
        {
            name: glance(path)[0]
            if path.suffix.lower() in VIDEOS and path.is_file()
            else open_footage(path).size
            for name, path in zip(rig.names, find_footage(given, rig.names)[0], strict=True)
        },
        rig,
    )


def detected_sizes(file: Path, rig: Rig) -> tuple[Finding, ...]:
    """Cameras for which `detect` was given another calibrated size, according to its
    footage.json.
    """
    return _unlike(
        {each.name: each.placement.calibrated_size for each in read_used_footage(file)}, rig
    )


def _unlike(sizes: Mapping[str, tuple[int, int]], rig: Rig) -> tuple[Finding, ...]:
    """Cameras for which `sizes`, by name, differ from the calibrated ones."""
    found = [(view, sizes.get(each.name, each.image_size)) for view, each in enumerate(rig.cameras)]
    return tuple(
        Finding(Kind.PICTURE_SIZE, (view,), shift_px=((float(width), float(height)),))
        for view, (width, height) in found
        if (width, height) != rig.cameras[view].image_size
    )


_FITTING, _STEADY, _UNLIKELY, _NEARLY = 0.5, 0.3, 0.1, 0.5
"""Signs of a mistake: a camera's score below the first value, a difference of its scores between
parts of the recording above the second, a probability of small mistakes above the third, or an
offset in time with more than the fourth as a share of what makes it significant."""
_MOST_FINDINGS, _MOST_BIASED = 4, 3
"""Maximum number of findings, and of biased people, that are distinguished."""
_UNFIT = 0.15
"""Score below which a camera without any explanation does not fit."""
_CROWD = 8.0
"""Mean number of people per picture above which occlusions, not mistakes, explain low scores."""
_STOPPED = 0.02
"""Share of repeated pictures above which a camera is reported; fewer replace dropped frames."""


@dataclass(frozen=True)
class Diagnosis:
    """All findings of the check, and the data they are based on."""

    findings: tuple[Finding, ...]
    setup: SetupHypothesis
    """The set-up as given."""
    corrected: SetupHypothesis
    """The set-up with the findings corrected, except small errors."""
    lags: tuple[Lag, ...] = ()
    """Remaining time offset of each camera; empty with too few people."""
    build: Build | None = None
    """Build of the people in the corrected set-up."""
    biased: tuple[Finding, ...] = ()
    """Biases of single people in a view, which are no mistakes of the set-up."""
    trust: Trust = BELIEVED
    """Cameras that a reconstruction should exclude or doubt."""


def correct_gross_mistakes(
    evidence: Evidence, rig: Rig
) -> tuple[SetupHypothesis, SetupHypothesis, list[Finding]]:
    """The set-up as given, with gross mistakes of cameras corrected, and these mistakes."""
    given = SetupHypothesis.given(evidence, rig)
    findings, evidence = _without_duplicates(given, rig)
    findings += _without_people(given) + _stopped(given)
    setup = (
        given if evidence is given.evidence else replace(given, evidence=evidence)
    )  # the duplicates found remain in the scores
    rng, enough = np.random.default_rng(0), len(rig) > 1 and len(setup.sightings) >= MIN_SIGHTINGS
    while (
        enough
        and len(findings) < _MOST_FINDINGS
        and (change := mistake_of_cameras(setup, rng)) is not None
    ):
        findings.append(change.finding)
        setup = change.setup
    return given, setup, findings


def diagnose(detections: DetectionSequence, rig: Rig, frames: range | None = None) -> Diagnosis:
    """Diagnose cameras and detections of a recording in `frames`, by default all.

    A few frames are enough if nothing in them is odd.
    """
    frames = range(len(detections)) if frames is None else frames
    evidence = gather(detections, frames, len(rig))
    setup = SetupHypothesis.given(evidence, rig)
    people_per_frame = len(setup.sightings) / max(len(evidence.anchors), 1)
    # Frames, and sightings of people in them, that are enough if nothing in them is odd.
    frame_count = max(16, round(300 / max(people_per_frame, 1.0)))
    sound = _without_mistakes(
        replace(setup, evidence=evidence.thinned(frame_count)), detections, rig
    )
    return _all_mistakes(evidence, detections, rig, frames) if sound is None else sound


def _without_mistakes(
    setup: SetupHypothesis, detections: DetectionSequence, rig: Rig
) -> Diagnosis | None:
    """The diagnosis of cameras and detections without any sign of a mistake; None if there is one,
    or if too little is seen.
    """
    partings = [parting_of(setup, view) for view in range(len(rig))]
    if (
        len(setup.sightings) < MIN_SIGHTINGS
        or len(setup.groups()) < MIN_SIGHTINGS
        or min(setup.scores) < (_FITTING if setup.cameras_used > 2 else GOOD_PAIR)
        or [
            *duplicates(rig, setup.evidence),
            *_without_people(setup),
            *_stopped(setup),
            *_unexplained(setup, set()),
        ]
        or any(each is not None and each.drop > _STEADY for each in partings)
    ):
        return None
    problem = SmallErrors.of(setup)
    refined = replace(setup, views=problem.relaxed())
    remaining = lags(without_biases(refined))
    build = build_of(refined.structure()[1].points, detections.skeleton)
    unlikely = sum(each.finding.probability for each in problem.causes if each.finding is not None)
    odd = unlikely > _UNLIKELY or any(lag.exceeds(_NEARLY) for lag in remaining)
    if (
        odd
        or build.count < MIN_SIGHTINGS
        or _of_people(build, rig)
        or order_of_joints(detections, refined)
    ):
        return None
    return Diagnosis((), setup, setup, tuple(remaining), build)


def _all_mistakes(
    evidence: Evidence, detections: DetectionSequence, rig: Rig, frames: range
) -> Diagnosis:
    """The mistakes in all frames used, one after the other."""
    given, setup, findings = correct_gross_mistakes(evidence, rig)
    if len(rig) < 2 or len(setup.sightings) < MIN_SIGHTINGS:
        return Diagnosis(tuple(findings), given, setup)
    if len(setup.groups()) < MIN_SIGHTINGS // 2:
        # Minimum people placed per sighting; with fewer, cameras see no people in common.
        none = setup.cameras_used > 1 and len(setup.groups()) < 0.05 * len(setup.sightings)
        findings += (
            _nobody_placed(setup)
            if none
            else _unexplained(setup, {view for f in findings for view in f.cameras})
        )
        trust = trust_of(findings, given, setup, frames)
        return Diagnosis(tuple(findings), given, setup, trust=trust)
    problem = SmallErrors.of(setup)
    refined = replace(setup, views=problem.relaxed())
    remaining = lags(without_biases(refined))
    for _ in range(_MOST_FINDINGS):
        late = [
            view for view, lag in enumerate(remaining) if abs(lag.frames) >= 2 and lag.is_offset
        ]
        if len(late) == 0:
            break
        view = max(late, key=lambda view: remaining[view].gain)
        before, settled = setup.lag[view], _with_offset(setup, view, remaining[view].frames)
        if abs(settled[0].lag[view]) > setup.evidence.most_lag:  # a diverging offset is chance
            break
        setup, problem = settled
        findings = _with_late(findings, view, int(setup.lag[view] - before))
        refined = replace(setup, views=problem.relaxed())
        remaining = lags(without_biases(refined))
    known = {view for finding in findings for view in finding.cameras}
    unfit = _unexplained(setup, known)
    known |= {view for finding in unfit for view in finding.cameras}
    small, biased = _small_findings(problem, known)
    findings += [*(small if setup.cameras_used > 2 else []), *unfit]
    build = build_of(refined.structure()[1].points, detections.skeleton)
    order = order_of_joints(detections, refined)
    # With wrong joints, unit and up axis cannot be tested.
    of_people = [] if order else _of_people(build, rig)
    findings += order or (of_people and unlike_bodies(detections, refined)) or of_people
    trust = trust_of(findings, given, refined, frames)
    return Diagnosis(tuple(findings), given, setup, tuple(remaining), build, tuple(biased), trust)


def _without_duplicates(setup: SetupHypothesis, rig: Rig) -> tuple[list[Finding], Evidence]:
    """Duplicated cameras, and the evidence without the one of each pair that fits the
    others less.
    """
    findings, evidence, removed = list[Finding](), setup.evidence, set[int]()
    for found in duplicates(rig, evidence):
        if removed.isdisjoint(found.cameras):
            removed.add(min(found.cameras[::-1], key=lambda view: setup.scores[view] - 1e-6 * view))
            findings.append(found)
    if removed:
        seen = evidence.sightings
        evidence = replace(evidence, sightings=seen.rows(~np.isin(seen.view, list(removed))))
    return findings, evidence


def _without_people(setup: SetupHypothesis) -> list[Finding]:
    """Cameras without any people though others see some; or the finding that no camera sees any."""
    seen = np.bincount(setup.sightings.view, minlength=setup.view_count)
    if seen.sum() == 0:
        return _nobody_placed(setup)
    views = (seen == 0) & (setup.evidence.stopped < _STOPPED) & (seen.sum() >= MIN_SIGHTINGS)
    views = np.flatnonzero(views).tolist()
    return [Finding(Kind.NOBODY, tuple(views))] if views else []


def _stopped(setup: SetupHypothesis) -> list[Finding]:
    """Cameras with repeated pictures."""
    share = setup.evidence.stopped
    return [
        Finding(Kind.STOPPED, (v,), float(share[v]))
        for v in np.flatnonzero(share >= _STOPPED).tolist()
    ]


def _nobody_placed(setup: SetupHypothesis) -> list[Finding]:
    """Finding that no person could be placed."""
    return [Finding(Kind.NOBODY, (), amount=float(len(setup.sightings)))]


def _with_offset(
    setup: SetupHypothesis, view: int, frames: int
) -> tuple[SetupHypothesis, SmallErrors]:
    """The set-up with a camera late by about `frames`, and its residuals.

    People who move mostly in one direction make a time offset look like a rotation, so that the two
    are estimated alternately.
    """
    for _ in range(6):
        setup = setup.later(view, frames)
        problem = SmallErrors.of(setup)
        refined = replace(setup, views=problem.relaxed())
        more = lag_of(without_biases(refined), view, 8)
        frames = more.frames
        if frames == 0 or more.gain < 0:
            break
    return setup, problem


def _with_late(findings: list[Finding], view: int, frames: int) -> list[Finding]:
    """The findings with a time offset; it is added to an earlier one of the same camera."""
    same = [f for f in findings if f.kind == Kind.LATE and f.cameras == (view,)]
    total = sum(f.amount for f in same) + frames
    rest = [f for f in findings if f not in same]
    return [*rest, Finding(Kind.LATE, (view,), total)] if total != 0 else rest


def _small_findings(problem: SmallErrors, known: set[int]) -> tuple[list[Finding], list[Finding]]:
    """Small errors of cameras that are more probable than no error and than detector biases; and
    such biases.
    """
    biased = list[Finding]()
    while True:
        causes = [
            (each.person, each.finding) for each in problem.causes if each.finding is not None
        ]
        of_cameras = [finding for person, finding in causes if person < 0]
        p_camera = sum(each.probability for each in of_cameras)
        p_none = 1 - sum(finding.probability for _, finding in causes)
        if p_camera > SURE * (1 - p_none) or p_none > 1 - SURE or len(biased) == _MOST_BIASED:
            break
        (person, bias), camera = next(each for each in causes if each[0] >= 0), one_of(of_cameras)
        instead = tuple(
            each
            for each in (replace(camera, instead=()), *camera.instead)
            if each.probability > 1 - SURE
        )
        biased.append(replace(bias, probability=1 - p_camera - p_none, instead=instead))
        problem = replace(problem, biased=(*problem.biased, (person, *bias.cameras)))
    of_cameras = [each for each in of_cameras if known.isdisjoint(each.cameras)]
    p_camera = sum(each.probability for each in of_cameras)
    if p_camera <= max(SURE * (1 - p_none), p_none) or len(of_cameras) == 0:
        return [], biased
    found = one_of(of_cameras)
    # Minimum change of the focal length of one camera that is reported.
    size, least = (
        (found.amount, LEAST_DEG) if found.kind != Kind.FOCAL else (abs(np.log(found.amount)), 0.04)
    )
    return ([found] if size > least or found.kind == Kind.MOVED else []), biased


def _unexplained(setup: SetupHypothesis, known: set[int]) -> list[Finding]:
    """Cameras that do not fit, without any explanation."""
    seen = np.bincount(setup.sightings.view, minlength=setup.view_count)
    everybody = tuple(np.flatnonzero(seen).tolist())
    crowd = float(seen.sum()) / max(len(everybody) * len(setup.evidence.anchors), 1)
    if crowd > _CROWD and (setup.scores[list(everybody)] < _UNFIT).all():
        return [Finding(Kind.CROWDED, (), crowd)]
    if len(known) == 0 and (frames := parted(setup)) is not None:
        return [Finding(Kind.UNFIT, everybody, float(setup.scores.min()), frames=frames)]
    if len(everybody) == 2:
        fits = setup.scores[0] >= GOOD_PAIR or not known.isdisjoint(everybody)
        return [] if fits else [Finding(Kind.UNFIT, everybody, float(setup.scores[0]))]
    bad = np.flatnonzero((setup.scores < _UNFIT) & (seen >= MIN_SIGHTINGS)).tolist()
    bad = tuple(
        view for view in bad if view not in known and setup.score_without_biases(view) < _UNFIT
    )
    return [Finding(Kind.UNFIT, bad, float(setup.scores[list(bad)].min()))] if bad else []


def _of_people(build: Build, rig: Rig) -> list[Finding]:
    """Findings on the unit and the up axis, from the people's build."""
    if build.count < MIN_SIGHTINGS:
        return []
    right = SHORTEST_M <= build.stature <= TALLEST_M
    findings = [] if right else [Finding(Kind.UNIT, (), build.stature)]
    if (length := float(np.linalg.norm(build.up))) > 0.7 and build.axis != rig.up:
        findings.append(Finding(Kind.UP, (), length, axis=build.axis))
    return findings
