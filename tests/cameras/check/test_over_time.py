"""Cameras that fit in one part of a recording only, mirrored ones, and what a reconstruction makes
of them.
"""

from dataclasses import fields, replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from shapepose_fg.cameras.check.diagnosis import _small_findings
from shapepose_fg.cameras.check.findings import Finding, Kind
from shapepose_fg.cameras.check.report import (
    CameraUse,
    Distances,
    _unused,
    check_setup,
    result_check,
)
from shapepose_fg.cameras.check.small_errors import SmallErrors
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Status
from shapepose_fg.core.trust import Trust, Trusted
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import built_in_scene, simulate
from tests.cameras.check.spoiled_setups import mirrored, seen_as, turning
from tests.cameras.check.test_diagnosis import some_cameras


def only_finding(report):
    assert len(report.findings) == 1, report.warnings
    return report.findings[0]


@pytest.mark.slow
def test_a_camera_that_is_bumped_is_named_with_the_frame_and_left_out_from_there(recording, room):
    report = check_setup(turning(recording, room, 2, lambda t: 6.0 if t >= 25 else 0.0), room)
    found = only_finding(report)
    assert (found.kind, found.cameras) == (Kind.BUMPED, (2,))
    assert found.amount == pytest.approx(6, abs=0.6)
    assert found.frames[0] == pytest.approx(25, abs=1) and found.frames[1] is None
    assert report.trust == Trust(left_out=((2, found.frames[0], 60),))
    assert f"from frame {found.frames[0]} on" in report.warnings[0]
    assert "left out" in report.with_consequences(room)[0]


@pytest.mark.slow
def test_before_the_bump_it_may_be_that_it_does_not_fit(recording, room):
    found = only_finding(
        check_setup(turning(recording, room, 0, lambda t: 0.0 if t >= 40 else 6.0), room)
    )
    assert (found.kind, found.cameras, found.frames[0]) == (Kind.BUMPED, (0,), None)
    assert found.frames[1] == pytest.approx(40, abs=1)


@pytest.mark.slow
def test_a_camera_that_drifts_is_named(recording, room):
    report = check_setup(turning(recording, room, 3, lambda t: 8 * t / 59), room)
    found = only_finding(report)
    assert (found.kind, found.cameras) == (Kind.DRIFTING, (3,))
    assert found.amount == pytest.approx(8, abs=0.8)
    assert report.trust.excluded(30) == (3,)


@pytest.mark.slow
def test_a_small_drift_is_told_from_a_turn_that_lasts(recording, room, degrees=0.8):
    found = only_finding(check_setup(turning(recording, room, 1, lambda t: degrees * t / 59), room))
    assert (found.kind, found.cameras) == (Kind.DRIFTING, (1,)) and found.probability > 0.5
    assert found.amount == pytest.approx(degrees, rel=0.3)  # the usual size of a turn pulls it to 0


@pytest.mark.slow
def test_cameras_that_fit_nothing_are_one_sentence(recording, room):
    """Two of five whose pictures jump by some hundred pixels from frame to frame."""
    jumps = np.random.default_rng(1).uniform(-500, 500, (2, 60, 2))
    seen = recording
    for view, way in zip((1, 3), jumps, strict=True):
        seen = seen_as(seen, view, lambda frame, xy, way=way: xy + way[frame])
    report = check_setup(seen, room)
    found = only_finding(report)
    assert (found.kind, found.cameras) == (Kind.UNFIT, (1, 3))
    assert "cam1 and cam3 contradict the others" in report.warnings[0]
    assert report.trust == Trust(left_out=((1, 0, 60), (3, 0, 60)))


@pytest.mark.slow
@pytest.mark.parametrize("views", [[0, 1, 2, 3, 4], [0, 2, 3]])
def test_a_mirrored_camera_is_named_and_left_out(recording, room, views):
    seen, rig = some_cameras(recording, room, views)
    report = check_setup(mirrored(seen, rig, 1), rig)
    found = only_finding(report)
    assert (found.kind, found.cameras) == (Kind.MIRRORED, (1,))
    assert report.trust == Trust(left_out=((1, 0, 60),))


