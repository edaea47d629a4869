"""User factors on people whose bodies are in the graph: joints and bodies move as their
correlations say.
"""

from typing import Any, cast

import gtsam
import numpy as np
import pytest

from factors import isotropic
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.condensed_graph import gtsam_step
from shapepose_fg.estimation.estimator_config import WindowGraphConfig
from shapepose_fg.estimation.factor_solution import solve_with_factors
from shapepose_fg.estimation.person_graph import BodyGraph, graph_covariances, ordering
from shapepose_fg.estimation.user_factors import add_factors, functions_of
from tests.estimation.test_body_window import _person

WRIST, ELBOW, NECK = (BODY_25.index(name) for name in ("RWrist", "RElbow", "Neck"))
FRAMES = np.arange(12)
CONFIG = WindowGraphConfig()


def person(seed: int, number: int = 0) -> BodyGraph:
    window, _, start = _person(seed, track=number)
    state = window.solve(start)
    return BodyGraph(window, window.take(state, *gtsam_step(window, state)), widen=2.0)


def moved(one: BodyGraph, expected: np.ndarray, asked: list[int]) -> float:
    """How far joints of frame 5 are from where they are expected to go, as a share of the way."""
    now = one.window.joints(one.state)[5, asked]
    return float(np.linalg.norm(now - one.first[5, asked] - expected) / np.linalg.norm(expected))


def test_a_factor_between_two_joints_moves_all_as_the_correlations_say() -> None:
    """A linear factor r = x_b - x_a - d, against Kalman's update with the graph's covariance: of
    both ends, of a joint between them, and what is reported afterwards.
    """
    one = person(0)
    asked = [WRIST, NECK, ELBOW]
    keys = [int(one.keys[5, joint]) for joint in asked]
    prior = gtsam.Marginals(one.graph, one.values).jointMarginalCovariance(gtsam.KeyVector(keys))
    C = np.block([[prior.at(a, b) for b in keys] for a in keys])
    H, sigma = np.concatenate([np.eye(3), -np.eye(3), np.zeros((3, 3))], axis=1), 0.01
    off = np.array([0.01, -0.015, 0.01])
    apart = one.first[5, WRIST] - one.first[5, NECK] + off
    one.add(gtsam.BetweenFactorPoint3(keys[1], keys[0], apart, isotropic(3, sigma)), "apart")
    gain = C @ H.T @ np.linalg.inv(H @ C @ H.T + sigma**2 * np.eye(3))
    (found,) = solve_with_factors([one], CONFIG)
    assert moved(one, (gain @ off).reshape(3, 3), asked) < 0.15
    after = C - gain @ H @ C
    for n, joint in enumerate(asked):
        block = after[3 * n : 3 * n + 3, 3 * n : 3 * n + 3]
        np.testing.assert_allclose(
            found.covariance[5, joint], block, atol=0.1 * np.abs(block).max()
        )
    # Frames beside it learn of it by motion, people without factors do not.
    assert np.linalg.norm(one.window.joints(one.state)[6] - one.first[6], axis=1)[WRIST] > 0
    assert solve_with_factors([person(1)], CONFIG) == []


def test_a_factor_on_the_shape_moves_the_betas_and_the_joints() -> None:
    """The betas go where their marginal and the prior agree, and joints with them."""
    one = person(1)
    every = graph_covariances(one.graph, one.values, ordering([one], one.values))
    C, sigma = every[one.shape_key, one.shape_key], 0.1
    wanted = one.state.betas + 0.3 * np.sqrt(np.diag(C)).max() * np.eye(10)[0]
    gain = C @ np.linalg.inv(C + sigma**2 * np.eye(10))
    before, expected = one.state.betas, gain @ (wanted - one.state.betas)
    one.add(gtsam.PriorFactorVector(one.shape_key, wanted, isotropic(10, sigma)), "known shape")
    (found,) = solve_with_factors([one], CONFIG)
    np.testing.assert_allclose(
        one.state.betas - before, expected, atol=0.3 * np.abs(expected).max()
    )
    shape = 2.0 * found.marginals.shape
    np.testing.assert_allclose(np.diag(shape), np.diag(C - gain @ C), rtol=0.2)


def test_a_factor_on_a_pose_turns_the_body() -> None:
    """A known direction of the root, in one frame: the body turns there, in the axes of the
    world.
    """
    one = person(2)
    key, turn = int(one.body_keys[5]), np.array([0.0, 0.15, 0.0])
    body = np.array(one.values.atVector(key))
    sigmas = np.full(len(body), 1e3)
    sigmas[:3] = 1e-3
    known = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    upright = one.state.root[5]
    one.add(gtsam.PriorFactorVector(key, body + np.r_[turn, np.zeros(len(body) - 3)], known))
    assert len(solve_with_factors([one], CONFIG)) == 1
    turned = gtsam.Rot3.Logmap(gtsam.Rot3(one.state.root[5] @ upright.T))
    np.testing.assert_allclose(turned, turn, atol=0.02)


