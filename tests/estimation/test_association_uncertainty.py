"""What uncertain association adds to covariances: against mixtures that are drawn, and worked out
by hand.
"""

import numpy as np

from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.association_uncertainty import (
    association_spread,
    exchange_spread,
    limbs_to_exchange,
)
from shapepose_fg.estimation.linearisation import ObservationConfig, linearise, observation_sigmas

PLAIN = ObservationConfig(kernel="none", rho_2d_m=1.0)
NAMES = ("RWrist",)
TRUE = np.array([[[0.1, 0.2, 1.2]]])


def evidence_of(rig, probability, away_m):
    """One joint seen by all views at its place, but by the first as if it were `away_m` along the y
    axis.
    """
    xy, _ = rig.project(TRUE[0])
    xy[0], _ = (each[0] for each in rig.project(TRUE[0] + [0, away_m, 0]))
    seen = np.moveaxis(xy, 0, 1)[None]
    observations = Observations(
        seen,
        np.full((1, 1, len(rig)), 0.8),
        TRUE,
        probability=np.broadcast_to(probability, (1, 1, len(rig))),
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
    nobody = JointTargets(np.full((1, 1, 3), np.nan), np.zeros((1, 1, 3, 3)))
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
    more, less = (
        np.trace(spread_of(five_cameras, np.array([p, 1, 1, 1, 1]), 0.1)[1]) for p in (0.6, 0.95)
    )
    assert more > 3 * less > 0


def test_a_doubtful_observation_counts_by_its_probability(five_cameras):
    """Half as probable is half as informative; far from certain, the joint stays with the other
    views.
    """
    sure, half = (evidence_of(five_cameras, p, 0.0) for p in (1.0, 0.5))
    np.testing.assert_allclose(half[2].information, sure[2].information / 2, rtol=1e-9)
    np.testing.assert_allclose(half[1], sure[1] * np.sqrt(2))


def test_two_limbs_that_both_bodies_can_have_may_be_exchanged():
    """Three people's right shins, 43 cm: the feet of the first two fit either knee; the third is as
    near, and its foot 30 cm too far from others' knees. The same two, in another frame each, are
    not people of one frame.
    """
    knee = np.array([[0, 0, 0.43], [0.3, 0, 0.43], [0.15, -0.15, 0.1]])
    foot = np.array([[0.15, 0.10, 0.0334], [0.15, -0.10, 0.0334], [0.15, -0.05, -0.318]])
    joints = np.stack([knee, foot], axis=1)
    assert np.allclose(np.linalg.norm(joints[:, 1] - joints[:, 0], axis=1), 0.43, atol=0.01)
    limbs = limbs_to_exchange(("RKnee", "RAnkle"))
    assert limbs.tolist() == [[1, 0, 1]]
    found = exchange_spread(joints, joints, np.zeros(3, dtype=int), limbs)
    apart = foot[1] - foot[0]
    for person in range(2):
        np.testing.assert_allclose(found[person, 1], np.outer(apart, apart), atol=0.02 * 0.04)
    assert np.trace(found[2, 1]) < 0.01 * apart @ apart, "whose own foot is nobody else's"
    assert not found[:, 0].any(), "a knee goes with its hip, which nobody placed"
    assert not exchange_spread(joints[:2], joints[:2], np.arange(2), limbs).any()


def test_an_exchange_needs_both_bodies_and_feet_within_reach():
    """15 cm beside each other two shins of 43 cm may be exchanged, one of 43 and one of 30 hardly;
    what is over 60 cm away is nobody else's.
    """
    limbs, both = limbs_to_exchange(("RKnee", "RAnkle")), np.zeros(2, dtype=int)

    def doubted(beside_m, shin_m):
        joints = np.array(
            [[[0, 0, 0.43], [0, 0, 0]], [[beside_m, 0, 0.43], [beside_m, 0, 0.43 - shin_m]]]
        )
        away = joints[1, 1] - joints[0, 1]
        return np.trace(exchange_spread(joints, joints, both, limbs)[0, 1]) / (away @ away)

    assert doubted(0.15, 0.43) > 0.7
    assert 0 < doubted(0.15, 0.3) < 0.01
    assert doubted(0.7, 0.43) == 0


def test_who_has_no_body_or_no_place_exchanges_nothing():
    joints = np.array([[[0, 0, 0.43], [0, 0, 0]], [[0.1, 0, 0.43], [np.nan] * 3]])
    bodies = np.full((2, 2, 3), np.nan)
    limbs = limbs_to_exchange(("RKnee", "RAnkle"))
    assert not exchange_spread(joints, bodies, np.zeros(2, dtype=int), limbs).any()
