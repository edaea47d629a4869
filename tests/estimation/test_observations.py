"""What the views say of each joint: gates, weights, information; and joints that stage I missed."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from factors import joint_information, make_camera, projection_factors, robust_kernel
from shapepose_fg.core.camera import Camera, Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.gated_views import (
    ObservationConfig,
    linearise,
    mean_confidence,
    observation_sigmas,
    triangulate,
)


def observations_of(
    rig: Rig, people: NDArray[np.float64], noise_px: float = 0.0, seed: int = 0, initial=None
) -> Observations:
    """Everything seen by all views, with confidences from 0.3 to 1."""
    rng = np.random.default_rng(seed)
    xy = np.moveaxis(rig.project(people)[0], 0, 2)
    xy = xy + rng.normal(0, noise_px, xy.shape)
    return Observations(
        xy, rng.uniform(0.3, 1.0, xy.shape[:3]), people if initial is None else initial
    )


def without(observations: Observations, unseen: NDArray[np.bool_]) -> Observations:
    return Observations(
        np.where(unseen[..., None], 0.0, observations.xy),
        np.where(unseen, 0.0, observations.confidence),
        observations.initial,
    )


@pytest.fixture(scope="module")
def two_views() -> Rig:
    """One at the origin looks along z, one at (2, 0, 2) along -x: 1000 px, joints are 2 m from
    both.
    """
    K = np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]])
    side = np.array([[0.0, 0, -1, 2], [0, 1, 0, 0], [1, 0, 0, 2], [0, 0, 0, 1]])
    return Rig(
        (Camera("front", K, np.eye(4), (1000, 800)), Camera("side", K, side, (1000, 800))), "-y"
    )


def seen_at(rig: Rig, xy: NDArray[np.float64], point: NDArray[np.float64]) -> Observations:
    """One person with one joint thought to be at `point`, seen at `xy` (V, 2)."""
    return Observations(xy[None, None], np.ones((1, 1, len(rig))), point[None, None])


def test_sigma_is_the_detector_s_error_at_the_joint_s_depth(two_views):
    config = ObservationConfig(sigma_m=0.02, floor_rad=0.003)
    points = np.array([[[0.0, 0, 2], [0, 0, 1], [0, 0, np.nan]]])
    seen = Observations(
        np.zeros((1, 3, 2, 2)), np.array([[[1.0, 0.0], [1.0, 0.25], [1.0, 0.0]]]), points
    )
    sigma = observation_sigmas(
        seen, points, Views.of(two_views), config, ("Snout", "RAnkle", "Tail")
    )[0]
    # 2 cm are 10 px at 2 m and 20 px at 1 m; unknown joints are taken at the mean depth of the
    # others, 1.5 m.
    expected = np.hypot(3.0, [10.0, 20.0, 20.0 / 1.5])
    np.testing.assert_allclose(sigma[:, 0], expected)
    assert sigma[0, 1] == 0 and sigma[2, 1] == 0, "unseen"
    weight = (0.25**config.confidence_power + config.least_weight) / (1 + config.least_weight)
    assert sigma[1, 1] == pytest.approx(np.hypot(3.0, 10.0) / np.sqrt(weight)) and weight < 0.1, (
        "the less sure"
    )
    joints = ("MidHip", "RAnkle", "LEye")
    by_joint = observation_sigmas(seen, points, Views.of(two_views), config, joints)[0, :, 0]
    np.testing.assert_allclose(by_joint / expected, config.scatter(joints))
    assert by_joint[0] / expected[0] > 1.2 and by_joint[2] / expected[2] < 0.8, (
        "an eye is sharper than a hip"
    )
    alike = replace(config, by_joint=False)
    np.testing.assert_allclose(
        observation_sigmas(seen, points, Views.of(two_views), alike, joints)[0, :, 0], expected
    )


def test_the_paper_s_weight_is_the_confidence():
    paper = ObservationConfig(confidence_power=1.0, least_weight=0.0, by_joint=False)
    confidence = np.array([0.1, 0.5, 1.0])
    np.testing.assert_allclose(paper.weight(confidence), confidence)


@pytest.mark.parametrize("kernel", [None, "cauchy"])
def test_exact_observations_have_the_information_of_their_geometry(
    five_cameras, two_people, kernel
):
    """Residuals are zero, so every kernel's weight is one."""
    config = ObservationConfig(kernel=kernel)
    seen = observations_of(five_cameras, two_people)
    sigmas = observation_sigmas(seen, two_people, Views.of(five_cameras), config, BODY_25.joints)
    evidence = linearise(seen, sigmas, two_people, Views.of(five_cameras), config)
    joint, view = (index.ravel() for index in np.indices(sigmas.shape[1:]))
    for person in range(2):
        expected = joint_information(
            two_people[person],
            joint,
            view,
            sigmas[person].ravel(),
            five_cameras.K,
            five_cameras.cTw,
        )
        np.testing.assert_allclose(evidence.information[person], expected, rtol=1e-9, atol=1e-6)
    assert evidence.inlier.all()
    np.testing.assert_allclose(evidence.target, two_people, atol=1e-9)