def test_the_whole_graph_agrees_with_the_solution() -> None:
    """GTSAM solves with the joints of user factors only. The graph with all joints, made when it is
    asked for, has the same minimum and the same marginals.
    """
    one = person(0)
    ends = int(one.keys[5, WRIST]), int(one.keys[5, NECK])
    apart = float(np.linalg.norm(one.first[5, WRIST] - one.first[5, NECK]))
    one.add(gtsam.RangeFactor3(*ends, apart + 0.03, isotropic(1, 0.01)), "apart")
    (found,) = solve_with_factors([one], CONFIG)
    step = one.graph.linearize(one.values).optimize()
    moves = [np.linalg.norm(step.at(key)) for key in one.keys.ravel().tolist()]
    assert len(moves) == one.keys.size and np.median(moves) < 5e-4 and max(moves) < 5e-3
    marginals = gtsam.Marginals(one.graph, one.values)
    for joint in (WRIST, ELBOW, BODY_25.index("LAnkle")):
        covariance = found.covariance[5, joint]
        np.testing.assert_allclose(
            marginals.marginalCovariance(int(one.keys[5, joint])), covariance,
            atol=0.02 * np.trace(covariance),
        )  # fmt: skip


def test_people_whom_a_factor_ties_are_one_graph_and_both_give_way() -> None:
    one, other, third = person(0, 0), person(3, 1), person(4, 2)
    for each in (one, other, third):
        each.people = [one, other, third]
    board, start = gtsam.symbol("b", 0), gtsam.Values()
    start.insert(board, one.first[5, WRIST])
    one.add(start)
    apart = one.first[5, WRIST] - other.first[5, WRIST]
    for each, to_board in ((one, np.zeros(3)), (other, apart + np.array([0.04, 0.0, 0.0]))):
        end = int(each.keys[5, WRIST])
        one.add(gtsam.BetweenFactorPoint3(end, board, to_board, isotropic(3, 0.005)), "board")
    found = solve_with_factors([one, other, third], CONFIG)
    assert {each.person.track for each in found} == {0, 1}
    moves = [(each.window.joints(each.state) - each.first)[5, WRIST, 0] for each in (one, other)]
    assert moves[0] > 0.005 and moves[1] < -0.005 and 0.02 < moves[0] - moves[1] < 0.041
    assert one.values.exists(board) and not third.values.exists(board)
    assert one.graph.size() == other.graph.size() > third.graph.size()
    np.testing.assert_array_equal(third.window.joints(third.state), third.first)


def test_a_velocity_is_that_of_the_positions() -> None:
    one = person(2)
    key = int(one.velocity_keys[6, WRIST])
    one.add(gtsam.PriorFactorPoint3(key, np.array([0.2, 0.0, 0.0]), isotropic(3, 0.01)), "speed")
    assert len(solve_with_factors([one], CONFIG)) == 1
    assert one.values.exists(key)
    assert one.values.atPoint3(key) == pytest.approx([0.2, 0.0, 0.0], abs=0.05)


def test_factors_that_cannot_be_met_leave_people_as_they_were() -> None:
    one = person(0)
    far = gtsam.PriorFactorPoint3(int(one.keys[5, WRIST]), np.full(3, 1e3), isotropic(3, 1e-3))
    factors, before = one.graph.size(), one.window.joints(one.state)
    one.add(far, "far")
    assert solve_with_factors([one], CONFIG) == [] and "diverged" in one.failure
    np.testing.assert_array_equal(one.window.joints(one.state), before)
    assert one.graph.size() == factors, "all joints, and not the factor"


def test_a_sigma_of_zero_is_refused() -> None:
    """Levenberg-Marquardt would leave such a factor unmet, and the person as solved."""
    one = person(0)
    right, left = one.keys[5, [WRIST, NECK]].tolist()
    robust = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(1.0), gtsam.noiseModel.Constrained.All(1)
    )
    for noise in (gtsam.noiseModel.Constrained.All(1), robust):
        with pytest.raises(ValueError, match=r"your factor \(box\) has a sigma of 0"):
            one.add(gtsam.RangeFactor3(right, left, 0.4, noise), "box")


def test_a_factor_that_cannot_be_computed_is_named() -> None:
    one = person(0)
    wrist = int(one.keys[5, WRIST])
    one.add(gtsam.PriorFactorPose3(wrist, gtsam.Pose3(), isotropic(6, 0.1)), "pose")
    with pytest.raises(ValueError, match=r"your factor \(pose\) on .* cannot be computed: .*Pose3"):
        solve_with_factors([one], CONFIG)
    one = person(0)
    one.add(gtsam.PriorFactorPoint3(wrist, np.full(3, np.nan), isotropic(3, 0.1)), "gap")
    assert solve_with_factors([one], CONFIG) == []
    assert "the error of your factor (gap) on" in one.failure and "frame 5" in one.failure


def test_what_is_no_factor_is_named() -> None:
    people = [person(0)]
    for wrong, words in (
        (lambda window, keys: None, "<lambda> returned a NoneType instead of factors"),
        (lambda window, keys: gtsam.NonlinearFactorGraph(), "returned a NonlinearFactorGraph"),
        (lambda window, keys: [3], "is a int: yield factors"),
    ):
        with pytest.raises(ValueError, match=words):
            add_factors(people, cast(Any, [wrong]))
    with pytest.raises(ValueError, match=r"must be a function \(window, keys\), or a list of them"):
        functions_of(cast(Any, "box"))


def test_an_inactive_factor_leaves_the_whole_graph() -> None:
    """A factor on a variable without a position is not solved, and the graph has all joints."""
    one = person(0)
    factors, board = one.graph.size(), gtsam.symbol("b", 0)
    start = gtsam.Values()
    start.insert(board, np.zeros(3))
    one.add(start)
    one.add(
        gtsam.BetweenFactorPoint3(int(one.keys[5, WRIST]), board, np.zeros(3), isotropic(3, 0.01))
    )
    one.ties.start = gtsam.Values()
    assert solve_with_factors([one], CONFIG) == []
    assert one.graph.size() == factors
