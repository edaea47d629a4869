"""The baseline: 2D people matched by their rays, triangulation, and time."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.detections import Recording
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation import baseline
from shapepose_fg.evaluation.baseline import frame_by_frame, initial_proposals, over_time, people_in_frame
from shapepose_fg.evaluation.metrics import PlainPeople, joint_metrics, match_people
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import DetectorConfig, built_in_scene, simulate


def test_what_is_seen_exactly_is_found_exactly(five_cameras, two_people, seen_exactly):
    joints = people_in_frame(seen_exactly(five_cameras, two_people), five_cameras, BODY_25)
    order = np.argsort(joints[:, 8, 0])
    np.testing.assert_allclose(joints[order], two_people, atol=1e-6)


def test_who_is_seen_by_one_camera_is_nobody(five_cameras, two_people, seen_exactly):
    found = seen_exactly(five_cameras, two_people)
    assert len(people_in_frame(found.only(found.view == 2), five_cameras, BODY_25)) == 0
    pair = people_in_frame(found.only(found.view >= 3), five_cameras, BODY_25)
    assert len(pair) == 2


def test_a_wrong_view_is_left_out(five_cameras, two_people, seen_exactly):
    """One of five views has a wrist 40 cm off, where it is nobody's: the rest decide."""
    found = seen_exactly(five_cameras, two_people)
    wrist = BODY_25.index("RWrist")
    depth = five_cameras.project(two_people[:, wrist])[1][0].mean()
    off = (found.view == 0) & (found.joint == wrist)
    xy = found.xy.copy()
    xy[off, 1] -= 0.4 * five_cameras.focal_px[0] / depth
    joints = people_in_frame(replace(found, xy=xy), five_cameras, BODY_25)
    order = np.argsort(joints[:, 8, 0])
    np.testing.assert_allclose(joints[order], two_people, atol=1e-6)


def test_detections_that_grouping_mixed_are_put_right(five_cameras, two_people, seen_exactly):
    """In view 0 the right wrists are tied to each other's elbows."""
    found = seen_exactly(five_cameras, two_people)
    ends = [BODY_25.index(name) for name in ("RElbow", "RWrist")]
    mixed = np.isin(found.joint[found.pairs], ends).all(axis=1) & (found.view[found.pairs[:, 0]] == 0)
    affinity = np.where(mixed, found.affinity.max() - found.affinity, found.affinity)
    joints = people_in_frame(replace(found, affinity=affinity), five_cameras, BODY_25)
    order = np.argsort(joints[:, 8, 0])
    np.testing.assert_allclose(joints[order], two_people, atol=1e-6)


def test_a_scene_frame_by_frame_and_over_time():
    """Ten frames of the demo: 99.3 % frame by frame when the first baseline was made, and nobody twice."""
    scene = built_in_scene(frames=10)
    seen = simulate(scene)
    people = frame_by_frame(seen, scene.rig)
    alone = joint_metrics(people, scene.keypoints)
    assert alone.f1 > 0.98 and alone.mpjpe_mm < 30 and alone.people_duplicated == 0
    followed = over_time(people, scene.fps)
    assert joint_metrics(followed, scene.keypoints).f1 >= alone.f1
    assert len(np.unique(followed.person)) == scene.people


def test_a_frame_in_which_nobody_is(five_cameras, two_people, seen_exactly):
    found = seen_exactly(five_cameras, two_people)
    nothing = found.only(np.zeros(len(found), dtype=bool))
    people = frame_by_frame(Recording(BODY_25, [nothing, found, nothing]), five_cameras)
    assert people.frame.tolist() == [1, 1]
    assert len(over_time(people, 25.0).frame) == 0  # a single frame is nobody over time


def walking(frames: int = 20) -> PlainPeople:
    """Two people who walk past each other, 0.6 m apart at the nearest, at 25 frames a second; 4 cm a frame."""
    rng = np.random.default_rng(0)
    body = rng.uniform(-0.1, 0.1, (25, 3))
    step = np.arange(frames)[:, None, None] * np.array([0.04, 0.0, 0.0])
    one, other = body + step, body + np.array([0.8, 0.6, 0.0]) - step
    joints = np.stack([one, other], axis=1).reshape(-1, 25, 3)
    frame = np.repeat(np.arange(frames), 2)
    return PlainPeople(frame, joints, np.tile([0, 1], frames))


def test_people_keep_their_names_and_gaps_are_closed(monkeypatch):
    people = walking()
    monkeypatch.setattr(baseline, "NEAREST_M", 0.3)
    joints = people.joints.copy()
    joints[20, 4] = np.nan  # a wrist is missing for a frame,
    joints[24, 4] += 0.5  # and in another it jumps
    kept = np.arange(len(joints)) != 16  # nobody sees the first person in frame 8
    gaps = PlainPeople(people.frame[kept], joints[kept], people.person[kept])
    with monkeypatch.context() as unsmoothed:
        unsmoothed.setattr(baseline, "SMOOTH_S", 1e-9)
        found = over_time(gaps, 25.0)
    np.testing.assert_array_equal(found.frame, people.frame)
    np.testing.assert_array_equal(found.person, people.person)
    np.testing.assert_allclose(found.joints, people.joints, atol=1e-9)
    smoothed = over_time(gaps, 25.0).joints
    # A straight line stays one but for its ends, where the Gaussian has one side only.
    middle = (people.frame > 5) & (people.frame < 14)
    np.testing.assert_allclose(smoothed[middle], people.joints[middle], atol=1e-3)


def test_who_is_there_for_a_moment_was_nobody(monkeypatch):
    people = walking()
    monkeypatch.setattr(baseline, "NEAREST_M", 0.3)
    ghost = replace(
        people,
        frame=np.append(people.frame, [3, 4]),
        person=np.append(people.person, [2, 2]),
        joints=np.concatenate([people.joints, people.joints[:2] + np.array([0, 5, 0])]),
    )
    order = np.argsort(ghost.frame, kind="stable")
    ghost = PlainPeople(*(getattr(ghost, name)[order] for name in ("frame", "joints", "person")))
    found = over_time(ghost, 25.0)
    assert len(np.unique(found.person)) == 2
    assert found.joints[..., 1].max() < 2


@pytest.mark.slow
def test_stage_two_helps_whom_the_views_see_badly():
    """What the project promises; misses are frequent here, so that few frames hold enough doubtful joints."""
    scene = built_in_scene(1000, frames=10)
    detections = simulate(scene, DetectorConfig(misses=3.0), seed=1000)
    config = replace(PipelineConfig(), temporal=False)
    before, after = initial_proposals(detections, scene.rig, config), reconstruct(detections, scene.rig, config)
    error = np.full((2, *scene.keypoints.shape[:3]), np.nan)
    confidence = np.zeros(error.shape[1:])
    for table, people in zip(error, (before, after), strict=True):
        found = match_people(people.frame, people.joints, scene.keypoints)
        at = (found.frame, found.person)
        table[at] = np.linalg.norm(people.joints[found.row] - scene.keypoints[at], axis=-1)
    confidence[at] = after.confidence[found.row]  # the mean over views
    both = np.isfinite(error).all(axis=0)
    well, badly = error[:, both & (confidence >= 0.25)], error[:, both & (confidence < 0.25)]
    assert badly.shape[1] >= 20
    assert badly[1].mean() < 0.8 * badly[0].mean()
    assert well[1].mean() < well[0].mean()
