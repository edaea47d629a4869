"""What uncertain association adds to covariances: against mixtures that are drawn, and worked out by hand."""

import numpy as np

from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.doubt import association_spread
from shapepose_fg.estimation.linearisation import ObservationConfig, linearise, observation_sigmas
from shapepose_fg.estimation.message import Message

PLAIN = ObservationConfig(kernel="none", rho_2d_m=1.0)
NAMES = ("RWrist",)
TRUE = np.array([[[0.1, 0.2, 1.2]]])


def evidence_of(rig, probability, away_m):
    """One joint seen by all views at its place, but by the first as if it were `away_m` along the y axis."""
    xy, _ = rig.project(TRUE[0])
    xy[0], _ = (each[0] for each in rig.project(TRUE[0] + [0, away_m, 0]))
    seen = np.moveaxis(xy, 0, 1)[None]
    observations = Observations(
        seen, np.full((1, 1, len(rig)), 0.8), TRUE, probability=np.broadcast_to(probability, (1, 1, len(rig)))
    )
    views = Views.of(rig)
    sigmas = observation_sigmas(observations, TRUE, views, PLAIN, NAMES)
    points = TRUE
    for _ in range(4):  # Gauss-Newton, to where the weighed observations put it
        evidence = linearise(observations, sigmas, points, views, PLAIN)
        points = evidence.target
    return observations, sigmas, evidence, views


def spread_of(rig, probability, away_m):
    observations, sigmas, evidence, views = evidence_of(rig, probability, away_m)
    nobody = Message(np.full((1, 1, 3), np.nan), np.zeros((1, 1, 3, 3)))
    spread = association_spread(observations, sigmas, evidence, nobody, views, PLAIN)
    return evidence.points[0, 0], spread[0, 0]


def test_it_is_the_spread_of_the_solutions_with_and_without_the_observation(five_cameras):
    p = np.array([0.7, 1, 1, 1, 1.0])
    with_it, _ = spread_of(five_cameras, np.ones(5), 0.1)
    without, _ = spread_of(five_cameras, np.array([1e-9, 1, 1, 1, 1]), 0.1)
    _, spread = spread_of(five_cameras, p, 0.1)
    apart = with_it - without
    assert np.linalg.norm(apart) > 0.01, "the case has something to tell"
    expected = 0.7 * 0.3 * np.outer(apart, apart)
    # First order, and a prior of 30 cm in `rest`; without it counts a hundredth.
    np.testing.assert_allclose(spread, expected, atol=0.1 * np.trace(expected))


def test_what_is_certain_and_what_changes_nothing_adds_nothing(five_cameras):
    assert not spread_of(five_cameras, np.full(5, 0.995), 0.1)[1].any()
    assert np.trace(spread_of(five_cameras, np.full(5, 0.6), 0.0)[1]) < 1e-8
    more, less = (np.trace(spread_of(five_cameras, np.array([p, 1, 1, 1, 1]), 0.1)[1]) for p in (0.6, 0.95))
    assert more > 3 * less > 0


def test_a_doubtful_observation_counts_by_its_probability(five_cameras):
    """Half as probable is half as informative; far from certain, the joint stays with the other views."""
    sure, half = (evidence_of(five_cameras, p, 0.0) for p in (1.0, 0.5))
    np.testing.assert_allclose(half[2].information, sure[2].information / 2, rtol=1e-9)
    np.testing.assert_allclose(half[1], sure[1] * np.sqrt(2))
