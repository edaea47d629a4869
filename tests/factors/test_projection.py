import gtsam
import numpy as np
import pytest

from factors import (
    assert_jacobian,
    assert_zero_at_truth,
    body_prior_factor,
    camera_key,
    in_front,
    inlier_gate,
    joint_key,
    joint_keys,
    make_calibration,
    make_camera,
    posed_projection_factor,
    projection_factor,
    projection_factors,
    robust_kernel,
)

KEY = joint_key(1, 4, 7)


def test_zero_at_truth_for_every_view(scene):
    point = scene.points[0]
    values = gtsam.Values()
    values.insert(KEY, point)
    for view, camera in enumerate(scene.cameras):
        # 1e-9 px: rounding of numbers of a thousand pixels.
        assert_zero_at_truth(
            projection_factor(camera, scene.project(view, point), 2.0, KEY), values
        )


def test_the_residual_is_projection_minus_measurement(scene):
    values = gtsam.Values()
    values.insert(KEY, scene.points[0])
    uv = scene.project(1, scene.points[0]) + np.array([3.0, -5.0])
    factor = projection_factor(scene.cameras[1], uv, 2.0, KEY)
    np.testing.assert_allclose(factor.unwhitenedError(values), [-3.0, 5.0], atol=1e-9)
    assert factor.error(values) == pytest.approx(0.5 * 34 / 4)


@pytest.mark.parametrize("kernel", [None, "huber", "cauchy", "geman_mcclure"])
def test_the_jacobian_is_the_numeric_one(scene, kernel):
    values = gtsam.Values()
    values.insert(KEY, scene.points[0])
    uv = scene.project(2, scene.points[0]) + np.array([3.0, -5.0])
    assert_jacobian(
        projection_factor(scene.cameras[2], uv, 2.0, KEY, robust_kernel(kernel)), values
    )


def test_a_batch_is_the_single_factor_many_times(scene):
    keys = joint_keys(0, np.arange(4))
    view, joint = np.divmod(np.arange(12), 4)
    xy = np.array([scene.project(v, scene.points[j]) for v, j in zip(view, joint, strict=True)])
    xy += np.random.default_rng(0).normal(scale=4.0, size=xy.shape)
    sigmas = np.linspace(1, 4, 12)
    kernel = robust_kernel("huber")
    batch = projection_factors(scene.cameras, view, keys[joint], xy, sigmas, kernel)
    values = scene.values(keys)
    for d, factor in enumerate(batch):
        single = projection_factor(
            scene.cameras[view[d]], xy[d], sigmas[d], int(keys[joint[d]]), kernel
        )
        assert factor.equals(single, 1e-12)
        assert factor.error(values) == single.error(values)
    assert projection_factors(scene.cameras, [], [], np.zeros((0, 2)), []) == []


def test_a_posed_camera_agrees_with_a_fixed_one(scene):
    point = scene.points[0]
    uv = scene.project(0, point) + np.array([1.0, 2.0])
    values = gtsam.Values()
    values.insert(KEY, point)
    values.insert(camera_key(0), gtsam.Pose3(scene.wTc[0]))
    factor = posed_projection_factor(make_calibration(scene.K[0]), uv, 2.0, camera_key(0), KEY)
    fixed = projection_factor(scene.cameras[0], uv, 2.0, KEY)
    np.testing.assert_allclose(
        factor.unwhitenedError(values), fixed.unwhitenedError(values), atol=1e-9
    )
    assert_jacobian(factor, values)
    by_key = dict(
        zip(
            factor.keys(),
            np.split(factor.linearize(values).jacobian()[0], [6], axis=1),
            strict=True,
        )
    )
    np.testing.assert_allclose(by_key[KEY], fixed.linearize(values).jacobian()[0], rtol=1e-9)


def test_a_camera_on_a_robot(scene):
    body_T_sensor = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, -0.2, 0.1), np.array([0.1, 0.2, -0.05]))
    wTbody = gtsam.Pose3(scene.wTc[0]).compose(body_T_sensor.inverse())
    values = gtsam.Values()
    values.insert(KEY, scene.points[0])
    values.insert(camera_key(0, 3), wTbody)
    uv = scene.project(0, scene.points[0])
    calibration = make_calibration(scene.K[0])
    factor = posed_projection_factor(
        calibration, uv, 2.0, camera_key(0, 3), KEY, robust_kernel("huber"), body_T_sensor
    )
    assert_zero_at_truth(factor, values)
    values.update(camera_key(0, 3), wTbody.retract(np.full(6, 0.01)))
    assert_jacobian(factor, values)


def test_triangulation_finds_the_truth_and_the_closed_form_covariance(scene):
    """A joint that V cameras see to 2 px: covariance (J^T W J)^-1, with J by differences of the
    pinhole.
    """
    point = scene.points[0]
    sigmas = np.array([2.0, 3.0, 1.5])
    xy = np.array([scene.project(v, point) for v in range(3)])
    graph = gtsam.NonlinearFactorGraph()
    for factor in projection_factors(scene.cameras, np.arange(3), np.full(3, KEY), xy, sigmas):
        graph.add(factor)
    start = gtsam.Values()
    start.insert(KEY, point + np.array([0.1, -0.2, 0.15]))
    solution = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    # Micrometres: LM stops at a relative decrease of 1e-5 of a cost that is already next to
    # nothing.
    np.testing.assert_allclose(solution.atPoint3(KEY), point, atol=1e-5)

    step = 1e-5 * np.eye(3)
    jacobian = np.concatenate(
        [
            np.stack([scene.project(v, point + d) - scene.project(v, point - d) for d in step], 1)
            / 2e-5
            / sigmas[v]
            for v in range(3)
        ]
    )
    expected = np.linalg.inv(jacobian.T @ jacobian)
    covariance = gtsam.Marginals(graph, solution).marginalCovariance(KEY)
    np.testing.assert_allclose(covariance, expected, rtol=1e-3, atol=1e-9)


