"""The X step of frames by themselves: the kernel between rounds comes to where GTSAM does."""

import numpy as np
import pytest

from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.estimator_config import EstimatorConfig, WindowGraphConfig
from shapepose_fg.estimation.joint_step import solve_between, solve_joints
from shapepose_fg.estimation.linearisation import ObservationConfig, linearise, observation_sigmas
from shapepose_fg.estimation.window_graph import WindowGraph

BODY_ONLY, NOWHERE = 4, 7


@pytest.mark.parametrize("moving", [False, True], ids=["one rig", "a rig a row"])
@pytest.mark.parametrize("kernel", ["none", "cauchy"])
def test_the_kernel_and_the_graph_agree(five_cameras, two_people, kernel, moving):
    rng = np.random.default_rng(0)
    xy = np.moveaxis(five_cameras.project(two_people)[0], 0, 2)
    xy = xy + rng.normal(0, 3, xy.shape) + 25 * (rng.random(xy.shape[:3]) < 0.1)[..., None]
    confidence = rng.uniform(0.5, 1, xy.shape[:3])
    confidence[:, BODY_ONLY : NOWHERE + 1 : NOWHERE - BODY_ONLY] = 0.0
    seen = Observations(xy, confidence, two_people + rng.normal(0, 0.02, two_people.shape))
    views = Views.of(five_cameras)
    if moving:
        views = Views(views.K, np.repeat(views.cTw[None], 2, axis=0), views.image_sizes)
    solver = WindowGraphConfig(weight_2d=0.7, weight_shape=1.3, max_iterations=200, tolerance=1e-14)
    config = EstimatorConfig(ObservationConfig(kernel=kernel), solver)
    sigmas = observation_sigmas(seen, seen.initial, views, config.observations, BODY_25.joints)
    evidence = linearise(seen, sigmas, seen.initial, views, config.observations)
    roots = rng.normal(0, 10, (*two_people.shape, 3))
    pulled = roots @ roots.mT + 100 * np.eye(3)
    pulled[:, NOWHERE] = 0.0
    body = JointTargets(two_people + rng.normal(0, 0.05, two_people.shape), pulled)

    between = solve_between(seen, sigmas, views, evidence, body, config)
    for row in range(2):
        rows = np.array([row])
        person = WindowGraph(seen.rows(rows), sigmas[rows], views.rows(rows), config, rows)
        solve_joints([(person, slice(row, row + 1))], evidence, body, config)
        alone = person.positions
        # Detections and bodies are centimetres off; under the robust kernel the last steps are
        # short.
        np.testing.assert_allclose(between[rows], alone, atol=5e-4)
        solve_joints([(person, slice(row, row + 1))], evidence, body, config, between)
        again = person.positions
        np.testing.assert_allclose(again, alone, atol=5e-4)
    assert (
        np.isnan(between[:, NOWHERE]).all()
        and np.isfinite(np.delete(between, NOWHERE, axis=1)).all()
    )
    np.testing.assert_allclose(between[:, BODY_ONLY], body.xyz[:, BODY_ONLY], atol=1e-6)
    assert (
        np.linalg.norm(np.delete(between - seen.initial, [NOWHERE], axis=1), axis=-1).max() > 0.01
    )
