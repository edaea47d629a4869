import gtsam
import numpy as np
import pytest

from factors import (
    camera_key,
    format_key,
    joint_key,
    joint_keys,
    offset_key,
    offset_keys,
    reported_keys,
    split_camera_key,
    split_key,
    velocity_key,
    velocity_keys,
)
from factors.keys import MAX_FRAME, MAX_JOINT, MAX_PERSON, MAX_VIEW

CORNERS = [
    (0, 0, 0),
    (3, 24, 17),
    (MAX_PERSON, MAX_JOINT, MAX_FRAME),
    (0, MAX_JOINT, 0),
    (0, 0, MAX_FRAME),
]


@pytest.mark.parametrize(("person", "joint", "frame"), CORNERS)
def test_a_key_says_again_what_it_was_made_of(person, joint, frame):
    for make in (
        joint_key,
        velocity_key,
        offset_key,
        lambda *numbers: int(reported_keys(*numbers)),
    ):
        assert split_key(make(person, joint, frame)) == (person, joint, frame)
    assert split_camera_key(camera_key(person, frame)) == (person, frame)


def test_every_key_is_its_own():
    many = [
        (p, j, f)
        for p in (0, 1, 99, 100, MAX_PERSON)
        for j in (0, 1, 999)
        for f in (0, 1, 100, MAX_FRAME)
    ]
    keys = {make(*each) for make in (joint_key, velocity_key) for each in many}
    keys |= {offset_key(*each, source) for source in range(3) for each in many}
    keys |= {camera_key(p, f) for p, _, f in many}
    assert len(keys) == 5 * len(many) + 5 * 4
    # Symbols have a character in their upper eight bits, plain numbers are small.
    assert min(keys) >= 10**16 and max(keys) < 1 << 56


def test_keys_sort_by_kind_person_joint_and_frame():
    """What reads all positions of a window at once, in the order of the keys, relies on it."""
    many = [(p, j, f) for p in (0, 7) for j in (0, 3, 24) for f in (0, 5, 6, 1000)]
    expected = [make(*each) for make in (joint_key, velocity_key, offset_key) for each in many]
    assert sorted(expected) == expected


@pytest.mark.parametrize("person", [0, 3, 41])
def test_gtsam_s_own_messages_tell_variables_apart(person, capfd):
    """Messages, printed values and drawings name every person, joint and frame differently, and in
    full.
    """
    keys = [joint_key(person, joint, frame) for joint in (4, 7) for frame in (12, 12345)]
    values = gtsam.Values()
    with pytest.raises(RuntimeError, match=f"1{person:05d}00400000012"):
        values.atPoint3(keys[0])
    for key in keys:
        values.insert(key, np.zeros(3))
    values.print("")
    graph = gtsam.NonlinearFactorGraph()
    for key in keys:
        graph.add(gtsam.PriorFactorPoint3(key, np.zeros(3), gtsam.noiseModel.Unit.Create(3)))
    drawn, printed = graph.dot(values), capfd.readouterr().out
    for key in keys:
        assert f"Value {key}:" in printed and f'label="{key}"' in drawn
        assert gtsam.DefaultKeyFormatter(key) == str(key)


def test_keys_stay_clear_of_the_usual_symbols_of_robotics():
    ours = {joint_key(0, 0, 0), velocity_key(0, 0, 0), joint_key(MAX_PERSON, MAX_JOINT, MAX_FRAME)}
    assert (
        not ours & {gtsam.symbol(name, 0) for name in "abcdefghijklmnopqrstuvwxyzJVC"}
        | set(range(10)) & ours
    )


def test_arrays_give_the_same_keys():
    joints, frames = np.array([4, 0, 24]), np.array([[9], [10]])
    for one, many in (
        (joint_key, joint_keys),
        (velocity_key, velocity_keys),
        (offset_key, offset_keys),
    ):
        expected = [[one(3, int(j), int(f)) for j in joints] for f in frames[:, 0]]
        assert many(3, joints, frames).tolist() == expected
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
        lambda: joint_keys(0, [3, 1000]),
        lambda: joint_keys(0, [-1]),
        lambda: joint_keys(0, [1], [-1]),
        lambda: offset_key(0, 0, 0, 3),
    ],
)
def test_a_number_beyond_its_bits_is_refused(make):
    with pytest.raises(ValueError, match="0 to"):
        make()


@pytest.mark.parametrize(
    "make",
    [
        lambda: joint_key(1.9, 2.7, 3.2),
        lambda: velocity_key(1, 2, 3.5),
        lambda: joint_keys(1, [2, 2.5], 3),
        lambda: joint_keys(1.5, [2, 3], 3),
        lambda: offset_key(1, 2, 3, 1.5),
        lambda: camera_key(0.5),
    ],
)
def test_a_number_that_is_not_whole_is_refused(make):
    """It would be the key of somebody else."""
    with pytest.raises(ValueError, match="must be a whole number"):
        make()
    assert joint_key(1.0, np.float64(2), np.int32(3)) == joint_key(1, 2, 3)


def test_keys_are_printed_readably_also_by_gtsam(capfd):
    assert format_key(joint_key(1, 4, 30)) == "position(person 1, joint 4, frame 30)"
    assert format_key(velocity_key(1, 4, 30)) == "velocity(person 1, joint 4, frame 30)"
    assert format_key(camera_key(2)) == "camera(view 2, frame 0)"
    assert format_key(gtsam.symbol("x", 5)) == "x5"
    graph = gtsam.NonlinearFactorGraph()
    graph.add(
        gtsam.PriorFactorPoint3(joint_key(1, 4, 30), np.zeros(3), gtsam.noiseModel.Unit.Create(3))
    )
    graph.print("", format_key)
    assert "position(person 1, joint 4, frame 30)" in capfd.readouterr().out


def test_another_key_is_not_taken_for_a_joint():
    with pytest.raises(ValueError, match="x5 is not the key of a joint"):
        split_key(gtsam.symbol("x", 5))
    with pytest.raises(ValueError, match="not the key of a camera"):
        split_camera_key(joint_key(0, 0, 0))
    with pytest.raises(ValueError, match="not the key of a joint"):
        split_key(camera_key(0))
