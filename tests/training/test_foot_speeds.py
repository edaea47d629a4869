"""The model of how feet move, fitted to feet of which it is known how they moved."""

import numpy as np

from shapepose_fg.body.training.foot_speeds import foot_speeds


def test_finds_the_speeds_that_feet_were_made_with():
    rng = np.random.default_rng(0)
    motions = []
    for _ in range(20):
        # Feet that stand, turn and move for half a second to a second each, 0.02, 0.1 and 1.5 m/s an axis.
        ways = np.repeat([0, 1, 2, 1] * 4, rng.integers(15, 30, 16))
        velocity = rng.normal(0.0, 1.0, (len(ways), 25, 3)) * np.array([0.02, 0.1, 1.5])[ways][:, None, None]
        motions.append((np.cumsum(velocity, axis=0) / 30, 30.0))
    found = foot_speeds(motions)
    # Velocities over two frames are means of two that are independent here.
    np.testing.assert_allclose(found.speeds_m_s * np.sqrt(2), [0.02, 0.1, 1.5], rtol=0.1)
    np.testing.assert_allclose(found.first, [0.25, 0.5, 0.25], atol=0.04)
    # 22 frames of each way in the mean.
    np.testing.assert_allclose(found.lasts_s(30.0), 22 / 30, rtol=0.25)
    assert found.turns[0, 2] < 0.01 and found.turns[2, 0] < 0.01
