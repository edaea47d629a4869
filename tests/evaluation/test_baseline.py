"""The baseline: 2D grouping, matches between views, triangulation, and time."""

from dataclasses import replace

import numpy as np

from shapepose_fg.core.detections import Recording
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.baseline.cross_view import consistent_matches, geometric_affinity, people_of
from shapepose_fg.evaluation.baseline.over_time import OverTimeConfig, over_time
from shapepose_fg.evaluation.baseline.people import FoundPeople, find_everybody, people_in_frame
from shapepose_fg.evaluation.baseline.people_2d import people_in_views
from shapepose_fg.evaluation.baseline.reassociation import grown, nearest_given
from shapepose_fg.evaluation.baseline.triangulation import triangulate_robustly
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.simulation import built_in_scene, simulate


def test_what_is_seen_exactly_is_found_exactly(five_cameras, two_people, seen_exactly):
    joints, agree = people_in_frame(seen_exactly(five_cameras, two_people), five_cameras, BODY_25)
    assert agree.all()
    order = np.argsort(joints[:, 8, 0])
    np.testing.assert_allclose(joints[order], two_people, atol=1e-6)


def test_rays_of_one_person_meet_and_those_of_two_do_not(five_cameras, two_people, seen_exactly):
    people = people_in_views(seen_exactly(five_cameras, two_people), 25, 4)
    affinity = geometric_affinity(people, five_cameras, 0.08)
    # Who is who: the 2D person's neck is nearest to whose?
    necks, _ = five_cameras.project(two_people[:, 1])
    neck = people.found.xy[people.held[:, 1]]
    who = np.linalg.norm(necks[people.view] - neck[:, None], axis=-1).argmin(axis=1)
    same_view, same = people.view[:, None] == people.view, who[:, None] == who
    np.testing.assert_allclose(affinity[same & ~same_view], 1.0, atol=1e-6)
    assert affinity[~same].max() < 0.3
    assert (affinity[same_view] == 0).all()


def test_matches_agree_over_all_views():
    """Three views, two people. Between the first two views the wrong pairs look best of all; the third view knows
    better: 0.4 + 0.9 + 0.9 for each person against 0.95 + 0.9, and pairs taken one by one go wrong."""
    view = np.array([0, 0, 1, 1, 2, 2])
    pairs = {(0, 2): 0.4, (1, 3): 0.4, (0, 3): 0.95, (1, 2): 0.95}
    pairs |= {(0, 4): 0.9, (1, 5): 0.9, (2, 4): 0.9, (3, 5): 0.9}
    affinity = np.zeros((6, 6))
    for (a, b), value in pairs.items():
        affinity[a, b] = affinity[b, a] = value
    assert [0, 2, 4] not in [each.tolist() for each in people_of(affinity, view, 0.3)]
    matches = consistent_matches(affinity, view, rank_weight=1.0)
    assert [each.tolist() for each in people_of(matches, view, 0.3)] == [[0, 2, 4], [1, 3, 5]]
    np.testing.assert_allclose(matches, matches.T, atol=1e-3)
    assert matches.min() >= -1e-9
    assert matches.max() <= 1 + 1e-9
    in_each_view = np.stack([matches[:, view == each].sum(axis=1) for each in range(3)])
    np.testing.assert_allclose(in_each_view, 1.0, atol=0.05)


def test_a_wrong_view_is_left_out(five_cameras, two_people):
    """One of five views 20 cm off, another without the joint: the rest decide. Two that disagree: none."""
    xy, depth = five_cameras.project(two_people[:1])
    xy, confidence = np.moveaxis(xy, 0, 2), np.full((1, 25, 5), 0.8)
    far_px = 0.2 * five_cameras.focal_px[0] / depth[0, 0]
    xy[0, :, 0, 0] += far_px
    confidence[0, :, 1] = 0.0
    joints, agree = triangulate_robustly(xy, confidence, five_cameras, 0.1, 2)
    np.testing.assert_allclose(joints, two_people[:1], atol=1e-6)
    assert agree[0, :, 2:].all() and not agree[0, :, :2].any()
    assert np.isnan(triangulate_robustly(xy, confidence, five_cameras, 0.1, 4)[0]).all()
    confidence[0, :, 2:4] = 0.0
    # What is left: the view that is off, and one more. Their rays miss each other by more than the gate, or meet
    # where neither joint is; nowhere is the answer the true joint.
    joints, _ = triangulate_robustly(xy, confidence, five_cameras, 0.02, 2)
    assert not (np.linalg.norm(joints - two_people[:1], axis=-1) < 0.02).any()


