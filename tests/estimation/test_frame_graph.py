"""The X step: one person's graph of a frame, against closed forms and against
SciPy.
"""

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from factors import DEFAULT_WIDTH_SIGMA, split_key
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.estimator_config import EstimatorConfig, WindowGraphConfig
from shapepose_fg.estimation.frame_graph import FrameGraph, state_covariances
from shapepose_fg.estimation.gated_views import ObservationConfig

EXACT = WindowGraphConfig(max_iterations=100, tolerance=1e-12)
"""Solved to the end, so that the comparison is with the minimum and not with the stopping rule."""
NO_PRIOR = np.zeros(25, dtype=bool)


@pytest.fixture(scope="module")
def person(
    five_cameras, two_people
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Truth (25, 3), observations (25, 5, 2) with 6 px of noise, sigmas (25, 5) of 4 to 12 px."""
    rng = np.random.default_rng(0)
    xy = np.moveaxis(five_cameras.project(two_people[0])[0], 0, 1)
    return two_people[0], xy + rng.normal(0, 6.0, xy.shape), rng.uniform(4.0, 12.0, xy.shape[:2])


def message(known, xyz, covariance) -> JointTargets:
    """What is said of the joints of `known` ([T,] J); the rest may be NaN."""
    information = np.zeros(np.shape(covariance))
    information[known] = np.linalg.inv(covariance[known])
    return JointTargets(np.reshape(xyz, (-1, 25, 3)), information.reshape(-1, 25, 3, 3))


def window_of(rig: Rig, xy, sigmas, config, kernel, frames, person=0) -> FrameGraph:
    """A person's graph of observations (T, 25, V, 2) in some frames, 0.1 s apart."""
    frame, V = np.array(frames), len(rig)
    seen = Observations(
        xy,
        np.full(sigmas.shape, 0.8),
        np.full((*sigmas.shape[:2], 3), np.nan),
        np.full(len(frame), person),
        frame,
        np.repeat(0.1 * np.arange(len(frame))[:, None], V, axis=1),
    )
    settings = EstimatorConfig(ObservationConfig(kernel=kernel or "none"), config)
    return FrameGraph(seen, sigmas, Views.of(rig), settings)


class OneFrame:
    """A window of one frame, gates and priors set one after the other, arrays without the frame's
    axis.
    """

    def __init__(self, rig: Rig, xy, sigmas, config, kernel, person, frame) -> None:
        self.window = window_of(rig, xy[None], sigmas[None], config, kernel, [frame], person)
        self.inlier = np.ones(sigmas.shape, dtype=bool)
        self.body = message(NO_PRIOR, np.zeros((25, 3)), np.zeros((25, 3, 3)))
        self.keys = self.window.keys[0]
        self.add = self.window.add

    def set_gates(self, inlier) -> None:
        self.inlier = inlier

    def set_priors(self, pulled, mean, covariance) -> None:
        self.body = message(pulled, mean, covariance)

    def solve(self, initial):
        return self.window.solve(self.inlier[None], self.body, initial[None])[0]

    def covariance(self):
        return state_covariances([self.window])[0][0]

    @property
    def graph(self):
        return self.window.graph


def graph_of(rig: Rig, xy, sigmas, config=EXACT, kernel=None, person=0, frame=0) -> OneFrame:
    return OneFrame(rig, xy, sigmas, config, kernel, person, frame)


def numeric_jacobian(rig: Rig, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """(V, 2, 3) pixels per metre, by central differences."""
    step = 1e-6 * np.eye(3)
    return np.stack(
        [(rig.project(point + h)[0] - rig.project(point - h)[0]) / 2e-6 for h in step], axis=-1
    )


def information_of(rig: Rig, points, sigmas) -> NDArray[np.float64]:
    J = np.stack([numeric_jacobian(rig, point) for point in points])
    return np.einsum(
        "jvki,jvkl,jv->jil", J, J, np.where(sigmas > 0, 1.0 / np.maximum(sigmas, 1e-9) ** 2, 0.0)
    )


@pytest.mark.parametrize("kernel", [None, "cauchy"])
def test_solution_is_the_minimum_of_the_robust_problem(five_cameras, person, kernel):
    """Every joint's cost minimised by SciPy's BFGS; one observation is 60 px off, so that the
    kernel matters.
    """
    truth, xy, sigmas = person
    xy = xy.copy()
    xy[:, 2, 0] += 60.0

    def cost(point: NDArray[np.float64], joint: int) -> float:
        squared = (
            np.sum((five_cameras.project(point)[0] - xy[joint]) ** 2, axis=1) / sigmas[joint] ** 2
        )
        if kernel is None:
            return 0.5 * squared.sum()
        width = DEFAULT_WIDTH_SIGMA[kernel] ** 2
        return 0.5 * width * np.log1p(squared / width).sum()

    solution = graph_of(five_cameras, xy, sigmas, kernel=kernel).solve(truth)
    for joint in range(0, 25, 4):
        best = minimize(cost, truth[joint], args=(joint,), method="BFGS", options={"gtol": 1e-6})
        # A robust cost is flat, and BFGS has numeric gradients: 0.001 is a twentieth of a standard
        # deviation.
        assert abs(cost(solution[joint], joint) - best.fun) < 1e-3
        np.testing.assert_allclose(solution[joint], best.x, atol=2e-5 if kernel is None else 3e-3)


def test_the_kernel_makes_one_wrong_view_harmless(five_cameras, person):
    truth, xy, sigmas = person
    xy = xy.copy()
    xy[:, 2, 0] += 60.0
    off = {
        kernel: np.linalg.norm(
            graph_of(five_cameras, xy, sigmas, kernel=kernel).solve(truth) - truth, axis=1
        )
        for kernel in (None, "cauchy")
    }
    assert np.median(off["cauchy"]) < 0.65 * np.median(
        off[None]
    )  # 0.37 +- 0.06 over cameras and noise


def test_covariance_is_the_inverse_of_the_information(five_cameras, person):
    truth, xy, sigmas = person
    sigmas = np.where(np.random.default_rng(0).random(sigmas.shape) < 0.3, 0.0, sigmas)
    sigmas[:, :2] = np.maximum(sigmas[:, :2], 5.0)
    graph = graph_of(five_cameras, xy, sigmas)
    solution = graph.solve(truth)
    expected = np.linalg.inv(information_of(five_cameras, solution, sigmas))
    # The Jacobians are numeric ones, good to seven digits; two nearly opposite views lose a few
    # when inverted.
    np.testing.assert_allclose(graph.covariance(), expected, rtol=1e-4, atol=1e-9)


def test_covariance_is_the_scatter_of_the_solutions(five_cameras, two_people):
    """300 draws of the noise: the square of a normalised error has mean 3 per joint, here to within
    5 %.
    """
    rng = np.random.default_rng(0)
    xy = np.moveaxis(five_cameras.project(two_people[0])[0], 0, 1)
    sigmas = np.full(xy.shape[:2], 5.0)
    squares = []
    for _ in range(300 // 25):
        graph = graph_of(five_cameras, xy + rng.normal(0, 5.0, xy.shape), sigmas)
        error = graph.solve(two_people[0]) - two_people[0]
        squares.append(np.einsum("ji,jik,jk->j", error, np.linalg.inv(graph.covariance()), error))
    # The mean of 300 chi-square variables of 3 degrees has a standard deviation of sqrt(6 / 300) =
    # 0.14.
    assert np.mean(squares) == pytest.approx(3.0, abs=0.42)


def test_a_gated_observation_has_no_influence_and_comes_back(five_cameras, person):
    truth, xy, sigmas = person
    graph = graph_of(five_cameras, xy, sigmas)
    everything = graph.solve(truth)
    covariance = graph.covariance()
    gates = np.ones(sigmas.shape, dtype=bool)
    gates[4, 2] = gates[7] = False
    gates[7, :2] = True
    graph.set_gates(gates)
    fewer = graph.solve(truth)
    unseen = graph_of(
        five_cameras, np.where(gates[..., None], xy, 9999.0), np.where(gates, sigmas, 0.0)
    )
    np.testing.assert_allclose(fewer, unseen.solve(truth), atol=1e-9)
    np.testing.assert_allclose(graph.covariance(), unseen.covariance(), rtol=1e-7, atol=1e-15)
    moved = np.linalg.norm(fewer - everything, axis=1) > 1e-4
    assert np.flatnonzero(moved).tolist() == [4, 7]
    graph.set_gates(np.ones_like(gates))
    np.testing.assert_allclose(graph.solve(truth), everything, atol=1e-9)
    np.testing.assert_allclose(graph.covariance(), covariance, rtol=1e-7, atol=1e-15)


def random_covariances(count: int, scale_m: float) -> NDArray[np.float64]:
    roots = np.random.default_rng(0).normal(0, scale_m, (count, 3, 3))
    return roots @ roots.swapaxes(1, 2) + scale_m**2 * np.eye(3)


def test_a_prior_alone_is_the_answer(five_cameras, person):
    truth, xy, _ = person
    graph = graph_of(five_cameras, xy, np.zeros(xy.shape[:2]))
    covariance = random_covariances(25, 0.05)
    graph.set_priors(np.ones(25, dtype=bool), truth, covariance)
    np.testing.assert_allclose(graph.solve(truth + 0.3), truth, atol=1e-9)
    np.testing.assert_allclose(graph.covariance(), covariance, rtol=1e-8)


def test_a_prior_and_one_view_are_fused_as_gaussians_are(five_cameras, person):
    """Covariance (P^-1 + J^T J / sigma²)^-1; linearised at the solution, the mean is exact too."""
    truth, xy, sigmas = person
    sigmas = np.where(np.arange(5) == 1, sigmas, 0.0)
    mean, covariance = (
        truth + np.random.default_rng(1).normal(0, 0.03, truth.shape),
        random_covariances(25, 0.04),
    )
    graph = graph_of(five_cameras, xy, sigmas)
    graph.set_priors(np.ones(25, dtype=bool), mean, covariance)
    solution = graph.solve(mean)
    information = information_of(five_cameras, solution, sigmas)
    prior = np.linalg.inv(covariance)
    np.testing.assert_allclose(
        graph.covariance(), np.linalg.inv(prior + information), rtol=1e-5, atol=1e-10
    )
    # Linearised at the solution: x = (prior + information)^-1 (prior mean + information target).
    J = (
        np.stack([numeric_jacobian(five_cameras, point)[1] for point in solution])
        / sigmas[:, 1, None, None]
    )
    r = (five_cameras.project(solution)[0][1] - xy[:, 1]) / sigmas[:, 1, None]
    right = np.einsum("jik,jk->ji", prior, mean) + np.einsum(
        "jki,jk->ji", J, np.einsum("jki,ji->jk", J, solution) - r
    )
    fused = np.linalg.solve(prior + information, right[..., None])[..., 0]
    # LM stops when the error falls by less than 1e-12: micrometres from the minimum.
    np.testing.assert_allclose(solution, fused, atol=1e-5)


def test_priors_pull_the_joints_they_are_set_for_and_are_taken_back(five_cameras, person):
    truth, xy, sigmas = person
    graph = graph_of(five_cameras, xy, sigmas)
    views_alone = graph.solve(truth)
    pulled = NO_PRIOR.copy()
    pulled[[2, 9]] = True
    mean, covariance = truth + 0.2, np.tile(1e-8 * np.eye(3), (25, 1, 1))
    graph.set_priors(pulled, np.where(pulled[:, None], mean, np.nan), covariance)
    with_priors = graph.solve(truth)
    np.testing.assert_allclose(with_priors[pulled], mean[pulled], atol=1e-3)
    np.testing.assert_allclose(with_priors[~pulled], views_alone[~pulled], atol=1e-9)
    others = NO_PRIOR.copy()
    others[3] = True
    graph.set_priors(others, mean, covariance)
    np.testing.assert_allclose(graph.solve(truth)[pulled], views_alone[pulled], atol=1e-9)
    graph.set_priors(NO_PRIOR, mean, covariance)
    np.testing.assert_allclose(graph.solve(truth), views_alone, atol=1e-9)


def test_weights_divide_the_covariances(five_cameras, person):
    truth, xy, sigmas = person
    plain = graph_of(five_cameras, xy, sigmas)
    plain.solve(truth)
    heavy = graph_of(
        five_cameras,
        xy,
        sigmas,
        WindowGraphConfig(weight_2d=4.0, max_iterations=100, tolerance=1e-12),
    )
    heavy.solve(truth)
    np.testing.assert_allclose(4.0 * heavy.covariance(), plain.covariance(), rtol=1e-6)
    body = graph_of(five_cameras, xy, 0.0 * sigmas, WindowGraphConfig(weight_shape=9.0))
    covariance = random_covariances(25, 0.05)
    body.set_priors(~NO_PRIOR, truth, covariance)
    body.solve(truth)
    np.testing.assert_allclose(9.0 * body.covariance(), covariance, rtol=1e-8)


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman_mcclure", "tukey"])
def test_the_weight_of_the_views_multiplies_their_cost_kernel_and_all(five_cameras, person, kernel):
    """One view is 60 px off, where every kernel bends: four times the weight is four times the
    cost.
    """
    truth, xy, sigmas = person
    xy = xy.copy()
    xy[:, 2, 0] += 60.0
    costs = []
    for weight in (1.0, 4.0):
        observed = xy[None], sigmas[None]
        config = WindowGraphConfig(weight_2d=weight, max_iterations=1)
        window = window_of(five_cameras, *observed, config, kernel, [0])
        none = JointTargets(np.zeros((1, 25, 3)), np.zeros((1, 25, 3, 3)))
        window.solve(observed[1] > 0, none, truth[None])
        values = gtsam.Values()
        for key in window.values.keys():  # noqa: SIM118 - GTSAM's, not a dictionary's
            values.insert(key, truth[split_key(key).joint] if key in window.keys else np.zeros(3))
        costs.append(window.graph.error(values))  # where nobody moves, so that motion costs nothing
    assert costs[1] == pytest.approx(4.0 * costs[0], rel=1e-9)


def test_a_factor_added_late_counts(five_cameras, person):
    """What was asked of the graph before does not matter."""
    _, xy, sigmas = person
    window = window_of(five_cameras, xy[None], sigmas[None], EXACT, None, [0])
    assert not window.touched.any()
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.01)
    for one, other in ((3, 4), (6, 7), (4, 2)):
        window.add(gtsam.RangeFactor3(*window.keys[0, [one, other]].tolist(), 0.3, noise))
    assert np.flatnonzero(window.touched).tolist() == [2, 3, 4, 6, 7]
    parts = [{joint for _, joint in part} for part in window.ties.parts]
    assert sorted(parts, key=sorted) == [{2, 3, 4}, {6, 7}]


def test_a_joint_that_is_not_known_is_left_out(five_cameras, person):
    truth, xy, sigmas = person
    sigmas, start = sigmas.copy(), truth.copy()
    sigmas[[4, 7]], start[[4, 7]] = 0.0, np.nan
    graph = graph_of(five_cameras, xy, sigmas)
    solution = graph.solve(start)
    unknown = np.isnan(solution).all(axis=1)
    assert np.flatnonzero(unknown).tolist() == [4, 7]
    np.testing.assert_array_equal(np.isnan(graph.covariance()).all(axis=(1, 2)), unknown)
    assert np.isfinite(solution[~unknown]).all() and np.isfinite(graph.covariance()[~unknown]).all()


def test_nothing_known_is_nothing_solved(five_cameras, person):
    _, xy, sigmas = person
    graph = graph_of(five_cameras, xy, 0.0 * sigmas)
    assert np.isnan(graph.solve(np.full((25, 3), np.nan))).all()
    assert np.isnan(graph.covariance()).all()


def test_people_and_frames_compose_into_one_graph(five_cameras, two_people):
    rng = np.random.default_rng(0)
    whole, values, alone = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
    for index, (name, frame) in enumerate([(0, 0), (1, 0), (0, 7)]):
        truth = two_people[index % 2]
        xy = np.moveaxis(five_cameras.project(truth)[0], 0, 1)
        sigmas = np.full(xy.shape[:2], 5.0)
        graph = graph_of(
            five_cameras,
            xy + rng.normal(0, 5, xy.shape),
            sigmas,
            kernel="cauchy",
            person=name,
            frame=frame,
        )
        gates = rng.random(sigmas.shape) < 0.9
        gates[:, :3] = True
        graph.set_gates(gates)
        assert [split_key(key) for key in graph.keys.tolist()] == [
            (name, joint, frame) for joint in range(25)
        ]
        alone.append((graph.keys, graph.solve(truth)))
        whole.push_back(graph.graph)
        for key, point in zip(graph.keys.tolist(), truth, strict=True):
            values.insert(key, point)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    together = gtsam.LevenbergMarquardtOptimizer(whole, values, parameters).optimize()
    assert together.size() == 75
    for keys, solution in alone:
        # A robust problem converges linearly: both stop some 10 um before the end.
        np.testing.assert_allclose(
            [together.atPoint3(key) for key in keys.tolist()], solution, atol=5e-5
        )


def test_a_bone_length_of_one_s_own_is_kept(five_cameras, person):
    """Elbow to wrist, 3 cm longer than truth, to within 0.1 mm: the views give way."""
    truth, xy, sigmas = person
    length = np.linalg.norm(truth[4] - truth[3]) + 0.03
    graph = graph_of(five_cameras, xy, sigmas, kernel="cauchy")
    views_alone = graph.solve(truth)
    elbow, wrist = graph.keys[[3, 4]].tolist()
    graph.add(gtsam.RangeFactor3(elbow, wrist, length, gtsam.noiseModel.Isotropic.Sigma(1, 1e-4)))
    for _ in range(2):  # it stays when gates and priors change
        solution = graph.solve(truth)
        assert np.linalg.norm(solution[4] - solution[3]) == pytest.approx(length, abs=2e-4)
        np.testing.assert_allclose(
            np.delete(solution, [3, 4], axis=0), np.delete(views_alone, [3, 4], axis=0), atol=1e-6
        )
        graph.set_gates(np.ones(sigmas.shape, dtype=bool))
        graph.set_priors(NO_PRIOR, truth, np.tile(np.eye(3), (25, 1, 1)))


def test_refuses_settings_that_make_no_sense():
    with pytest.raises(ValueError, match="weight_2d must be positive"):
        WindowGraphConfig(weight_2d=0.0)
    with pytest.raises(ValueError, match="rho_3d must be between 0 and 1"):
        WindowGraphConfig(rho_3d=1.5)


@pytest.mark.parametrize(("error", "failure"), [(RuntimeError, "singular"), (None, "diverged")])
def test_a_solver_that_fails_says_so_and_leaves_the_joints(
    five_cameras, person, monkeypatch, error, failure
):
    """GTSAM raises RuntimeError where its system is indeterminate, and may end with an error that
    is NaN.
    """
    truth, xy, sigmas = person

    class Failing(gtsam.LevenbergMarquardtOptimizer):
        def optimize(self):
            if error is not None:
                raise error("Indeterminant linear system")
            return super().optimize()

        def error(self):
            return np.nan

    monkeypatch.setattr(gtsam, "LevenbergMarquardtOptimizer", Failing)
    graph = OneFrame(five_cameras, xy, sigmas, EXACT, "cauchy", 0, 0)
    found = graph.solve(truth)
    assert failure in graph.window.failure
    assert np.isnan(graph.covariance()).all(), "of what is not solved nothing is known"
    if error is not None:
        np.testing.assert_array_equal(found, truth)


def test_an_empty_problem_after_a_failure_is_no_failure(five_cameras, person):
    truth, xy, sigmas = person
    graph = graph_of(five_cameras, xy, sigmas)
    graph.add(
        gtsam.PriorFactorPoint3(
            int(graph.keys[4]), np.full(3, np.nan), gtsam.noiseModel.Unit.Create(3)
        )
    )
    graph.solve(truth)
    assert graph.window.failure
    assert np.isnan(graph.solve(np.full((25, 3), np.nan))).all()
    assert graph.window.failure == ""


def test_of_a_joint_that_one_view_saw_there_is_no_covariance_and_the_others_have_theirs(
    five_cameras, person
):
    """Its depth is open, so that the whole system is singular; what hangs together with it is
    nothing.
    """
    truth, xy, sigmas = person
    graph = OneFrame(five_cameras, xy, sigmas, EXACT, None, 0, 0)
    inlier = np.ones(sigmas.shape, dtype=bool)
    graph.set_gates(inlier)
    graph.solve(truth)
    whole = graph.covariance()
    inlier[4, 1:] = False
    graph.set_gates(inlier)
    graph.solve(truth)
    covariance = graph.covariance()
    assert np.isnan(covariance[4]).all() and np.isfinite(whole).all()
    # With a prior of 100 m on each joint: a relative difference of (1 cm / 100 m)^2.
    np.testing.assert_allclose(
        np.delete(covariance, 4, axis=0), np.delete(whole, 4, axis=0), rtol=1e-5, atol=1e-10
    )


def test_what_is_known_to_more_than_ten_metres_is_not_determined(five_cameras, person):
    """In some direction: 11 m along x are too much, 9 m along every axis are not, and no path to it
    matters.
    """
    truth, xy, sigmas = person
    for whole_system_is_singular in (False, True):
        graph = graph_of(five_cameras, xy, np.where(np.arange(25)[:, None] == 6, sigmas, 0.0))
        inlier = np.ones(sigmas.shape, dtype=bool)
        inlier[6, 1:] = not whole_system_is_singular
        graph.set_gates(inlier)
        covariance = np.tile(1e-4 * np.eye(3), (25, 1, 1))
        covariance[4], covariance[5] = np.diag([11.0**2, 1e-4, 1e-4]), 9.0**2 * np.eye(3)
        graph.set_priors(np.isin(np.arange(25), [3, 4, 5]), truth, covariance)
        start = np.where(np.isin(np.arange(25), [3, 4, 5, 6])[:, None], truth, np.nan)
        graph.solve(start)
        determined = np.isfinite(graph.covariance()).all(axis=(1, 2))
        assert np.flatnonzero(determined).tolist() == [3, 5] + [6] * (not whole_system_is_singular)
