"""The floor under feet: a plane where there is one, and nothing where there is none."""

import numpy as np
import pytest

from shapepose_fg.estimation.floor import Floor, find_floor

UP = np.array([0.0, 0.0, 1.0])


def feet(heights, seed: int = 0):
    """Soles somewhere in a room of 4 x 4 m, one look of five frames at each of these heights, to 1
    cm.
    """
    rng = np.random.default_rng(seed)
    places = np.column_stack([rng.uniform(-2, 2, (len(heights), 2)), heights])
    look = np.repeat(np.arange(len(heights)), 5)
    return places[look] + rng.normal(0.0, [0.0, 0.0, 0.01], (len(look), 3)), look


def above(floor: Floor, points: np.ndarray) -> np.ndarray:
    """(...,) height of points (..., 3) above the floor, metres."""
    return points @ floor.normal - floor.height_m


def test_most_feet_say_where_it_is():
    # Every fifth is on a chair or in the air.
    points, look = feet([0.3] * 40 + [0.75] * 5 + [0.5] * 5)
    floor = find_floor(points, look, UP)
    assert isinstance(floor, Floor)
    assert floor.looks == 50 and floor.share == pytest.approx(0.8)
    # 200 points to 1 cm: a millimetre under their middle, and three at the corners, for it may
    # lean.
    assert abs(floor.height_m - 0.3) < 0.006
    np.testing.assert_allclose(
        above(floor, np.array([[2.0, 2.0, 0.3], [0.0, 0.0, 1.3]])), [0.0, 1.0], atol=0.005
    )
    assert above(Floor.from_dict(floor.as_dict()), UP) == above(floor, UP)
    assert Floor.from_dict({"found": False, "why": "dark"}) is None


def test_a_few_feet_that_are_placed_badly_are_no_floor():
    points, look = feet([0.3] * 97 + [0.15] * 3)
    floor = find_floor(points, look, UP)
    assert isinstance(floor, Floor) and abs(floor.height_m - 0.3) < 0.006


def test_it_may_lean_and_up_may_be_any_axis():
    points, look = feet([0.0] * 60)
    lean = np.deg2rad(0.8)
    points = points @ np.array(
        [[np.cos(lean), 0, np.sin(lean)], [0, 1, 0], [-np.sin(lean), 0, np.cos(lean)]]
    )
    floor = find_floor(points[:, [1, 2, 0]], look, np.array([0.0, 1.0, 0.0]))
    assert isinstance(floor, Floor)
    # 60 measurements outweigh a prior of half a degree.
    assert np.rad2deg(np.arccos(floor.normal[1])) == pytest.approx(0.8, abs=0.1)
    assert np.abs(above(floor, points[:, [1, 2, 0]])).max() < 0.04


@pytest.mark.parametrize(
    ("heights", "why"),
    [
        ([0.0] * 5, "5 measurements"),
        (np.linspace(0, 1, 40), "agree"),  # stairs
        ([0.0] * 20 + [0.4] * 20, "agree"),  # a stage
        ([0.4] * 30 + [0.0] * 2, "below"),  # a stage that somebody stepped down from
        ([], "0 measurements"),
    ],
)
def test_there_may_be_none(heights, why):
    points, look = feet(np.asarray(heights, dtype=float))
    found = find_floor(points, look, UP)
    assert isinstance(found, str) and why in found


def test_a_look_counts_once_however_long_it_is():
    points, look = feet([0.0] * 12 + [0.5] * 4)
    long = np.repeat(np.flatnonzero(look == 15), 200)
    floor = find_floor(
        np.concatenate([points, points[long]]), np.concatenate([look, look[long]]), UP
    )
    assert isinstance(floor, Floor) and abs(floor.height_m) < 0.01
