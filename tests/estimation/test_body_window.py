"""One model of a person over a window, bodies and joints together, against truth and against
GTSAM.
"""

import gtsam
import numpy as np
import pytest

from factors import CONSTANT_VELOCITY
from shapepose_fg.body.fitting.energy import BodyEnergy
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.body_window import BodyWindow
from shapepose_fg.estimation.condensed_graph import gtsam_step
from shapepose_fg.estimation.gated_views import ObservationConfig, observation_sigmas
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.estimation.person_graph import BodyGraph, graph_covariances, ordering
from shapepose_fg.estimation.reported_covariances import (
    CorrelatedErrors,
    correlation_features,
    covariance_factors,
)

T, CAMERAS = 12, 4


def _views() -> Views:
    K = np.tile(
        np.array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]]), (CAMERAS, 1, 1)
    )
    cTw = []
    for turn in np.linspace(0, 2 * np.pi, CAMERAS, endpoint=False):
        centre = np.array([5 * np.cos(turn), 1.0, 5 * np.sin(turn)])
        ahead = -centre / np.linalg.norm(centre)
        right = np.cross(ahead, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(ahead, right), ahead])
        cTw.append(np.concatenate([R, -R @ centre[:, None]], axis=1))
    return Views(K, np.array(cTw))


def _person(
    seed: int, hidden: float = 0.0, *, lasts: bool = False, step_s: float = 1 / 30
) -> tuple[BodyWindow, np.ndarray, np.ndarray]:
    """A window, its true joints (T, J, 3) and a start (T, P) near the truth; errors that last are
    those of the first frame.
    """
    rng, model, views = np.random.default_rng(seed), BodyModel.default(), _views()
    energy = BodyEnergy(model, PosePrior.default())
    free = np.zeros((T, energy.num_free))
    free[:, :10] = rng.normal(size=10)
    pose = PosePrior.default().sample(rng, 2).reshape(2, -1)[:, energy.angles]
    free[:, 13:-3] = pose[0] + np.linspace(0, 0.3, T)[:, None] * (pose[1] - pose[0])
    free[:, -3] = np.linspace(0, 0.4, T)
    truth = model.keypoints(energy.complete(free))
    xy = views.pixels(truth)[0]
    confidence = np.full(xy.shape[:-1], 0.8)
    confidence[rng.random(confidence.shape) < hidden] = 0.0
    names = tuple(model.keypoint_names)
    observations = Observations(
        xy, confidence, truth, track=np.zeros(T, dtype=np.intp), frame=np.arange(T),
        time_s=np.tile(step_s * np.arange(T, dtype=np.float64)[:, None], (1, CAMERAS)),
    )  # fmt: skip
    config = ObservationConfig()
    sigmas = observation_sigmas(observations, truth, views, config, names)
    noise = rng.normal(size=xy.shape)
    noisy = xy + (noise[:1] if lasts else noise) * sigmas[..., None]
    object.__setattr__(observations, "xy", noisy)
    window = BodyWindow(
        observations, sigmas, views, model, config, MotionModel.load(names), CONSTANT_VELOCITY
    )
    return window, truth, free + 0.05 * rng.normal(size=free.shape)


def _lasting(marginals) -> float:
    return float(CorrelatedErrors.measured().factor(*correlation_features(marginals)))


def test_joints_are_nearer_the_truth_than_their_views_alone() -> None:
    window, truth, start = _person(0)
    joints = window.joints(window.solve(start))
    alone = window.last.evidence.target
    assert (
        np.linalg.norm(joints - truth, axis=-1).mean()
        < 0.8 * np.linalg.norm(alone - truth, axis=-1).mean()
    )


@pytest.mark.parametrize("hidden", [0.0, 0.5])
def test_regions_hold_what_they_say(hidden: float) -> None:
    inside = []
    for seed in range(4):
        window, truth, start = _person(seed, hidden)
        state = window.solve(start)
        away = window.joints(state) - truth
        covariance = window.covariances(state).joints()
        inside.append(
            np.einsum("tji,tji->tj", away, np.linalg.solve(covariance, away[..., None])[..., 0])
            < 7.815
        )
    assert np.mean(inside) > 0.9


def test_covariances_grow_where_errors_last() -> None:
    factors, inside = dict[bool, list[float]](), dict[bool, list[np.ndarray]]()
    for lasts in (False, True):
        factors[lasts], inside[lasts] = [], []
        for seed in range(4):
            window, truth, start = _person(seed, lasts=lasts, step_s=0.2)
            state = window.solve(start)
            away, marginals = window.joints(state) - truth, window.covariances(state)
            factors[lasts].append(_lasting(marginals))
            covariance = factors[lasts][-1] * marginals.joints()
            whitened = np.linalg.solve(covariance, away[..., None])[..., 0]
            inside[lasts].append(np.einsum("tji,tji->tj", away, whitened) < 7.815)
    assert min(factors[True]) > 1.2 * max(factors[False])
    assert all(np.mean(each) > 0.8 for each in inside.values())


