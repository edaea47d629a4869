"""The Kalman filter of joints: against the same numbers by hand."""

from dataclasses import replace

import numpy as np
import pytest

from factors import CONSTANT_VELOCITY, kernel_weight
from shapepose_fg.core.camera import Views
from shapepose_fg.core.kernel_geometry import ROBUST, robust_weight
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.gated_views import ObservationConfig, linearise, observation_sigmas
from shapepose_fg.proposal.nearby import FrameArrays
from shapepose_fg.tracking.measuring import MeasurementNoise, measured
from shapepose_fg.tracking.motion_filter import Bones, JointStates, predicted
from shapepose_fg.tracking.view_assignment import Predicted, assign

PSD = np.array([4e-4, 9e-4])
TWO = Bones(np.array([True, False]), np.arange(2), np.array([-1, 0]), (0, 1), np.ones(2))
"""Two joints, one of them a core joint."""


BONES = Bones.of(BODY_25, np.full(25, 10.0))
"""Bones so long that no joint is torn off."""


def states(seed=0):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(3, 2, 6, 6))
    return JointStates(rng.normal(size=(3, 2, 6)), 1e-4 * (A @ A.swapaxes(-1, -2) + np.eye(6)))


def test_a_step_ahead_is_constant_velocity_with_white_acceleration():
    before, h = states(), 0.1
    after, lost = predicted(before, h, CONSTANT_VELOCITY, PSD, TWO)
    assert not lost.any()
    np.testing.assert_allclose(after.position, before.position + h * before.velocity)
    np.testing.assert_allclose(after.velocity, before.velocity)
    F = np.kron(np.array([[1.0, h], [0.0, 1.0]]), np.eye(3))
    Q = np.kron(PSD[1] * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]]), np.eye(3))
    np.testing.assert_allclose(after.covariance[1, 1], F @ before.covariance[1, 1] @ F.T + Q)


def test_a_step_back_returns_to_where_it_came_from_less_certain():
    before = states()
    there, _ = predicted(before, 0.02, CONSTANT_VELOCITY, PSD, TWO)
    there_and_back, _ = predicted(there, -0.02, CONSTANT_VELOCITY, PSD, TWO)
    np.testing.assert_allclose(there_and_back.mean, before.mean, atol=1e-12)
    grown = there_and_back.covariance - before.covariance
    assert (np.linalg.eigvalsh(grown) > -1e-9).all() and np.trace(grown, axis1=2, axis2=3).min() > 0


def test_a_measurement_is_the_information_filter_s_also_for_a_ray(
    five_cameras, two_people, seen_exactly
):
    """Of what the views say of a joint after three linearisations; a wrist is seen by one view, a
    knee by none.
    """
    rng, names = np.random.default_rng(3), BODY_25.joints
    seen = seen_exactly(five_cameras, two_people)
    seen = replace(
        seen,
        xy=seen.xy + rng.normal(0, 4, seen.xy.shape),
        confidence=rng.uniform(0.2, 1, len(seen)),
    )
    sure, lost = np.full((2, 25), 0.05), np.zeros((2, 25), dtype=bool)
    arrays = FrameArrays.of(seen, five_cameras, BODY_25)
    candidate = assign(Predicted(two_people, sure, lost), arrays)
    wrist, knee, ankle = (names.index(name) for name in ("RWrist", "RKnee", "LAnkle"))
    candidate[:, wrist, 1:] = candidate[:, knee] = -1
    candidate[0, ankle, 1:] = candidate[1, ankle, 1:]  # outside the gate
    before = JointStates.at(two_people + rng.normal(0, 0.03, two_people.shape), sure, (2.0,))
    config, views = ObservationConfig(), Views.of(five_cameras)
    rows, at = Observations.of(candidate, seen, before.position), before.position
    sigmas = observation_sigmas(rows, at, views, config, names)
    for _ in range(3):
        said = linearise(rows, sigmas, at, views, config)
        full = np.zeros((2, 25, 6, 6))
        full[..., :3, :3] = said.information
        precision = np.linalg.inv(before.covariance)
        covariance = np.linalg.inv(precision + full)
        pull = np.einsum("...ij,...j->...i", said.information, at) - said.gradient
        right = np.einsum("...ij,...j->...i", precision, before.mean)
        right[..., :3] += pull
        mean = np.einsum("...ij,...j->...i", covariance, right)
        at = mean[..., :3]
    weight = config.weight(seen.confidence)
    given = before, lost, candidate, weight, arrays, MeasurementNoise.of(config, names), BONES
    after, kept, evident = measured(*given)
    inlier = kept >= 0
    assert evident.all()
    np.testing.assert_allclose(after.mean, mean, atol=1e-9)
    np.testing.assert_allclose(after.covariance, covariance, atol=1e-9)
    np.testing.assert_array_equal(inlier, said.inlier)
    assert (
        inlier[:, wrist, 0].all()
        and not inlier[0, ankle, 1:].any()
        and (after.mean[:, knee] == before.mean[:, knee]).all()
    )


def test_a_lost_joint_begins_where_the_views_put_it(five_cameras, two_people, seen_exactly):
    """Half a metre beside, where no gate would let its detections through."""
    seen, sure = seen_exactly(five_cameras, two_people), np.full((2, 25), 0.4)
    lost = np.arange(50).reshape(2, 25) == 4
    arrays, config = FrameArrays.of(seen, five_cameras, BODY_25), ObservationConfig()
    candidate = assign(Predicted(two_people, sure / 20, lost & False), arrays)
    before = JointStates.at(two_people + 0.5 * lost[..., None], sure, (2.0,))
    trust = MeasurementNoise.of(config, BODY_25.joints)
    after, kept, _ = measured(
        before, lost, candidate, config.weight(seen.confidence), arrays, trust, BONES
    )
    assert (kept >= 0).all()
    np.testing.assert_allclose(after.position, two_people, atol=2e-3)


@pytest.mark.parametrize("name", ["none", "huber", "cauchy", "geman_mcclure", "tukey"])
def test_robust_kernels_are_those_of_the_factors(name):
    for ratio in (0.0, 0.3, 0.99, 1.5, 4.0):
        expected = kernel_weight(None if name == "none" else name, ratio, 1.0)
        assert robust_weight.py_func(ROBUST[name], ratio**2) == pytest.approx(float(expected))
