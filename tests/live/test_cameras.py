"""Cameras that fall silent, freeze or are bumped into while it runs; people who leave and come
back.
"""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.detections import Detections
from shapepose_fg.live.cameras import CameraState, CameraWatch
from shapepose_fg.live.online import OnlineReconstructor

FPS = 10.0


@pytest.fixture(scope="module")
def steps(five_cameras, two_people, seen_exactly):
    """A function (frame, people) -> detections of people who sway by some centimetres; 10 frames a
    second.
    """

    def seen(frame: int, people=(0, 1)) -> Detections:
        sway = 0.05 * np.sin(2 * np.pi * 0.5 * frame / FPS)
        if len(people) == 0:
            return Detections.empty()
        return seen_exactly(five_cameras, two_people[list(people)] + [sway, 0.0, 0.0])

    return seen


def run(rig, frames, each=lambda live: None):
    with OnlineReconstructor(rig, lag_s=2.0, workers=1) as live:
        for n, detections in enumerate(frames):
            live.push(detections, n / FPS)
            each(live)
        return live.camera_changes(), live.report(), live.people()


def test_a_camera_that_falls_silent_is_named_and_comes_back(five_cameras, steps):
    frames = [steps(n) for n in range(20)]
    frames[5:13] = [each.only(each.view != 3) for each in frames[5:13]]
    said, report, people = run(five_cameras, frames)
    assert [(each.camera, each.state) for each in said] == [
        (five_cameras.names[3], CameraState.SILENT),
        (five_cameras.names[3], CameraState.OK),
    ]
    # After half a second of silence; in the first frame with detections.
    assert [each.time_s for each in said] == pytest.approx([1.0, 1.3])
    assert people.person.tolist() == [0, 1] and set(report.cameras.values()) == {CameraState.OK}


def test_a_frozen_camera_is_left_out_while_it_repeats_itself(five_cameras, steps):
    frames = [steps(n) for n in range(16)]
    still = frames[4].only(frames[4].view == 1)
    frames[5:9] = [Detections.joined([each.only(each.view != 1), still]) for each in frames[5:9]]
    used = []
    said, _, people = run(
        five_cameras,
        frames,
        lambda live: used.append((live._state.slots[-1].given.detections.view == 1).any()),
    )
    assert [(each.camera, each.state, round(each.time_s, 6)) for each in said] == [
        (five_cameras.names[1], CameraState.FROZEN, 0.5),
        (five_cameras.names[1], CameraState.OK, 0.9),
    ]
    assert [n for n, there in enumerate(used) if not there] == [5, 6, 7, 8]
    assert people.person.tolist() == [0, 1]


@pytest.mark.slow
def test_a_camera_that_is_bumped_into_is_named_and_left_out_until_it_agrees(
    five_cameras, steps, two_people
):
    frames = [steps(n) for n in range(50)]
    for n in range(10, 30):  # 80 pixels: some 4 degrees
        xy = frames[n].xy + np.where(frames[n].view == 2, 80.0, 0.0)[:, None]
        frames[n] = replace(frames[n], xy=xy)
    said, report, people = run(five_cameras, frames)
    assert [(each.camera, each.state) for each in said] == [
        (five_cameras.names[2], CameraState.CONTRADICTS),
        (five_cameras.names[2], CameraState.OK),
    ]
    assert 1.0 < said[0].time_s < 2.0 and 3.0 < said[1].time_s < 5.0
    assert set(report.cameras.values()) == {CameraState.OK}
    truth = two_people + np.array([0.05 * np.sin(2 * np.pi * 0.5 * 4.9), 0.0, 0.0])
    order = np.argsort(people.joints[:, :, 0].mean(axis=1))
    apart = np.linalg.norm(
        people.joints[order] - truth[np.argsort(truth[:, :, 0].mean(axis=1))], axis=-1
    )
    assert apart.mean() < 0.01


@pytest.mark.slow
def test_who_leaves_and_comes_back_is_the_same_person(five_cameras, steps):
    frames = [steps(n, (0, 1) if n < 15 or n >= 30 else (0,)) for n in range(50)]
    there = []
    _, _, people = run(
        five_cameras, frames, lambda live: there.append(live.people().person.tolist())
    )
    assert sorted(there[14]) == [0, 1] and there[25] in ([0], [1])
    assert sorted(people.person.tolist()) == [0, 1]
    # Away for 1.5 s; known again when ten frames have shown how long their bones are.
    assert sorted(there[45]) == [0, 1] and sum(2 in each for each in there) == 0


def test_a_camera_that_sees_one_of_five_people_or_somebody_else_agrees(
    five_cameras, two_people, seen_exactly
):
    others = [
        two_people[:1] + np.array([x, y, 0.0]) for x, y in ((0.9, 0.9), (-0.9, 0.9), (0.2, -0.9))
    ]
    places, watch = np.concatenate([two_people, *others]), CameraWatch.of(len(five_cameras))
    every, one = seen_exactly(five_cameras, places), seen_exactly(five_cameras, two_people[:1])
    few = Detections.joined([every.only(every.view != 2), one.only(one.view == 2)])
    apart_m = watch.compared(few, places, five_cameras, 0.1).apart_m
    assert (apart_m < 0.005).all()
    # A fifth of the detections are of the one who is known.
    apart_m = watch.compared(every, two_people[:1], five_cameras, 0.1).apart_m
    assert (apart_m < 0.005).all()
    bumped = replace(few, xy=few.xy + np.where(few.view == 2, 80.0, 0.0)[:, None])
    apart_m = watch.compared(bumped, places, five_cameras, 0.1).apart_m
    assert apart_m[2] > 0.1 and (np.delete(apart_m, 2) < 0.005).all()
