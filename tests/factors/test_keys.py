import gtsam
import numpy as np
import pytest

from factors import (
    camera_key,
    format_key,
    joint_key,
    joint_keys,
    split_camera_key,
    split_key,
    velocity_key,
)
from factors.keys import MAX_FRAME, MAX_JOINT, MAX_PERSON, MAX_VIEW

CORNERS = [(0, 0, 0), (3, 24, 17), (MAX_PERSON, MAX_JOINT, MAX_FRAME), (0, MAX_JOINT, 0), (0, 0, MAX_FRAME)]


@pytest.mark.parametrize(("person", "joint", "frame"), CORNERS)
def test_a_key_says_again_what_it_was_made_of(person, joint, frame):
    for make in (joint_key, velocity_key):
        assert split_key(make(person, joint, frame)) == (person, joint, frame)
    assert split_camera_key(camera_key(person, frame)) == (person, frame)


def test_every_key_is_its_own():
    many = [(p, j, f) for p in (0, 1, 255, 256, MAX_PERSON) for j in (0, 1, 255) for f in (0, 1, 256, MAX_FRAME)]
    keys = {make(*each) for make in (joint_key, velocity_key) for each in many}
    keys |= {camera_key(p, f) for p, _, f in many}
    assert len(keys) == 2 * len(many) + 5 * 4


def test_a_key_is_a_symbol_of_gtsam():
    symbol = gtsam.Symbol(joint_key(2, 7, 5))
    assert chr(symbol.chr()) == "J"
    assert symbol.key() == joint_key(2, 7, 5)
    assert symbol.index() == (2 << 40) + (5 << 8) + 7


def test_keys_stay_clear_of_the_usual_symbols_of_robotics():
    assert joint_key(0, 0, 0) != gtsam.symbol("j", 0)
    assert velocity_key(0, 0, 0) != gtsam.symbol("v", 0)


def test_an_array_of_joints_gives_the_same_keys():
    joints = np.array([4, 0, 24])
    assert joint_keys(3, joints, 9).tolist() == [joint_key(3, int(j), 9) for j in joints]
    assert joint_keys(3, np.array([], dtype=int)).tolist() == []


@pytest.mark.parametrize(
    "make",
    [
        lambda: joint_key(MAX_PERSON + 1, 0, 0),
        lambda: joint_key(0, MAX_JOINT + 1, 0),
        lambda: joint_key(0, 0, MAX_FRAME + 1),
        lambda: joint_key(-1, 0, 0),
        lambda: velocity_key(0, -1, 0),
        lambda: camera_key(MAX_VIEW + 1),
        lambda: camera_key(0, -1),
        lambda: joint_keys(0, [3, 256]),
        lambda: joint_keys(0, [-1]),
    ],
)
def test_a_number_beyond_its_bits_is_refused(make):
    with pytest.raises(ValueError, match="0 to"):
        make()


def test_keys_are_printed_readably_also_by_gtsam(capfd):
    assert format_key(joint_key(1, 4, 30)) == "J(person 1, joint 4, frame 30)"
    assert format_key(velocity_key(1, 4, 30)) == "V(person 1, joint 4, frame 30)"
    assert format_key(camera_key(2)) == "C(view 2, frame 0)"
    assert format_key(gtsam.symbol("x", 5)) == "x5"
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPoint3(joint_key(1, 4, 30), np.zeros(3), gtsam.noiseModel.Unit.Create(3)))
    graph.print("", format_key)
    assert "J(person 1, joint 4, frame 30)" in capfd.readouterr().out


def test_another_key_is_not_taken_for_a_joint():
    with pytest.raises(ValueError, match="x5 is not the key of a joint"):
        split_key(gtsam.symbol("x", 5))
    with pytest.raises(ValueError, match="not the key of a camera"):
        split_camera_key(joint_key(0, 0, 0))
    with pytest.raises(ValueError, match="not the key of a joint"):
        split_key(camera_key(0))