@pytest.mark.parametrize("kernel", [None, "cauchy", "huber"])
def test_information_and_gradient_are_those_of_the_graph(five_cameras, two_people, kernel):
    """At a point beside the truth, with noise, a gated and an unseen observation: GTSAM's own
    linearisation.
    """
    config = ObservationConfig(kernel=kernel)
    rng = np.random.default_rng(1)
    seen = observations_of(five_cameras, two_people[:1], noise_px=8.0)
    unseen = rng.random(seen.confidence.shape) < 0.2
    seen = without(seen, unseen)
    seen.xy[0, 3, 1] += 300.0
    points = two_people[:1] + rng.normal(0, 0.02, (1, 25, 3))
    sigmas = observation_sigmas(seen, points, Views.of(five_cameras), config, BODY_25.joints)
    evidence = linearise(seen, sigmas, points, Views.of(five_cameras), config)
    assert not evidence.inlier[0, 3, 1] and 0.6 < evidence.inlier.mean() < 0.9
    cameras = [make_camera(camera.K, camera.wTc) for camera in five_cameras.cameras]
    joint, view = np.nonzero(evidence.inlier[0])
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for factor in projection_factors(
        cameras, view, joint, seen.xy[0, joint, view], sigmas[0, joint, view], robust_kernel(kernel)
    ):
        graph.add(factor)
    for key, point in enumerate(points[0]):
        values.insert(key, point)
    hessian, right = graph.linearize(values).hessian()
    blocks = hessian.reshape(25, 3, 25, 3)[np.arange(25), :, np.arange(25)]
    np.testing.assert_allclose(evidence.information[0], blocks, rtol=1e-7, atol=1e-4)
    np.testing.assert_allclose(evidence.gradient[0], -right.reshape(25, 3), rtol=1e-7, atol=1e-4)


def test_the_gate_is_rho_as_a_length_at_the_joint_s_depth(two_views):
    """15 cm at 2 m and 1000 px are 75 px."""
    config = ObservationConfig(rho_2d_m=0.15)
    point = np.array([0.0, 0.0, 2.0])
    centre = two_views.project(point)[0]
    for off_px, kept in ((74.999, True), (75.001, False)):
        for direction in ([1.0, 0.0], [0.0, -1.0], [0.6, 0.8]):
            seen = seen_at(two_views, centre + np.array([[off_px], [0.0]]) * direction, point)
            evidence = linearise(
                seen, np.full((1, 1, 2), 10.0), point[None, None], Views.of(two_views), config
            )
            assert evidence.inlier[0, 0].tolist() == [kept, True]
            np.testing.assert_allclose(np.linalg.norm(evidence.residual_px[0, 0, 0]), off_px)


def test_what_is_gated_says_nothing(two_views):
    point = np.array([0.0, 0.0, 2.0])
    xy = two_views.project(point)[0]
    config, sigmas = ObservationConfig(), np.full((1, 1, 2), 10.0)
    alone = without(seen_at(two_views, xy, point), np.array([[[False, True]]]))
    far = seen_at(two_views, xy + np.array([[0.0, 0.0], [400.0, 0.0]]), point)
    one = linearise(
        alone, np.array([[[10.0, 0.0]]]), point[None, None], Views.of(two_views), config
    )
    both = linearise(far, sigmas, point[None, None], Views.of(two_views), config)
    np.testing.assert_array_equal(one.information, both.information)
    np.testing.assert_array_equal(one.target, both.target)


