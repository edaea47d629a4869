"""Joints as chains: the compiled solution and covariances against dense matrices and against
GTSAM.
"""

import gtsam
import numpy as np
import pytest

from factors import CONSTANT_ACCELERATION, CONSTANT_VELOCITY
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.estimator_config import EstimatorConfig, WindowGraphConfig
from shapepose_fg.estimation.joint_chains import Chains, Projections
from shapepose_fg.estimation.linearisation import ObservationConfig
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.estimation.state_covariances import state_covariances
from shapepose_fg.estimation.window_graph import WindowGraph
from tests.marks import slow

LOST, FEET = 4, np.array([11, 22])
"""A joint that is lost for some frames, and two that stand."""


def linear(diagonal, below, right) -> Chains:
    """Chains without observations."""
    C, T, d = right.shape
    nobody = Views(np.eye(3)[None], np.eye(3, 4)[None])
    none = np.zeros((T, C, 1))
    seen = Projections(nobody, np.zeros((T, C, 1, 2)), none, none.astype(bool), none, None, 1.0)
    return Chains(
        np.arange(C), (0, 1), diagonal, below, right, np.ones((T, C, d // 3), dtype=bool), seen
    )


def test_a_chain_is_solved_and_inverted_as_its_matrix_is():
    """Seven states of six numbers against the dense inverse."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(2, 90, 42))
    band = np.abs(np.arange(42)[:, None] // 6 - np.arange(42) // 6) <= 1
    H = A.swapaxes(1, 2) @ A * band + 60 * np.eye(42)
    blocks, steps, right = (
        H.reshape(2, 7, 6, 7, 6).swapaxes(2, 3),
        np.arange(7),
        rng.normal(size=(2, 7, 6)),
    )
    chains = linear(*(blocks[:, steps[n:], steps[: 7 - n]].copy() for n in (0, 1)), right)
    start = np.zeros((7, 2, 3))
    expected = np.linalg.solve(H, right.reshape(2, 42, 1)).reshape(2, 7, 6)
    np.testing.assert_allclose(chains.solved(start), expected, rtol=1e-9, atol=1e-12)
    dense = np.linalg.inv(H).reshape(2, 7, 6, 7, 6).swapaxes(2, 3)[:, steps, steps].swapaxes(0, 1)
    for n, found in enumerate(chains.covariances(start)):
        part = slice(3 * n, 3 * n + 3)
        np.testing.assert_allclose(found, dense[..., part, part], rtol=1e-9, atol=1e-12)


def test_what_nothing_determines_is_nan_and_other_chains_are_not():
    """The middle one of three chains has a last state that hangs on nothing: it stays where it
    starts.
    """
    diagonal = np.tile(np.eye(6), (3, 3, 1, 1))
    diagonal[1, 2] = 0.0
    chains = linear(diagonal, np.zeros((3, 2, 6, 6)), np.ones((3, 3, 6)))
    start = np.full((3, 3, 3), 0.5)
    for found in chains.covariances(start):
        assert np.isnan(found[:, 1]).all()
        np.testing.assert_array_equal(found[:, [0, 2]], np.tile(np.eye(3), (3, 2, 1, 1)))
    states = chains.solved(start)
    np.testing.assert_array_equal(states[1, :, :3], start[:, 1])
    np.testing.assert_allclose(states[[0, 2]], 1.0)


def window_of(rig, truth, kernel="cauchy", law=CONSTANT_VELOCITY, moving=False, same=False):
    """A person's window of `truth` (T, 25, 3), seen with 3 px of noise, 25 frames a second; (T, 25,
    V) sigmas.

    `same`: the lost joint has the same noise in every frame.
    """
    rng, T, V = np.random.default_rng(0), len(truth), len(rig)
    noise = rng.normal(0, 3, (T, 25, V, 2))
    if same:
        noise[:, LOST] = noise[0, LOST]
    xy = np.moveaxis(rig.project(truth)[0], 0, 2) + noise
    xy[:, 7, 1] += 40.0
    sigmas = rng.uniform(3.0, 8.0, xy.shape[:3])
    seen = Observations(
        xy, np.full(sigmas.shape, 0.8), np.full((T, 25, 3), np.nan), np.zeros(T, dtype=int),
        np.arange(T), np.repeat(np.arange(T)[:, None] / 25, V, axis=1),
    )  # fmt: skip
    views = Views.of(rig)
    if moving:
        views = Views(views.K, np.tile(views.cTw, (T, 1, 1, 1)), views.image_sizes)
    config = EstimatorConfig(ObservationConfig(kernel=kernel), WindowGraphConfig())
    return WindowGraph(
        seen, sigmas, views, config, MotionModel.load(BODY_25.joints, law=law)
    ), sigmas


def test_a_joint_that_one_view_saw_takes_nothing_from_the_others(five_cameras, two_people):
    """The system is singular: its ray is one in all frames, and its depth not known in any; all
    else is.
    """
    truth = np.tile(two_people[0], (6, 1, 1))
    window, sigmas = window_of(five_cameras, truth, same=True)
    inlier = sigmas > 0
    inlier[:, LOST, 1:] = False
    nothing = JointTargets(np.zeros(truth.shape), np.zeros((*truth.shape, 3)))
    found = window.solve(inlier, nothing, nothing, truth)
    positions, velocities = state_covariances([window])[0]
    assert (
        window.failure == ""
        and np.linalg.norm(np.delete(found - truth, LOST, axis=1), axis=2).max() < 0.1
    )
    for covariance in (positions, velocities):
        known = np.isfinite(covariance).all(axis=(2, 3))
        assert known[:, np.arange(25) != LOST].all()
    # A rounding may leave a variance, of square metres.
    assert not (np.trace(positions[:, LOST], axis1=1, axis2=2) < 1.0).any()
    assert np.abs(found[:, LOST] - truth[:, LOST]).max() < 1.0


@pytest.mark.parametrize(
    ("kernel", "law"),
    [
        *((kernel, CONSTANT_VELOCITY) for kernel in ("none", "cauchy", "geman_mcclure", "tukey")),
        ("huber", CONSTANT_ACCELERATION),
        *slow(
            *(
                (kernel, CONSTANT_ACCELERATION)
                for kernel in ("none", "cauchy", "geman_mcclure", "tukey")
            )
        ),
    ],
)
def test_gtsam_ends_where_the_chains_do(five_cameras, two_people, kernel, law):
    """One of five views 40 px off, a joint that is lost, feet that stand: nothing is left for GTSAM
    to gain, and from elsewhere it comes back to the same joints.
    """
    rng, T = np.random.default_rng(0), 12
    truth = two_people[0] + 0.3 * np.linspace(0, 1, T)[:, None, None] * np.array([1.0, 0.0, 0.0])
    truth[:, FEET] = truth[:1, FEET]
    lost = np.zeros((T, 25), dtype=bool)
    lost[4:8, LOST] = True
    (window, sigmas), (other, _) = (
        window_of(five_cameras, truth, kernel, law, moving) for moving in (False, True)
    )
    body = JointTargets(
        truth + rng.normal(0, 0.02, truth.shape), np.tile(np.eye(3) / 0.03**2, (T, 25, 1, 1))
    )
    asked, optimizer = (
        (~lost[..., None] & (sigmas > 0), body, body, truth, lost, FEET),
        gtsam.LevenbergMarquardtOptimizer,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            gtsam, "LevenbergMarquardtOptimizer", lambda *_: pytest.fail("the start is far off")
        )
        found = window.solve(*asked)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-10)
    away = gtsam.Values()
    for key in window.values.keys():  # noqa: SIM118 - GTSAM's, not a dictionary's
        away.insert(key, window.values.atPoint3(key) + rng.normal(0, 0.01, 3))
    whole = optimizer(window.graph, away, parameters).optimize()
    again = np.array([[whole.atPoint3(key) for key in row] for row in window.keys.tolist()])
    # Costs are flat where they end: of all 300 joints together GTSAM may gain a seventh of a
    # standard deviation.
    assert abs(window.graph.error(window.values) - window.graph.error(whole)) < 1e-2
    np.testing.assert_allclose(again, found, atol=1e-3)
    np.testing.assert_allclose(other.solve(*asked), found, atol=1e-9)
    assert len({chains.parts for chains in window.chains}) == 2, "the lost joint has an offset"
    free = window_of(five_cameras, truth, kernel, law)[0].solve(*asked[:-1], FEET[:0])
    ranges = [np.ptp(each[:, FEET], axis=0).mean() for each in (found, free)]
    assert ranges[0] < 0.8 * ranges[1], "feet that stand move less than what their views say"