def test_a_window_with_another_person_s_detections_is_less_sure() -> None:
    factors = []
    for frames in (0, 2):
        window, _, start = _person(0)
        window.observations.xy[:frames, :8, 0] += 400.0  # another person's arms and head
        marginals = window.covariances(window.solve(start))
        factors.append(covariance_factors(marginals, 1.0)[0] / _lasting(marginals))
    assert factors[0] < 1.05 and factors[1] > 1.1 * factors[0]


def test_marginals_are_those_of_the_graph_and_its_step_moves_nothing() -> None:
    window, _, start = _person(1, 0.3)
    state = window.solve(start)
    covariance = window.covariances(state).joints()
    built = BodyGraph(window, state, 3, np.arange(T), widen=2.0).build()
    marginals = gtsam.Marginals(built.graph, built.values)
    apart = [
        np.abs(np.linalg.eigvals(np.linalg.solve(2.0 * covariance[t, joint], found)) - 1).max()
        for t in (0, T // 2, T - 1)
        for joint in range(25)
        for found in [marginals.marginalCovariance(int(built.keys[t, joint]))]
    ]
    assert np.quantile(apart, 0.99) < 0.01
    # All at once, by a recursion of our own, and pairs of variables.
    every = graph_covariances(built.graph, built.values, ordering([built], built.values))
    wrist, body = int(built.keys[3, 4]), int(built.body_keys[3])
    pair = marginals.jointMarginalCovariance(gtsam.KeyVector([wrist, body]))
    for one, other in ((wrist, wrist), (wrist, body), (body, body)):
        np.testing.assert_allclose(every[one, other], pair.at(one, other), rtol=1e-6, atol=1e-10)
    # Information on a joint is its views' and, of the frame, its body's; the rest is other frames'.
    whole = np.linalg.inv(every[wrist, wrist])
    seen = window.last.evidence.information[3, 4] / 2.0
    left = np.linalg.eigvals(np.linalg.solve(whole, whole - seen - built.of_body(3, 4)))
    assert (left > -0.01).all() and (left < 0.9).all()
    step = built.graph.linearize(built.values).optimize(ordering([built], built.values))
    moved = built.values.retract(step)
    before = window.joints(state)
    away = [
        np.linalg.norm(moved.atPoint3(int(key)) - x)
        for key, x in zip(built.keys.ravel(), before.reshape(-1, 3), strict=True)
    ]
    assert np.mean(away) < 1e-3


def test_a_frame_by_itself_is_a_window_of_one() -> None:
    window, truth, start = _person(2)
    alone = BodyWindow(
        window.observations.rows(np.array([4])), window.sigmas_px[4:5], window.views,
        window.energy.model, window.config,
        MotionModel.load(tuple(window.energy.model.keypoint_names)), CONSTANT_VELOCITY,
    )  # fmt: skip
    state = alone.solve(start[4:5])
    assert np.linalg.norm(alone.joints(state) - truth[4:5], axis=-1).mean() < 0.03
    assert np.isfinite(alone.covariances(state).joints()).all()


def test_gtsam_takes_the_step_of_the_compiled_solver() -> None:
    window, _, start = _person(3)
    state = window.solve(start)
    shape, pose = gtsam_step(window, state)
    theirs = window._step(state, window.last, 0.0)
    # The compiled solver neglects how the root turns between frames in the couplings of rotations.
    for step, compiled in zip((shape, pose), theirs, strict=True):
        assert np.abs(step - compiled).max() < 0.1 * np.abs(compiled).max()
    before = window.last.cost
    window.take(state, shape, pose)
    assert window.last.cost <= before
    beyond = window.take(state, shape, np.full_like(pose, 1.0))
    assert beyond is state, "a step that makes it worse is not taken"


def test_a_body_s_values_are_those_of_the_model_wherever_it_was_linearised() -> None:
    """Bodies are read back from values, and a turn of a root that is no small one changes the graph
    as it changes the model.
    """
    window, _, start = _person(3)
    built = BodyGraph(window, window.solve(start), 0, np.arange(T)).build()
    before, key = window.joints(built.state), int(built.body_keys[5])
    built.take(built.values)
    np.testing.assert_allclose(window.joints(built.state), before, atol=1e-9)
    turned = gtsam.Values(built.values)
    body = np.array(turned.atVector(key)) + np.r_[0.3, -0.2, 0.4, np.zeros(66)]
    turned.update(key, body)
    built.take(turned)
    built.build()
    np.testing.assert_allclose(built.values.atVector(key), body, atol=1e-9)
    step, costs = np.r_[0.002, 0.003, -0.002, np.zeros(66)], []
    for _ in range(2):
        costs.append(built.graph.error(built.values))
        there = gtsam.Values(built.values)
        there.update(key, body + step)
        if len(costs) == 1:
            linear = built.graph.error(there) - costs[0]
            built.take(there)
            built.build()
    assert linear == pytest.approx(costs[1] - costs[0], rel=0.05)
