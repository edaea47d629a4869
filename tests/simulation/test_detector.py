"""The detector: exact without noise, and erring as its statistics say."""

import json
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.rendering import look_at
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation import DetectorConfig, Scene, built_in_scene, simulate
from shapepose_fg.simulation.detector import Detector
from shapepose_fg.simulation.detector_statistics import (
    JOINT_GROUP,
    LIMB_GROUP,
    DetectorStatistics,
    measured,
)
from shapepose_fg.simulation.visibility import FACE, Visibility, facing

LIMBS = np.array(BODY_25.limbs)
MIRROR = np.array(BODY_25.mirror)
BODY = np.setdiff1d(np.arange(25), FACE)
"""Joints that do not depend on which way a face looks."""
_, Y, Z = np.eye(3)
KEPT = replace(measured(), lost=np.zeros(2))
"""Nobody is lost as a whole."""
PLAIN = DetectorConfig(false_candidates=0.0, merging=0.0, swaps=0.0, captures=0.0, statistics=KEPT)
"""Errors and misses only."""


@pytest.fixture(scope="module")
def scene() -> Scene:
    return built_in_scene(seed=0, frames=10)


def crowd(count: int) -> tuple[Rig, np.ndarray]:
    """`count` point-like people far from each other, all seen by two cameras of a large image."""
    K = np.array([[900.0, 0, 2000], [0, 900.0, 2000], [0, 0, 1]])
    eyes = np.array([[0.0, -6, 1], [0.5, -6, 1]])
    cameras = [
        Camera(f"c{i}", K, look_at(eye, eye + 6 * Y, Z), (4000, 4000)) for i, eye in enumerate(eyes)
    ]
    spots = np.arange(count)[:, None] % 12 * np.array([1.0, 0, 0]) - (5.5, 0, 0)
    joints = spots[:, None] + np.random.default_rng(0).uniform(-0.3, 0.3, (count, 25, 3))
    return Rig(tuple(cameras), up="z"), joints


def everything_seen(rig: Rig, people: int, seen: float = 1.0) -> Visibility:
    shape = (len(rig), people, 25)
    return Visibility(np.full(shape, seen), np.ones(shape, dtype=bool), np.full(shape, -1))