@pytest.mark.slow
def test_of_two_cameras_nothing_says_which_is_wrong(recording, room):
    seen, rig = some_cameras(recording, room, [0, 2])
    assert check_setup(seen, rig).trust == Trust()
    report = check_setup(turning(seen, rig, 1, lambda t: 8.0 if t >= 30 else 0.0), rig)
    found = only_finding(report)
    assert (found.kind, found.cameras) == (Kind.UNFIT, (0, 1))
    assert found.frames[0] == pytest.approx(30, abs=2)
    assert report.trust.in_doubt(10) == () and report.trust.in_doubt(50) == (0, 1)
    assert "contradict each other from frame" in report.warnings[0]


@pytest.mark.slow
def test_rows_that_rest_on_doubted_cameras_are_not_ok(recording, room):
    seen, rig = some_cameras(recording, room, [0, 2, 3])
    seen = Recording(seen.skeleton, seen.frames[:20])
    people = reconstruct(Trusted(seen, Trust(doubted=((0, 10, 20), (1, 10, 20)))), rig)
    assert set(people.status[people.frame < 10]) == {Status.OK}
    assert set(people.status[people.frame >= 10]) == {Status.CONTRADICTED}
    one = reconstruct(Trusted(seen, Trust(doubted=((0, 0, 20),), left_out=())), rig)
    assert set(one.status) == {Status.OK}
    without = reconstruct(Trusted(seen, Trust(left_out=((0, 0, 20),))), rig)
    assert len(without) == len(people) and without.observations is not None
    assert (without.observations.candidate[:, :, 0] < 0).all()


@pytest.mark.slow
def test_people_who_move_as_nobody_does_are_named_with_the_rate(recording, room, sound):
    people = reconstruct(recording, room, times=FrameTimes.from_fps(25, len(recording)))
    assert result_check(sound, people, recording, room, range(60)).warnings == ()
    fast = replace(people, time_s=people.time_s * 25 / 1000)
    (said,) = result_check(sound, fast, recording, room, range(60)).warnings
    assert "m/s" in said and "--fps is probably wrong (1000 Hz" in said
    assert np.isfinite(people.time_s).all()
    none = np.zeros((0, 2), dtype=np.intp), np.zeros(0)
    crowd = [
        Detections(
            *(np.repeat(each, 12, axis=0) for each in (f.view, f.joint, f.xy, f.confidence)), *none
        )
        for f in recording
    ]
    crowd = Recording(recording.skeleton, crowd)
    (said,) = result_check(
        sound, people, crowd, room, range(60)
    ).warnings  # detections beside those of people
    assert "people explain only 8" in said and "higher confidence threshold" in said


def test_one_unused_detection_is_in_the_singular():
    none = Distances(0, None, None, None, None)
    unused = {"are not assigned to any person": 48, "are too far from the joint": 1}
    (said,) = _unused(
        [CameraUse("a", 60, 10, none, none, none, unused | {"contradict the body": 1})]
    )
    assert (
        "48 are not assigned to any person, 1 is too far from the joint, 1 contradicts the" in said
    )


@pytest.mark.parametrize("views", [(0,), (0, 1, 2, 3)])
def test_people_that_a_detector_finds_twice_are_called_so(recording, room, sound, views):
    """A detector without non-maximum suppression; no camera is accused, and nobody is missed."""
    twice = []
    for found in recording:
        again = np.flatnonzero(np.isin(found.view, views)).tolist()
        order = sorted([*range(len(found)), *again], key=lambda n: (found.view[n], found.joint[n]))
        rng = np.random.default_rng(len(found))
        xy = found.xy[order] + rng.normal(0.0, 2.0, (len(order), 2))
        parts = found.view[order], found.joint[order], xy, found.confidence[order]
        twice.append(Detections(*parts, np.zeros((0, 2), dtype=np.intp), np.zeros(0)))
    given = Recording(recording.skeleton, twice)
    people = reconstruct(recording, room, frames=range(20))
    (said,) = result_check(sound, people, given, room, range(20)).warnings
    names = " ".join(room.names[view] for view in views)
    assert said.startswith(f"{names}: the detector finds people more than once")


