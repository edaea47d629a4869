"""People's keys within a graph of somebody's own."""

import gtsam
import numpy as np
import pytest

from factors import JointKey, KeySpace

SPACES = [KeySpace("p"), KeySpace(range(10**9, 2 * 10**9), people=10, joints=25)]


@pytest.mark.parametrize("space", SPACES, ids=["character", "integers"])
def test_keys_differ_are_of_the_space_and_say_what_they_are_of(space):
    frames = np.array([0, 1, space.frames - 1])
    keys = np.concatenate(
        [
            make(person, np.arange(25)[:, None], frames).ravel()
            for person in range(10)
            for make in (space.positions, space.velocities)
        ]
    )
    assert len(np.unique(keys)) == len(keys) == 10 * 25 * 3 * 2
    assert all(key in space.keys for key in keys.tolist())
    assert space.split(int(space.positions(3, 4, 12))) == JointKey(3, 4, 12)
    assert space.format(int(space.velocities(3, 4, 12))) == "velocity(person 3, joint 4, frame 12)"
    assert space.format(gtsam.symbol("x", 5)) == "x5"


def test_a_character_takes_symbols_of_that_character_only():
    keys = KeySpace("p").positions(999, [0, 199], [0, KeySpace("p").frames - 1])
    assert {chr(gtsam.symbolChr(key)) for key in keys.tolist()} == {"p"}


def test_what_has_no_key_is_refused_with_the_cure():
    with pytest.raises(ValueError, match="too small for one frame: give 750 keys"):
        KeySpace(range(100), people=10, joints=25)
    with pytest.raises(ValueError, match="joint must be 0 to 24 in this space"):
        SPACES[1].positions(0, 25, 0)
    with pytest.raises(ValueError, match="frame must be 0 to"):
        SPACES[1].positions(0, 0, SPACES[1].frames)
    with pytest.raises(ValueError, match="one ASCII character"):
        KeySpace("people")
    with pytest.raises(ValueError, match="x5 is not a key of the space p"):
        SPACES[0].split(gtsam.symbol("x", 5))


def test_identities_wrap_round():
    # Numbers are counted up for ever; two people who are there at a time are never so far apart.
    assert SPACES[0].positions(1000, 0, 0) == SPACES[0].positions(0, 0, 0)