def nearest(found: Detections, rig: Rig, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Error (D, 2) px of each candidate against the nearest true joint of its label, and that
    person (D,).
    """
    truth = rig.project(joints)[0].transpose(0, 2, 1, 3)[found.view, found.joint]  # (D, P, 2)
    error = found.xy[:, None] - truth
    person = np.linalg.norm(error, axis=-1).argmin(axis=1)
    return error[np.arange(len(person)), person], person


def looks(
    rig: Rig, joints: np.ndarray, seen: Visibility, config: DetectorConfig, count: int
) -> list[Detections]:
    """First frames of `count` seeds: independent of each other."""
    return [
        Detector(rig, len(joints), 25.0, config, seed).detect(joints, seen) for seed in range(count)
    ]


def drawing(**tables: object) -> DetectorStatistics:
    """The measured statistics with other tables, and nobody lost as a whole."""
    return replace(KEPT, **tables)  # type: ignore[arg-type]


def test_without_noise_the_candidates_are_the_truth(scene: Scene):
    recording = simulate(scene, DetectorConfig.perfect(), seed=3)
    assert len(recording) == 10 and recording.skeleton is BODY_25
    for frame in (0, 9):
        found, joints = recording[frame], scene.truth_at(frame)
        xy, _ = scene.rig.project(joints)
        inside = ((xy >= 0) & (xy <= scene.rig.image_sizes[:, None, None] - 1)).all(axis=-1)
        assert len(found) == inside.sum()
        error, person = nearest(found, scene.rig, joints)
        assert np.abs(error).max() < 1e-6 and (found.confidence == 1).all()
        first, second = found.pairs.T
        limbs = {
            (int(a), int(b)) for a, b in zip(found.joint[first], found.joint[second], strict=True)
        }
        assert limbs == set(BODY_25.limbs)
        assert (found.view[first] == found.view[second]).all()
        assert (person[first] == person[second]).all() and (found.affinity == 1).all()


def test_the_same_seed_gives_the_same_bytes(scene: Scene):
    first, again, other = (simulate(scene, seed=seed, frames=range(3)) for seed in (1, 1, 2))
    for one, two in zip(first, again, strict=True):
        for name, value in vars(one).items():
            assert value.tobytes() == getattr(two, name).tobytes()
    assert len(first[0]) != len(other[0]) or not np.array_equal(first[0].xy, other[0].xy)


@pytest.mark.slow
def test_some_frames_come_out_as_in_the_whole_recording(scene: Scene):
    whole, some = simulate(scene, seed=4), simulate(scene, seed=4, frames=[2, 5, 6])
    for frame, found in zip([2, 5, 6], some, strict=True):
        for name, value in vars(found).items():
            assert value.tobytes() == getattr(whole[frame], name).tobytes()
    with pytest.raises(ValueError, match="in order"):
        simulate(scene, frames=[3, 2])


def test_candidates_come_in_no_order_that_tells_people_apart(scene: Scene):
    found = simulate(scene, DetectorConfig.perfect(), frames=[0])[0]
    _, person = nearest(found, scene.rig, scene.truth_at(0))
    # In order of persons there would be 3 changes a view and joint; shuffled, three in four
    # neighbours differ.
    assert 0.6 < np.mean(person[1:] != person[:-1]) < 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("seen", "state"), [(1.0, 0), (0.0, 1)])
def test_misses_and_confidences_are_as_measured(seen: float, state: int):
    rig, joints = crowd(12)
    frames = looks(rig, joints, everything_seen(rig, 12, seen), PLAIN, 60)
    joint = np.concatenate([found.joint for found in frames])
    confidence = np.concatenate([found.confidence for found in frames])
    table = measured()
    expected = 60 * 2 * 12
    for k in BODY:
        miss = table.miss[JOINT_GROUP[k], state]
        # Joints of one kind are independent of each other: five standard errors, 23 * 2 of which
        # are tried.
        share = (joint == k).sum() / expected
        assert abs(1 - share - miss) < 5 * np.sqrt(miss * (1 - miss) / expected), BODY_25.joints[k]
        if (joint == k).sum() > 300:
            # 300 or more draws of a confidence that spreads by 0.2: quantiles to 0.01 to 0.02.
            quantiles = table.confidence[JOINT_GROUP[k], state, [3, 5, 7]]
            found = np.quantile(confidence[joint == k], [0.1, 0.5, 0.9])
            np.testing.assert_allclose(found, quantiles, atol=0.05)


@pytest.mark.slow
def test_errors_are_as_large_as_their_confidence_says():
    rig, joints = crowd(12)
    table = drawing(floor_px=0.0)
    frames = looks(rig, joints, everything_seen(rig, 12), replace(PLAIN, statistics=table), 60)
    confidence = np.concatenate([found.confidence for found in frames])
    joint = np.concatenate([found.joint for found in frames])
    parts = [nearest(found, rig, joints) for found in frames]
    depth = np.concatenate([
        rig.project(joints)[1][found.view, person, found.joint]
        for found, (_, person) in zip(frames, parts, strict=True)
    ])  # fmt: skip
    error_m = np.concatenate([error for error, _ in parts]) * depth[:, None] / 900.0
    error_m /= table.joint_scale[JOINT_GROUP[joint]]
    for k, knot in enumerate(table.knots[3:], start=3):
        near = np.abs(confidence - knot) < 0.03
        assert near.sum() > 300
        # Half of the errors of sigma are below sigma * 1.1774, whatever the tail's scale does about
        # 1.
        median = np.median(np.linalg.norm(error_m[near], axis=1)) / 1.1774
        np.testing.assert_allclose(median, table.sigma_m[0, k], rtol=0.12)
    # Tails: the 90 % quantile of a Gaussian's length is 1.82 times its median.
    size = np.linalg.norm(error_m, axis=1) / np.exp(
        np.interp(confidence, table.knots, np.log(table.sigma_m[0]))
    )
    assert 1.9 < np.quantile(size, 0.9) / np.median(size) < 2.4
    # As often to the left as to the right; errors of one person and view go together, hence not
    # much nearer 0.
    assert np.abs(error_m.mean(axis=0)).max() < 0.002


@pytest.mark.slow
def test_errors_last_as_long_as_measured():
    rig, joints = crowd(12)
    table = drawing(tail=np.zeros_like(measured().tail))
    config = replace(PLAIN, misses=0.0, statistics=table)
    error, score = np.zeros((150, 2, 12, 25, 2)), np.zeros((150, 2, 12, 25))
    detector = Detector(rig, 12, 25.0, config, seed=0)
    for frame in range(150):
        found = detector.detect(joints, everything_seen(rig, 12))
        offset, person = nearest(found, rig, joints)
        at = frame, found.view, person, found.joint
        sigma = np.interp(found.confidence, table.knots, table.sigma_m[0])[:, None]
        error[at] = offset / sigma / table.joint_scale[JOINT_GROUP[found.joint]]
        score[at] = found.confidence
    score = np.argsort(np.argsort(score, axis=None)).reshape(score.shape) - score.size / 2
    for values, memory in (
        (error[:, :, :, BODY], table.error_memory),
        (score[..., BODY], table.confidence_memory),
    ):
        for lag in (1, 5, 25):
            found_there = (values[lag:] * values[:-lag]).mean() / (values**2).mean()
            expected = (memory[:, 0] * np.exp(-lag / 25.0 / memory[:, 1])).sum()
            # 24 views of people, each about 3 independent spells long: 0.1. Ranks hold joints of
            # unlike confidence, which stay unlike: more correlated, never less.
            assert expected - 0.1 < found_there < expected + (0.1 if values.ndim == 5 else 0.5)
    assert 0.5 < (error[1:] * error[:-1]).mean() / (error**2).mean() < 0.95


def test_joints_are_swapped_with_their_mirror_as_often_as_configured():
    rig, joints = crowd(12)
    config = replace(DetectorConfig.perfect(), swaps=1.0, statistics=drawing(swap=0.1, double=0.0))
    wrong = total = 0
    xy, depth = rig.project(joints)
    apart = np.linalg.norm(xy - xy[:, :, MIRROR], axis=-1) * depth / 900.0 > 0.12
    for found in looks(rig, joints, everything_seen(rig, 12), config, 20):
        # Named like the mirror, where the joint is: a swap, and nothing else is off.
        error, _ = nearest(found, rig, joints)
        off = np.linalg.norm(error, axis=1) > 1e-6
        there, _ = nearest(replace(found, joint=MIRROR[found.joint]), rig, joints)
        assert np.abs(there[off]).max() < 1e-6
        wrong, total = wrong + off.sum(), total + apart.sum()
    assert abs(wrong / total - 0.1) < 5 * np.sqrt(0.1 * 0.9 / total)


def test_joints_are_found_under_both_names_as_often_as_configured():
    rig, joints = crowd(12)
    table = drawing(swap=0.0, double=0.1, double_m=0.02)
    config = replace(DetectorConfig.perfect(), swaps=1.0, statistics=table)
    xy, depth = rig.project(joints)
    apart = np.linalg.norm(xy - xy[:, :, MIRROR], axis=-1) * depth / 900.0 > 0.12
    extra, gaps = 0, []
    for found in looks(rig, joints, everything_seen(rig, 12), config, 20):
        error, _ = nearest(found, rig, joints)
        twice = np.linalg.norm(error, axis=1) > 1e-6
        assert len(found) == 2 * 12 * 25 + twice.sum()  # nothing is missing
        offset, person = nearest(replace(found, joint=MIRROR[found.joint]), rig, joints)
        metres_a_px = depth[found.view, person, MIRROR[found.joint]] / 900.0
        gaps.append(np.linalg.norm(offset, axis=1)[twice] * metres_a_px[twice])
        extra += twice.sum()
    total = 20 * apart.sum()
    assert abs(extra / total - 0.1) < 5 * np.sqrt(0.1 * 0.9 / total)
    assert np.isclose(
        np.median(np.concatenate(gaps)), 0.02 * 1.1774, rtol=0.15
    )  # some 600 lengths: 5 % each way
    # The share was measured on joints of which half or more is seen: the others are found once.
    hidden = looks(rig, joints, everything_seen(rig, 12, 0.4), config, 5)
    assert [len(found) for found in hidden] == [2 * 12 * 25] * 5


@pytest.mark.slow
@pytest.mark.parametrize(("seen", "hidden_by"), [(1.0, -1), (0.0, 0)])
def test_whom_others_hide_is_missed_as_a_whole(seen: float, hidden_by: int):
    """Joint 4 of every person, seen or hidden by another, where others hide nobody else, or 14
    further joints.
    """
    rig, joints = crowd(12)
    table = drawing(
        miss=np.full((14, 3), 0.2), buried_share=np.array([0.04, 0.6]), buried=np.array([0.0, 1.5])
    )
    shares = []
    for count in (0, 14):
        visibility = everything_seen(rig, 12)
        visibility.seen[..., 10 : 10 + count], visibility.hidden_by[..., 10 : 10 + count] = 0.0, 0
        visibility.seen[..., 4], visibility.hidden_by[..., 4] = seen, hidden_by
        frames = looks(rig, joints, visibility, replace(PLAIN, statistics=table), 40)
        shares.append(1 - sum((found.joint == 4).sum() for found in frames) / (40 * 24))
    hidden = (14 + (hidden_by >= 0)) / 25
    buried = np.interp(hidden, table.buried_share, table.buried)
    for share, expected in zip(shares, (0.2, ndtr(ndtri(0.2) + buried)), strict=True):
        assert abs(share - expected) < 4 * np.sqrt(expected * (1 - expected) / 960)


@pytest.mark.slow
def test_people_are_lost_as_wholes():
    rig, joints = crowd(12)
    table = drawing(
        miss=np.full((14, 3), 0.025),
        lost=np.array([0.2, 0.1]),
        lost_correlation=np.full((25, 25), 1.0),
    )
    missed = []
    for found in looks(
        rig, joints, everything_seen(rig, 12), replace(PLAIN, noise=0.0, statistics=table), 40
    ):
        count = np.zeros((2, 12))
        np.add.at(count, (found.view, nearest(found, rig, joints)[1]), 1)
        missed.append(1 - count.ravel() / 25)
    missed = np.concatenate(missed)
    # 960 people in views: four standard errors, and as much again since single joints are missed by
    # chance too.
    assert abs((missed > 0.5).mean() - 0.2) < 0.1
    assert abs((missed > 0.8).mean() - 0.1) < 0.08
    assert (
        np.median(missed) < missed.mean() / 2
    )  # joints that are lost one by one would make them equal


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_a_missed_joint_is_captured_by_who_hides_it(share: float):
    """Person 1's right wrist is behind person 0: his elbow is joined to the wrist in front, or to
    none.
    """
    rig, joints = crowd(2)
    elbow, wrist = 3, 4
    visibility = everything_seen(rig, 2)
    visibility.seen[:, 1, wrist], visibility.hidden_by[:, 1, wrist] = 0.0, 0
    miss = np.zeros((14, 3))
    miss[JOINT_GROUP[wrist], 2] = 1.0
    table = drawing(miss=miss, capture=np.full(len(measured().capture), share))
    config = replace(
        DetectorConfig.perfect(), misses=1.0, captures=1.0, wrong_affinities=1.0, statistics=table
    )
    taken = []
    for found in looks(rig, joints, visibility, config, 100):
        assert len(found) == 2 * 2 * 25 - 2
        _, person = nearest(found, rig, joints)
        first, second = found.pairs.T
        of_arm = (
            (found.joint[first] == elbow) & (found.joint[second] == wrist) & (person[first] == 1)
        )
        assert (person[second[of_arm]] == 0).all()
        taken.append(of_arm.sum() / 2)
    assert abs(np.mean(taken) - share) <= 5 * np.sqrt(share * (1 - share) / 200)


def test_near_candidates_of_one_joint_merge_into_one_that_belongs_to_both():
    rig, joints = crowd(1)
    pair = np.concatenate([joints, joints])
    pair[1, [4, 10]] += (0.01, 0.0, 0.0)  # a wrist and a knee in the same place, the rest elsewhere
    pair[1, [k for k in range(25) if k not in (4, 10)]] += (1.5, 0.0, 0.0)
    table = drawing(merge_px=8.0, merge_height_px=4000.0, merge_width_px=0.1)
    config = replace(DetectorConfig.perfect(), merging=1.0, statistics=table)
    found = Detector(rig, 2, 25.0, config).detect(pair, everything_seen(rig, 2))
    count = np.zeros((2, 25), dtype=int)
    np.add.at(count, (found.view, found.joint), 1)
    expected = np.full(25, 2)
    expected[[4, 10]] = 1
    np.testing.assert_array_equal(count, np.tile(expected, (2, 1)))
    wrist = np.flatnonzero((found.joint == 4) & (found.view == 0))
    assert (
        len(found.affinity[(found.pairs[:, 1] == wrist) & (found.affinity > 0.5)]) == 2
    )  # both elbows


@pytest.mark.slow
def test_false_candidates_are_as_many_as_measured_and_belong_to_nobody():
    rig, joints = crowd(1)
    config = replace(DetectorConfig.perfect(), false_candidates=3.0)
    table = measured()
    extra = [len(found) - 50 for found in looks(rig, joints, everything_seen(rig, 1), config, 300)]
    rate = 3.0 * 2 * (table.false_near + table.false_far)
    # Of those in the background, the few behind the person are covered.
    assert (
        rate - 0.05 * rate - 4 * np.sqrt(rate / 300)
        < np.mean(extra)
        < rate + 4 * np.sqrt(rate / 300)
    )
    nobody = looks(rig, np.zeros((0, 25, 3)), everything_seen(rig, 0), config, 20)
    assert sum(map(len, nobody)) > 0 and all(len(found.affinity) == 0 for found in nobody)


def test_false_candidates_stay_a_while():
    rig, joints = crowd(1)
    config = replace(DetectorConfig.perfect(), false_candidates=400.0)
    detector = Detector(rig, 0, 25.0, config, seed=1)
    places = [detector.detect(joints[:0], everything_seen(rig, 0)).xy[:, 0] for _ in range(60)]
    stay = sum(np.isin(now, later).sum() for now, later in pairwise(places)) / sum(
        map(len, places[:-1])
    )
    memory = measured().false_memory
    expected = (memory[:, 0] * np.exp(-1 / 25.0 / memory[:, 1])).sum()
    assert abs(stay - expected) < 0.04  # some 70 at a time, 60 times, each there for a few frames


def test_affinities_are_as_measured():
    rig, joints = crowd(12)
    # People who stand free are found with higher confidences than those on whom affinities were
    # measured: here the affinities of right pairs do not go with them.
    table = drawing(affinity_correlation=0.0)
    config = replace(PLAIN, noise=0.0, statistics=table)
    right = {group: [] for group in range(14)}
    wrong = []
    for found in looks(rig, joints, everything_seen(rig, 12), config, 20):
        _, person = nearest(found, rig, joints)
        score = np.zeros((len(found), len(found)))
        score[tuple(found.pairs.T)] = found.affinity
        for limb, (a, b) in enumerate(LIMBS):
            first, second = np.flatnonzero(found.joint == a), np.flatnonzero(found.joint == b)
            same_view = found.view[first][:, None] == found.view[second]
            same = person[first][:, None] == person[second]
            scores = score[np.ix_(first, second)]
            right[LIMB_GROUP[limb]].append(scores[same_view & same])
            wrong.append(scores[same_view & ~same])
    for group, parts in right.items():
        # 300 draws or more that spread by 0.2: medians to 0.015, four of which are 0.06.
        assert abs(np.median(np.concatenate(parts)) - np.median(table.affinity_right[group])) < 0.06
    share = (np.concatenate(wrong) > 0).mean()
    assert 0 < share < 0.1  # neighbours are a metre apart, limbs up to 0.8 m


def test_surer_joints_have_higher_affinities():
    rig, joints = crowd(12)
    lower, affinity = [], []
    for found in looks(rig, joints, everything_seen(rig, 12), replace(PLAIN, noise=0.0), 5):
        _, person = nearest(found, rig, joints)
        first, second = found.pairs.T
        same = person[first] == person[second]
        lower.append(np.minimum(found.confidence[first], found.confidence[second])[same])
        affinity.append(found.affinity[same])
    ranks = [np.argsort(np.argsort(np.concatenate(parts))) for parts in (lower, affinity)]
    # As measured within limbs (0.73); limbs differ, which takes some of it away.
    assert np.corrcoef(ranks)[0, 1] > 0.5


def test_faces_are_not_found_from_behind():
    rig, joints = crowd(1)
    head = joints.copy()
    nose, right_eye, left_eye, right_ear, left_ear = FACE
    head[0, [right_ear, left_ear]] = [[-0.07, 0, 1.6], [0.07, 0, 1.6]]
    head[0, [nose, right_eye, left_eye]] = [
        [0.0, -0.11, 1.6],
        [-0.03, -0.1, 1.63],
        [0.03, -0.1, 1.63],
    ]
    cosine = facing(head, rig.centres)
    assert (cosine[:, 0, 0] > 0.9).all() and np.abs(cosine[:, 0, 3:]).max() < 0.2
    away = head * (1, -1, 1)
    seen = everything_seen(rig, 1)
    count = [
        sum(np.isin(f.joint, FACE[:3]).sum() for f in looks(rig, who, seen, PLAIN, 40))
        for who in (head, away)
    ]
    assert count[0] > 0.85 * 240 and count[1] < 0.2 * 240


@pytest.mark.slow
def test_larger_and_smaller_knobs_err_more_and_less(scene: Scene):
    def mean_error(noise: float) -> float:
        found = simulate(scene, replace(PLAIN, noise=noise, misses=0.0), frames=[0])[0]
        return float(np.linalg.norm(nearest(found, scene.rig, scene.truth_at(0))[0], axis=1).mean())

    assert mean_error(0.5) < mean_error(1.0) < mean_error(1.5)
    counts = [
        len(simulate(scene, replace(PLAIN, misses=misses), frames=[0])[0])
        for misses in (0.0, 1.0, 2.0)
    ]
    assert counts[0] > counts[1] > counts[2] > 0


@pytest.mark.parametrize(("people", "cameras"), [(0, 2), (1, 2), (5, 3), (12, 12)])
def test_any_number_of_people_and_cameras(people: int, cameras: int):
    scene = built_in_scene(2, people=people, cameras=cameras, frames=2)
    recording = simulate(scene)
    assert len(recording) == 2
    for found in recording:
        assert (found.view < cameras).all() and np.isfinite(found.xy).all()
        assert ((found.confidence > 0) & (found.confidence <= 1)).all()
        expected = people * cameras * 25
        assert 0.3 * expected <= len(found) <= expected + 5 * cameras + people * cameras


def test_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match="misses"):
        DetectorConfig(misses=-0.1)
    with pytest.raises(ValueError, match="captures"):
        DetectorConfig(captures=1.5)
    json.dumps(DetectorConfig().as_dict())  # goes into the record of a run


def test_the_shipped_statistics_are_whole():
    table = measured()
    for field in fields(table):
        assert field.name == "provenance" or np.isfinite(getattr(table, field.name)).all(), (
            field.name
        )
    for name in (
        "confidence",
        "affinity_right",
        "affinity_right_confidence",
        "affinity_wrong",
        "affinity_nobody",
    ):
        assert (np.diff(getattr(table, name), axis=-1) >= 0).all(), name
    for name in ("miss", "capture", "affinity_wrong_share", "affinity_nobody_share"):
        assert ((getattr(table, name) >= 0) & (getattr(table, name) <= 1)).all(), name
    assert (np.diff(table.buried) >= 0).all() and (np.diff(table.buried_share) > 0).all()
    assert 0 <= table.lost[1] < table.lost[0] < 1
    for memory in (
        table.error_memory,
        table.confidence_memory,
        table.false_memory,
        table.lost_memory,
    ):
        assert memory[:, 0].sum() <= 1 and (memory[:, 1] > 0).all()
    # What everybody knows of detectors: surer is nearer, hidden is missed more.
    assert (np.diff(table.sigma_m[0, ::2]) < 0).all()
    assert (table.miss[:, 2] > table.miss[:, 0]).all()
    probability = np.array([0.03, 0.3, 0.97])
    rows = np.broadcast_to(table.confidence[0, 0], (3, len(table.levels)))
    np.testing.assert_allclose(
        table.probability(rows, table.quantile(rows, probability)), probability, atol=1e-9
    )