def test_graphs_of_two_people_and_two_frames_compose(scene):
    """One graph with everyone in it gives each joint what its own graph gives."""
    groups = [(0, 0), (1, 0), (0, 1)]
    rng = np.random.default_rng(0)
    everyone, start, alone = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
    view, joint = np.divmod(np.arange(12), 4)
    for person, frame in groups:
        keys = joint_keys(person, np.arange(4), frame)
        moved = scene.points + rng.normal(scale=0.2, size=3)
        xy = np.array([scene.project(v, moved[j]) for v, j in zip(view, joint, strict=True)])
        xy += rng.normal(scale=2.0, size=xy.shape)
        graph, values = gtsam.NonlinearFactorGraph(), scene.values(keys)
        for factor in projection_factors(scene.cameras, view, keys[joint], xy, np.full(12, 2.0)):
            graph.add(factor)
        alone[person, frame] = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        everyone.push_back(graph)
        start.insert(values)
    together = gtsam.LevenbergMarquardtOptimizer(everyone, start).optimize()
    for person, frame in groups:
        for key in joint_keys(person, np.arange(4), frame).tolist():
            # Both stop by LM's relative tolerance of 1e-5, at costs of different size.
            np.testing.assert_allclose(
                together.atPoint3(key), alone[person, frame].atPoint3(key), atol=1e-4
            )


def test_behind_the_camera_the_factor_is_silent_and_the_gate_is_not(scene):
    camera = make_camera(scene.K[0], np.eye(4))
    values = gtsam.Values()
    values.insert(KEY, np.array([0.1, 0.2, -3.0]))
    factor = projection_factor(camera, [500.0, 400.0], 2.0, KEY)
    np.testing.assert_array_equal(factor.linearize(values).jacobian()[0], np.zeros((2, 3)))
    np.testing.assert_array_equal(in_front([-3.0, 0.0, 0.05, 0.1, 2.0, np.nan]), [0, 0, 0, 1, 1, 0])


def test_the_gate_of_equation_2():
    np.testing.assert_array_equal(
        inlier_gate([0.0, 9.99, 10.0, np.nan, np.inf], 10.0), [1, 1, 0, 0, 0]
    )
    with pytest.raises(ValueError, match="rho_2d_px"):
        inlier_gate([1.0], 0.0)


def test_misuse_says_what_is_wrong(scene):
    cameras = scene.cameras
    with pytest.raises(ValueError, match=r"xy \(D, 2\)"):
        projection_factors(cameras, [0], [KEY], np.zeros((1, 3)), [1.0])
    with pytest.raises(ValueError, match=r"must be \(D,\)"):
        projection_factors(cameras, [0, 1], [KEY], np.zeros((1, 2)), [1.0])
    with pytest.raises(ValueError, match="view must be 0 to 2"):
        projection_factors(cameras, [3], [KEY], np.zeros((1, 2)), [1.0])
    with pytest.raises(ValueError, match="view must be 0 to 2"):
        projection_factors(cameras, [-1], [KEY], np.zeros((1, 2)), [1.0])
    with pytest.raises(ValueError, match="not finite"):
        projection_factors(cameras, [0], [KEY], [[np.nan, 0.0]], [1.0])
    with pytest.raises(ValueError, match="finite pixels"):
        projection_factor(cameras[0], [np.inf, 0.0], 1.0, KEY)
    with pytest.raises(ValueError, match="wTc"):
        make_camera(scene.K[0], np.eye(3))
    with pytest.raises(ValueError, match="K must be"):
        make_camera(np.full((3, 3), np.nan), np.eye(4))


def test_a_prior_pulls_along_the_ray_of_a_single_camera(scene):
    """One camera and a prior: in the image the camera decides, in depth the prior."""
    point = scene.points[0]
    graph = gtsam.NonlinearFactorGraph()
    graph.add(projection_factor(scene.cameras[0], scene.project(0, point), 0.1, KEY))
    graph.add(body_prior_factor(KEY, point + np.array([0.05, 0.1, -0.05]), sigma_m=0.1))
    start = gtsam.Values()
    start.insert(KEY, point + 0.2)
    x = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize().atPoint3(KEY)
    assert np.linalg.norm(scene.project(0, x) - scene.project(0, point)) < 0.01  # px
    ray = (point - scene.wTc[0, :3, 3]) / np.linalg.norm(point - scene.wTc[0, :3, 3])
    # The prior's depth along the ray; the prior's offset is 0.12 m, its curvature over that small.
    assert (x - point) @ ray == pytest.approx(ray @ [0.05, 0.1, -0.05], abs=0.005)
