import cv2
import numpy as np
import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.proposal.candidates import (
    CandidateConfig,
    PairPoints,
    greedy_seeds,
    triangulate_pairs,
    vote,
)


def test_pairs_of_one_person_are_where_the_joints_are(five_cameras, two_people, seen_exactly):
    detections = seen_exactly(five_cameras, two_people[:1])
    points = triangulate_pairs(detections, five_cameras, CandidateConfig())
    # 10 pairs of views; nearly opposite cameras give parallel rays for some joints, which may be
    # dropped.
    assert 25 * 8 <= len(points.xyz) <= 25 * 10
    np.testing.assert_allclose(points.xyz, two_people[0][points.joint], atol=1e-6)
    np.testing.assert_allclose(points.score, 0.8)
    assert (detections.view[points.pair[:, 0]] != detections.view[points.pair[:, 1]]).all()


def test_agrees_with_opencv_s_linear_triangulation(five_cameras, two_people, seen_exactly):
    detections = seen_exactly(five_cameras, two_people[:1])
    noisy = detections.xy + np.random.default_rng(0).normal(0, 2.0, detections.xy.shape)
    detections = Detections(
        detections.view,
        detections.joint,
        noisy,
        detections.confidence,
        detections.pairs,
        detections.affinity,
    )
    points = triangulate_pairs(detections, five_cameras, CandidateConfig(min_angle_deg=20))
    for xyz, (first, second) in zip(points.xyz[::9], points.pair[::9], strict=True):
        views = detections.view[[first, second]]
        n = five_cameras.normalise(views, noisy[[first, second]])
        P = five_cameras.cTw[views]
        y = cv2.triangulatePoints(P[0], P[1], n[0].reshape(2, 1), n[1].reshape(2, 1))[:, 0]
        # OpenCV minimises over unit 4-vectors, ours over points: they differ in the second order of
        # 2 px.
        np.testing.assert_allclose(xyz, y[:3] / y[3], atol=1e-3)


def test_rays_that_meet_behind_a_camera_make_no_point():
    ahead = np.eye(4)
    ahead[0, 3] = 1.0
    from shapepose_fg.core.camera import Camera

    K = np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]])
    rig = Rig((Camera("a", K, np.eye(4), (1000, 800)), Camera("b", K, ahead, (1000, 800))), "z")
    view, joint = np.array([0, 1]), np.array([0, 0])
    none = np.zeros((0, 2), dtype=np.intp)
    diverging = Detections(
        view, joint, np.array([[300.0, 400], [700, 400]]), np.ones(2), none, np.zeros(0)
    )
    meeting = Detections(
        view, joint, np.array([[700.0, 400], [300, 400]]), np.ones(2), none, np.zeros(0)
    )
    assert len(triangulate_pairs(diverging, rig, CandidateConfig()).xyz) == 0
    np.testing.assert_allclose(
        triangulate_pairs(meeting, rig, CandidateConfig()).xyz, [[0.5, 0, 2.5]], atol=1e-9
    )


def one_by_one(points: PairPoints, radius_m: float) -> np.ndarray:
    """The paper's loop, word by word: most confident point, its neighbours, remove, repeat."""
    seed = np.full(len(points.xyz), -1)
    for pick in np.argsort(-points.score, kind="stable"):
        if seed[pick] < 0:
            near = np.linalg.norm(points.xyz - points.xyz[pick], axis=1) <= radius_m
            seed[near & (points.joint == points.joint[pick]) & (seed < 0)] = pick
    return seed


def test_voting_all_at_once_equals_one_by_one():
    rng = np.random.default_rng(0)
    centres = rng.uniform(-1, 1, (12, 3))
    xyz = centres[rng.integers(12, size=600)] + rng.normal(0, 0.08, (600, 3))
    points = PairPoints(
        xyz, rng.integers(3, size=600), np.zeros((600, 2), dtype=np.intp), rng.random(600)
    )
    np.testing.assert_array_equal(greedy_seeds(points, 0.12), one_by_one(points, 0.12))


def test_clusters_are_the_joints_and_know_their_support(five_cameras, two_people, seen_exactly):
    detections = seen_exactly(five_cameras, two_people)
    config = CandidateConfig()
    candidates = vote(triangulate_pairs(detections, five_cameras, config), detections, 5, config)
    strong = np.flatnonzero(candidates.strong)
    for person in two_people:
        for joint, xyz in enumerate(person):
            here = strong[candidates.joint[strong] == joint]
            distance = np.linalg.norm(candidates.xyz[here] - xyz, axis=1)
            assert distance.min() < 0.005
            nearest = here[distance.argmin()]
            support = candidates.support[candidates.support[:, 0] == nearest, 1]
            assert set(detections.view[support]) == set(range(5))
            assert (detections.joint[support] == joint).all()


def test_three_votes_but_two_cameras_have_one(five_cameras, two_people, seen_exactly):
    pair = Rig(five_cameras.cameras[:2], "z")
    detections = seen_exactly(pair, two_people[:1])
    config = CandidateConfig()
    points = triangulate_pairs(detections, pair, config)
    assert vote(points, detections, 2, config).strong.all()
    three = Rig(five_cameras.cameras[:3], "z")
    some = seen_exactly(three, two_people[:1])
    of_two = some.only(some.view < 2)
    weak = vote(triangulate_pairs(of_two, three, config), of_two, 3, config)
    assert len(weak) == 25 and not weak.strong.any(), "seen by two of three cameras: kept, but weak"


def test_nothing_seen_is_no_candidate(five_cameras):
    config = CandidateConfig()
    empty = Detections.empty()
    assert len(vote(triangulate_pairs(empty, five_cameras, config), empty, 5, config)) == 0


def test_refuses_settings_that_make_no_sense():
    with pytest.raises(ValueError, match="vote_radius_m must be positive"):
        CandidateConfig(vote_radius_m=0)