def test_a_joint_behind_the_camera_is_not_seen_by_it(two_views):
    """Mirrored through the optical centre a point has the same pixels."""
    behind = np.array([0.1, 0.2, -2.0])
    mirrored = two_views.cameras[0].project(-behind)[0]
    seen = seen_at(two_views, np.stack([mirrored, [500.0, 400.0]]), behind)
    with np.errstate(all="raise"):
        evidence = linearise(
            seen,
            np.full((1, 1, 2), 10.0),
            behind[None, None],
            Views.of(two_views),
            ObservationConfig(),
        )
    assert not evidence.inlier[0, 0, 0]
    assert np.isfinite(evidence.information).all()


def test_a_joint_whose_place_is_not_known_has_no_evidence(five_cameras, two_people):
    points = two_people.copy()
    points[0, 4] = np.nan
    points[1] = np.nan
    seen = observations_of(five_cameras, two_people, initial=points)
    config = ObservationConfig()
    with np.errstate(all="raise"):
        sigmas = observation_sigmas(seen, points, Views.of(five_cameras), config, BODY_25.joints)
        evidence = linearise(seen, sigmas, points, Views.of(five_cameras), config)
    unknown = np.isnan(points).any(axis=-1)
    assert not evidence.inlier[unknown].any() and evidence.inlier[~unknown].all()
    assert (evidence.information[unknown] == 0).all() and (evidence.gradient[unknown] == 0).all()
    np.testing.assert_array_equal(np.isnan(evidence.target).all(axis=-1), unknown)


def test_one_view_moves_a_joint_onto_its_ray_and_leaves_the_depth(two_views):
    point = np.array([0.1, -0.05, 2.0])
    xy = two_views.project(point)[0] + [[6.0, -4.0], [0.0, 0.0]]
    seen = without(seen_at(two_views, xy, point), np.array([[[False, True]]]))
    evidence = linearise(
        seen,
        np.array([[[10.0, 0.0]]]),
        point[None, None],
        Views.of(two_views),
        ObservationConfig(kernel="none"),
    )
    target = evidence.target[0, 0]
    assert np.linalg.matrix_rank(evidence.information[0, 0], tol=1.0) == 2
    # The step is across the ray, and one Gauss-Newton step of 7 px is exact to its second order: 7²
    # / 1000 px.
    assert (target - point) @ point == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(two_views.cameras[0].project(target)[0], xy[0], atol=0.05)


def test_two_views_move_a_joint_where_they_meet(two_views):
    truth = np.array([0.1, -0.05, 2.0])
    seen = seen_at(two_views, two_views.project(truth)[0], truth)
    beside = truth + np.array([0.01, -0.02, 0.015])
    evidence = linearise(
        seen,
        np.full((1, 1, 2), 10.0),
        beside[None, None],
        Views.of(two_views),
        ObservationConfig(kernel="none"),
    )
    # 2.7 cm off at 2 m: the second order is 0.027² / 2 m.
    np.testing.assert_allclose(evidence.target[0, 0], truth, atol=5e-4)


def test_mean_confidence_counts_what_was_not_seen_or_is_discarded_as_zero():
    confidence = np.array([[[0.8, 0.4, 0.0], [0.9, 0.9, 0.9], [0.0, 0.0, 0.0]]])
    seen = Observations(np.zeros((1, 3, 3, 2)), confidence, np.zeros((1, 3, 3)))
    kept = np.array([[[True, True, False], [True, False, False], [False, False, False]]])
    np.testing.assert_allclose(mean_confidence(seen, kept), [[0.4, 0.3, 0.0]])


