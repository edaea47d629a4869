import cv2
import numpy as np

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.proposal.candidates import (
    CandidateConfig,
    triangulate_pairs,
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
