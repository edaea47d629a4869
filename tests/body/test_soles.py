"""Bodies and a floor: where their lowest points are, and how they get out of it."""

import numpy as np

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.soles import SINK_M, above_floor, lowest_of_feet

MODEL = BodyModel.default()
UP = np.array([0.0, 1.0, 0.0])


def standing(count: int, lift_m: float = 0.0):
    """T-poses whose soles are `lift_m` above y = 0."""
    bodies = (
        np.zeros((count, 10)),
        np.zeros((count, 3)),
        np.zeros((count, 23, 3)),
        np.zeros((count, 3)),
    )
    bodies[3][:, 1] = lift_m - vertices(bodies)[0, :, 1].min()
    return bodies


def vertices(bodies):
    return MODEL.vertices(BodyParameters(*bodies))


def test_lowest_points_are_those_of_the_mesh():
    bodies = standing(2, 0.3)
    bodies[2][1, 7 - 1] = [0.6, 0.0, 0.0]  # the left foot of the second points down
    low = lowest_of_feet(MODEL, bodies, UP)
    assert low[1, 1, 1] < low[1, 0, 1] - 0.02
    # Every third vertex of a foot is looked at: a millimetre or two.
    np.testing.assert_allclose(
        low[..., 1].min(axis=1), vertices(bodies)[..., 1].min(axis=1), atol=0.003
    )


def test_who_stands_on_the_floor_stays():
    bodies = standing(3, 0.002)
    for before, after in zip(bodies, above_floor(MODEL, bodies, UP, 0.0), strict=True):
        np.testing.assert_allclose(after, before, atol=1e-9)


def test_a_foot_that_points_into_the_floor_is_bent_and_the_body_stays():
    bodies = standing(1)
    bodies[2][0, 7 - 1] = [0.5, 0.0, 0.0]
    assert vertices(bodies)[..., 1].min() < -0.04
    out = above_floor(MODEL, bodies, UP, 0.0)
    assert vertices(out)[..., 1].min() > -SINK_M - 0.01
    assert np.abs(out[3] - bodies[3]).max() < 0.01
    others = np.delete(np.arange(23), 7 - 1)
    np.testing.assert_allclose(out[2][:, others], bodies[2][:, others], atol=1e-9)
    # Half a radian of pointing is what had to go, by the first order.
    assert abs(out[2][0, 6, 0]) < 0.1


def test_who_is_in_it_without_feet_is_lifted():
    """Upside down, the head 10 cm in the floor: feet are neither near it nor bent."""
    bodies = standing(1)
    bodies[1][:] = [np.pi, 0.0, 0.0]
    bodies[3][:, 1] -= vertices(bodies)[..., 1].min() + 0.1
    out = above_floor(MODEL, bodies, UP, 0.0)
    assert -SINK_M - 0.01 < vertices(out)[..., 1].min() < SINK_M
    np.testing.assert_allclose(out[2], bodies[2], atol=1e-9)


def test_who_is_in_it_with_more_than_feet_is_lifted():
    bodies = standing(1)
    bodies[3][:, 1] -= 1.2
    out = above_floor(MODEL, bodies, UP, 0.0)
    assert vertices(out)[..., 1].min() > -SINK_M - 0.01
    # The floor may lean: the same in another frame of the world, turned by 90 degrees.
    turn = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    turned = (bodies[0], np.array([[np.pi / 2, 0.0, 0.0]]), bodies[2], np.zeros((1, 3)))
    low = (vertices(turned) @ turn @ UP).min()
    turned[3][:] = turn @ UP * (-0.3 - low)
    again = above_floor(MODEL, turned, turn @ UP, 0.0)
    assert (vertices(again) @ turn @ UP).min() > -SINK_M - 0.01