@pytest.mark.parametrize("views", [2, 3, 5])
def test_joints_that_stage_one_missed_are_triangulated(five_cameras, two_people, views):
    initial = two_people.copy()
    initial[0, 4] = initial[1, 14] = np.nan
    seen = observations_of(five_cameras, two_people, initial=initial)
    unseen = np.zeros(seen.confidence.shape, dtype=bool)
    unseen[:, [4, 14], views:] = True
    seen = without(seen, unseen)
    config = ObservationConfig()
    complete = triangulate(seen, Views.of(five_cameras), config)
    np.testing.assert_allclose(complete, two_people, atol=1e-4)
    known = np.isfinite(initial)
    np.testing.assert_array_equal(complete[known], initial[known])


def test_of_five_views_a_wrong_one_is_outvoted(five_cameras, two_people):
    initial = two_people.copy()
    initial[0, 4] = np.nan
    seen = observations_of(five_cameras, two_people, initial=initial)
    seen.confidence[...] = 0.8
    seen.xy[0, 4, 2] += 150.0
    config = ObservationConfig()
    complete = triangulate(seen, Views.of(five_cameras), config)
    # 150 px at 3.5 m and 900 px are 58 cm; plain least squares would be about a fifth of that off.
    np.testing.assert_allclose(complete[0, 4], two_people[0, 4], atol=0.05)


def test_what_too_few_or_contradicting_views_saw_stays_unknown(two_views):
    truth = np.array([0.1, -0.05, 2.0])
    unknown = np.full(3, np.nan)
    config = ObservationConfig()
    xy = two_views.project(truth)[0]
    both = seen_at(two_views, xy, unknown)
    np.testing.assert_allclose(
        triangulate(both, Views.of(two_views), config)[0, 0], truth, atol=1e-5
    )
    # Rays that pass each other a metre apart: both cameras are upright, so the height cannot be
    # explained away.
    contradicting = seen_at(two_views, xy + np.array([[0.0, 250.0], [0.0, -250.0]]), unknown)
    assert np.isnan(triangulate(contradicting, Views.of(two_views), config)).all()
    alone = without(both, np.array([[[False, True]]]))
    assert np.isnan(triangulate(alone, Views.of(two_views), config)).all()


def test_people_of_several_frames_follow_each_other(five_cameras, two_people):
    parts = [observations_of(five_cameras, two_people[:n], seed=n) for n in (1, 0, 2)]
    together = Observations.concatenate(parts)
    assert len(together) == 3
    np.testing.assert_array_equal(together.xy[1:], parts[2].xy)


def test_refuses_shapes_and_settings_that_make_no_sense():
    with pytest.raises(ValueError, match=r"confidence must be \(1, 2, 3\), got \(1, 2, 4\)"):
        Observations(np.zeros((1, 2, 3, 2)), np.zeros((1, 2, 4)), np.zeros((1, 2, 3)))
    with pytest.raises(ValueError, match="sigma_m must be positive"):
        ObservationConfig(sigma_m=0.0)
    with pytest.raises(ValueError, match="floor_rad must be between 0 and 1"):
        ObservationConfig(floor_rad=-1.0)


def test_cameras_may_differ_from_row_to_row(five_cameras, two_people):
    """The second row's cameras in reverse order: its evidence is that of a rig in that order."""
    order = np.stack([np.arange(5), np.arange(5)[::-1]])
    views = Views(five_cameras.K[order], five_cameras.cTw[order])
    seen = observations_of(five_cameras, two_people, noise_px=3.0)
    turned = Observations(
        np.stack([seen.xy[0], seen.xy[1, :, ::-1]]),
        np.stack([seen.confidence[0], seen.confidence[1, :, ::-1]]),
        seen.initial,
    )
    config, still = ObservationConfig(), Views.of(five_cameras)
    sigmas = observation_sigmas(seen, two_people, still, config, BODY_25.joints)
    swapped = observation_sigmas(turned, two_people, views, config, BODY_25.joints)
    np.testing.assert_allclose(swapped[1], sigmas[1, :, ::-1])
    one = linearise(seen, sigmas, two_people, still, config)
    other = linearise(turned, swapped, two_people, views, config)
    np.testing.assert_allclose(other.information, one.information)
    np.testing.assert_allclose(other.target, one.target)
    with pytest.raises(ValueError, match="same rows"):
        Views(five_cameras.K[order], five_cameras.cTw[order[:1]])