@pytest.mark.slow
def test_a_camera_that_is_mostly_left_out_is_named_with_the_reason(recording, room):
    """Turned by 25 degrees, it is left out by the check; without that nobody is given what it
    saw.
    """
    turned = turning(recording, room, 2, lambda t: 25.0)
    report = check_setup(turned, room)
    name = room.names[2]
    people = reconstruct(Trusted(turned, report.trust), room, frames=range(20))
    checked = result_check(report, people, Trusted(turned, report.trust), room, range(20))
    assert any(
        each.startswith(f"{name}: 0 of ") and "left out with the camera" in each
        for each in checked.warnings
    )
    alone = reconstruct(turned, room, frames=range(20))
    checked = result_check(
        replace(report, findings=(), warnings=(), trust=Trust()), alone, turned, room, range(20)
    )
    (said,) = [each for each in checked.warnings if each.startswith(f"{name}: ")]
    assert "are not assigned to any person" in said and "check-calibration" in said
    use = checked.cameras[2]
    assert use.used + sum(use.unused.values()) == use.offered
    others = [each for view, each in enumerate(checked.cameras) if view != 2]
    assert not any(
        each.camera in warning.split(":")[0] for each in others for warning in checked.warnings
    )


@pytest.mark.slow
def test_people_whom_two_cameras_see_and_who_are_not_found_are_counted(recording, room, sound):
    """Somebody is left out of the result: the sentence is among the warnings, which run.json and
    stderr have.
    """
    people = reconstruct(
        recording, room, frames=range(20), times=FrameTimes.from_fps(10, len(recording))
    )
    first = np.unique(people.person)[0]
    fewer = people.rows(people.person != first)
    warned = result_check(sound, fewer, recording, room, range(20)).warnings
    words = [each for each in warned if "two cameras" in each]
    seen, found = len(np.unique(people.person)), len(np.unique(fewer.person))
    assert len(words) == 1 and f"but {found:.1f} are found" in words[0] and found == seen - 1
    everybody = result_check(sound, people, recording, room, range(20))
    assert not any("two cameras" in each for each in everybody.warnings)


@pytest.mark.parametrize("frames", [12, 20])
def test_a_second_of_film_accuses_no_camera(frames):
    """What a few frames show may be lasting errors of the detector."""
    scene = built_in_scene(people=2, frames=frames)
    assert check_setup(simulate(scene), scene.rig).findings == ()


@pytest.mark.slow
def test_no_camera_is_late_where_people_stand_still():
    """The best offset is then that of the detector's errors."""
    scene = built_in_scene(1, people=3, cameras=4, frames=200)
    pose = {each.name: getattr(scene.motion, each.name) for each in fields(scene.motion)}
    still = {name: np.repeat(each[:1], 200, axis=0) for name, each in pose.items()}
    scene = replace(scene, motion=replace(scene.motion, **still | {"betas": pose["betas"]}))
    report = check_setup(simulate(scene), scene.rig)
    assert not any(each.kind is Kind.LATE for each in report.findings), report.warnings


def test_a_known_camera_s_small_error_accuses_no_other():
    """Most of the probability is that of a camera whose mistake is known; the rest is chance."""
    causes = [
        SimpleNamespace(person=-1, finding=Finding(Kind.TURNED, (3,), 2.0, probability=0.97)),
        SimpleNamespace(person=-1, finding=Finding(Kind.TURNED, (1,), 1.0, probability=0.01)),
    ]
    problem = cast(SmallErrors, SimpleNamespace(causes=causes, biased=()))
    assert _small_findings(problem, {3}) == ([], [])
    assert [each.cameras for each in _small_findings(problem, {0})[0]] == [(3,)]
