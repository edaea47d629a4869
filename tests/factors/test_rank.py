import gtsam
import numpy as np
import pytest

from factors import determined, joint_information, project_with_jacobian, projection_factors


def _information(scene, joint, view, **kwargs):
    sigmas = np.full(len(view), 2.0)
    return joint_information(scene.points, joint, view, sigmas, scene.K, scene.cTw, **kwargs)


def test_the_information_is_that_of_the_graph(scene):
    view, joint = np.divmod(np.arange(12), 4)
    xy = np.array([scene.project(v, scene.points[j]) for v, j in zip(view, joint, strict=True)])
    graph = gtsam.NonlinearFactorGraph()
    for factor in projection_factors(scene.cameras, view, joint, xy, np.full(12, 2.0)):
        graph.add(factor)
    marginals = gtsam.Marginals(graph, scene.values(range(4)))
    information = _information(scene, joint, view)
    for j in range(4):
        np.testing.assert_allclose(
            information[j], marginals.marginalInformation(j), rtol=1e-9, atol=1e-6
        )


def test_two_views_determine_a_joint_and_one_does_not(scene):
    #           joint 0: two views, 1: one view, 2: the same view twice, 3: none
    joint, view = np.array([0, 0, 1, 2, 2]), np.array([0, 1, 0, 2, 2])
    np.testing.assert_array_equal(
        determined(_information(scene, joint, view)), [True, False, False, False]
    )


def test_a_prior_determines_what_views_do_not(scene):
    prior = np.zeros((4, 3, 3))
    prior[1] = np.eye(3) / 0.1**2
    prior[3] = np.diag([1.0, 1.0, 0.0]) / 0.1**2
    information = _information(scene, np.array([0, 1]), np.array([0, 0]), prior_information=prior)
    np.testing.assert_array_equal(determined(information), [False, True, False, False])


def test_a_joint_on_the_line_through_both_cameras_is_not_determined(scene):
    a, b = scene.wTc[:2, :3, 3]
    forward = (b - a) / np.linalg.norm(b - a)
    wTc = scene.wTc[:2].copy()
    for v, direction in ((0, forward), (1, -forward)):
        right = np.cross(direction, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        wTc[v, :3, :3] = np.stack([right, np.cross(direction, right), direction], axis=1)
    between = np.stack([0.5 * (a + b), 0.5 * (a + b) + [0, 0, 0.3]])
    cTw = np.linalg.inv(wTc)[:, :3]
    joint, view = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    information = joint_information(between, joint, view, np.full(4, 2.0), scene.K[:2], cTw)
    np.testing.assert_array_equal(determined(information), [False, True])


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan, np.inf])
def test_a_sigma_that_is_none_is_refused(scene, sigma):
    with pytest.raises(ValueError, match="sigmas_px must be positive and finite"):
        joint_information(scene.points, [0, 0], [0, 1], [2.0, sigma], scene.K, scene.cTw)


def test_behind_a_camera_counts_nothing(scene):
    behind = scene.wTc[0, :3, 3] - 2.0 * scene.wTc[0, :3, 2]
    xy, depth, jacobian = project_with_jacobian(behind, scene.K[0], scene.cTw[0])
    assert depth < 0 and np.isnan(xy).all() and np.isnan(jacobian).all()
    information = joint_information(behind[None], [0], [0], [1.0], scene.K, scene.cTw)
    np.testing.assert_array_equal(information, np.zeros((1, 3, 3)))


def test_the_bounds_are_those_of_the_weakest_direction():
    information = np.stack([np.diag([1.0, 1, s**-2.0]) * 1e2 for s in (1.0, 9.9, 10.1)])
    np.testing.assert_array_equal(determined(information, max_sigma_m=1.0), [True, True, False])
    np.testing.assert_array_equal(determined(information, max_sigma_m=0.5), [True, False, False])
    stiff = np.diag([1e4, 1e4, 1e12])[None]
    assert not determined(stiff, max_condition=1e7)[0]
    assert determined(stiff, max_condition=1e9)[0]
    assert not determined(np.full((1, 3, 3), np.nan))[0]
    assert determined(np.zeros((0, 3, 3))).shape == (0,)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_marginals_agree_with_the_check(scene, count):
    """What the check refuses is what GTSAM refuses to give a covariance for, after LM said
    nothing.
    """
    view = np.arange(count)
    xy = np.array([scene.project(v, scene.points[0]) for v in view])
    graph = gtsam.NonlinearFactorGraph()
    for factor in projection_factors(scene.cameras, view, np.zeros(count, int), xy, np.ones(count)):
        graph.add(factor)
    start = gtsam.Values()
    start.insert(0, scene.points[0] + 0.05)
    solution = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    if determined(_information(scene, np.zeros(count, int), view))[0]:
        gtsam.Marginals(graph, solution).marginalCovariance(0)
    else:
        with pytest.raises(RuntimeError):
            gtsam.Marginals(graph, solution).marginalCovariance(0)
    assert count == 1 or determined(_information(scene, np.zeros(count, int), view))[0]