def test_detections_that_grouping_mixed_are_put_right(five_cameras, two_people, seen_exactly):
    """In view 0 the right wrists are exchanged, and the left arm of one is not held: both come back."""
    found = seen_exactly(five_cameras, two_people)
    right = nearest_given(found, two_people, np.full((2, 25, 5), -1), five_cameras, 0.05)
    assert (right >= 0).all()
    held = right.copy()
    held[:, 4, 0] = held[::-1, 4, 0]
    np.testing.assert_array_equal(nearest_given(found, two_people, held, five_cameras, 0.05), right)
    unplaced = two_people.copy()
    unplaced[0, [6, 7]] = np.nan
    held = right.copy()
    held[0, [6, 7]] = -1
    np.testing.assert_array_equal(grown(found, unplaced, held), right)


def test_a_scene_frame_by_frame_and_over_time():
    """Ten frames of the demo: 99.3 % frame by frame when it was made, and nobody twice."""
    scene = built_in_scene(frames=10)
    seen = simulate(scene)
    people = find_everybody(seen, scene.rig)
    alone = joint_metrics(people, scene.keypoints)
    assert alone.f1 > 0.98 and alone.mpjpe_mm < 30 and alone.people_duplicated == 0
    followed = over_time(people, scene.fps)
    assert joint_metrics(followed, scene.keypoints).f1 >= alone.f1
    assert len(np.unique(followed.person)) == scene.people


def test_a_frame_in_which_nobody_is(five_cameras, two_people, seen_exactly):
    found = seen_exactly(five_cameras, two_people)
    nothing = found.only(np.zeros(len(found), dtype=bool))
    people = find_everybody(Recording(BODY_25, [nothing, found, nothing]), five_cameras)
    assert people.frame.tolist() == [1, 1]
    assert len(over_time(people, 25.0)) == 0  # a single frame is nobody over time


def walking(frames: int = 20) -> FoundPeople:
    """Two people who walk past each other, 0.6 m apart at the nearest, at 25 frames a second; 4 cm a frame."""
    rng = np.random.default_rng(0)
    body = rng.uniform(-0.1, 0.1, (25, 3))
    step = np.arange(frames)[:, None, None] * np.array([0.04, 0.0, 0.0])
    one, other = body + step, body + np.array([0.8, 0.6, 0.0]) - step
    joints = np.stack([one, other], axis=1).reshape(-1, 25, 3)
    frame = np.repeat(np.arange(frames), 2)
    return FoundPeople(frame, np.tile([0, 1], frames), joints)


def test_people_keep_their_names_and_gaps_are_closed():
    people, config = walking(), OverTimeConfig(nearest_m=0.3, smooth_s=0.0)
    joints = people.joints.copy()
    joints[20, 4] = np.nan  # a wrist is missing for a frame,
    joints[24, 4] += 0.5  # and in another it jumps
    kept = np.arange(len(joints)) != 16  # nobody sees the first person in frame 8
    gaps = FoundPeople(people.frame[kept], people.person[kept], joints[kept])
    found = over_time(gaps, 25.0, config)
    np.testing.assert_array_equal(found.frame, people.frame)
    np.testing.assert_array_equal(found.person, people.person)
    np.testing.assert_allclose(found.joints, people.joints, atol=1e-9)
    smoothed = over_time(gaps, 25.0, replace(config, smooth_s=0.04)).joints
    # A straight line stays one but for its ends, where the Gaussian has one side only.
    middle = (people.frame > 5) & (people.frame < 14)
    np.testing.assert_allclose(smoothed[middle], people.joints[middle], atol=1e-3)


def test_who_is_there_for_a_moment_was_nobody():
    people = walking()
    ghost = replace(
        people,
        frame=np.append(people.frame, [3, 4]),
        person=np.append(people.person, [2, 2]),
        joints=np.concatenate([people.joints, people.joints[:2] + np.array([0, 5, 0])]),
    )
    order = np.argsort(ghost.frame, kind="stable")
    ghost = FoundPeople(*(getattr(ghost, name)[order] for name in ("frame", "person", "joints")))
    found = over_time(ghost, 25.0, OverTimeConfig(nearest_m=0.3))
    assert len(np.unique(found.person)) == 2
    assert found.joints[..., 1].max() < 2
