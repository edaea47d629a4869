import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.metrics import PlainPeople
from shapepose_fg.evaluation.score import score
from shapepose_fg.evaluation.shelf import (
    LIMB_ENDS,
    SHELF_JOINTS,
    read_shelf_ground_truth,
    shelf_joints,
)

UPRIGHT = dict(
    RAnkle=(0.09, 0, 0.1),
    RKnee=(0.09, 0, 0.5),
    RHip=(0.09, 0, 0.9),
    LHip=(-0.09, 0, 0.9),
    LKnee=(-0.09, 0, 0.5),
    LAnkle=(-0.09, 0, 0.1),
    RWrist=(0.2, 0, 0.9),
    RElbow=(0.2, 0, 1.15),
    RShoulder=(0.2, 0, 1.4),
    LShoulder=(-0.2, 0, 1.4),
    LElbow=(-0.2, 0, 1.15),
    LWrist=(-0.2, 0, 0.9),
    Neck=(0, 0, 1.4),
    MidHip=(0, 0, 0.9),
    REar=(0.07, 0, 1.6),
    LEar=(-0.07, 0, 1.6),
)
"""Someone who stands upright at the origin and faces +y (right is +x): head and limbs of known
lengths."""


def upright(*at):
    """(1, 25, 3) the upright person at a place; what the protocol does not use is unknown."""
    joints = np.full((1, 25, 3), np.nan)
    for name, xyz in UPRIGHT.items():
        joints[0, BODY_25.index(name)] = np.add(xyz, at)
    return joints


def people(*rows, frame=None, **more):
    joints = np.concatenate(rows) if rows else np.zeros((0, 25, 3))
    frame = np.zeros(len(joints), int) if frame is None else np.array(frame)
    return PlainPeople(frame, joints, np.arange(len(joints)), **more)


def annotated(*rows, actor=None, frame=None):
    joints = shelf_joints(np.concatenate(rows))
    count = len(joints)
    return PlainPeople(
        np.zeros(count, int) if frame is None else np.array(frame),
        joints,
        np.arange(count) if actor is None else np.array(actor),
        SHELF_JOINTS,
        complete=False,
    )


HERE, THERE = (0.0, 0, 0), (3.0, 0, 0)


def test_the_mapping_by_hand():
    mapped = dict(zip(SHELF_JOINTS, shelf_joints(upright(*HERE))[0], strict=True))
    for name in SHELF_JOINTS[:12]:
        np.testing.assert_allclose(mapped[name], UPRIGHT[name])
    np.testing.assert_allclose(mapped["MidHip"], UPRIGHT["MidHip"])
    # Half way from the shoulders (1.4) to the ears (1.6), then 12.5 cm forward (+y) and 14.5 cm up.
    np.testing.assert_allclose(mapped["Neck"], [0, 0, 1.5], atol=1e-12)
    np.testing.assert_allclose(mapped["HeadTop"], [0, 0.125, 1.645], atol=1e-12)


@pytest.mark.parametrize("lost", ["REar", "LEar"])
def test_one_ear_is_mirrored_in_the_middle_of_the_shoulders(lost):
    joints = upright(*HERE)
    joints[0, BODY_25.index(lost)] = np.nan
    np.testing.assert_allclose(shelf_joints(joints), shelf_joints(upright(*HERE)), atol=1e-12)


def test_what_is_unknown_stays_unknown():
    joints = upright(*HERE)
    joints[0, [BODY_25.index("REar"), BODY_25.index("LEar"), BODY_25.index("RWrist")]] = np.nan
    unknown = np.isnan(shelf_joints(joints)[0]).any(axis=1)
    assert [name for name, u in zip(SHELF_JOINTS, unknown, strict=True) if u] == [
        "RWrist",
        "Neck",
        "HeadTop",
    ]
    with pytest.raises(ValueError, match=r"\(N, 25, 3\)"):
        shelf_joints(np.zeros((1, 17, 3)))
    assert shelf_joints(np.zeros((0, 25, 3))).shape == (0, 15, 3)


def wrong_limbs(made):
    return {name for name, correct in made.limbs.items() if correct == 0}


def test_perfect_is_exactly_100():
    made = score(people(upright(*HERE), upright(*THERE)),
                 annotated(upright(*HERE), upright(*THERE)))  # fmt: skip
    assert made.people == {0: 100.0, 1: 100.0}
    assert made.figures["pcp"] == made.figures["recall"] == 100.0
    assert made.figures["mpjpe_mm"] == 0.0
    assert (made.found, made.frames) == (2, 1)


def test_one_limb_wrong_by_hand():
    """The right wrist 26 cm off: the lower arm is 25 cm long, half of it 12.5 cm, the mean error 13
    cm.
    """
    predicted = upright(*HERE)
    predicted[0, BODY_25.index("RWrist"), 1] += 0.26
    made = score(people(predicted), annotated(upright(*HERE)))
    assert wrong_limbs(made) == {"right lower arm"}
    assert made.people[0] == pytest.approx(90.0)
    assert made.figures["recall"] == pytest.approx(1400 / 15)
    assert made.figures["mpjpe_mm"] == pytest.approx(260 / 15)


def test_a_limb_at_the_bound_is_right():
    """24 cm: a mean error of 12 cm against 12.5 cm."""
    predicted = upright(*HERE)
    predicted[0, BODY_25.index("RWrist"), 1] += 0.24
    assert score(people(predicted), annotated(upright(*HERE))).people[0] == 100.0


def test_both_ends_share_the_error():
    """Elbow and wrist both 12 cm off: the lower arm's mean is 12 cm; the upper arm's only 6 cm."""
    predicted, truth = upright(*HERE), annotated(upright(*HERE))
    predicted[0, [BODY_25.index("RWrist"), BODY_25.index("RElbow")], 1] += 0.12
    assert score(people(predicted), truth).people[0] == 100.0
    predicted[0, [BODY_25.index("RWrist"), BODY_25.index("RElbow")], 1] += 0.01
    assert score(people(predicted), truth).people[0] == pytest.approx(90.0)


def test_left_and_right_swapped_by_hand():
    """Arms are 40 cm apart: all four arm limbs wrong (25 cm long). Legs 18 cm apart against half of
    40: right.

    The head goes wrong too: forward becomes backward, so that HeadTop is 25 cm off, 12.5 cm in the
    mean, against half of |(0.125, 0.145)| = 9.6 cm.
    """
    made = score(people(upright(*HERE)[:, list(BODY_25.mirror)]), annotated(upright(*HERE)))
    arms = {f"{side} {part} arm" for side in ("left", "right") for part in ("upper", "lower")}
    assert wrong_limbs(made) == arms | {"head"}
    # 6 arm joints 40 cm, 6 leg joints 18 cm, HeadTop 25 cm, Neck and MidHip none.
    assert made.figures["mpjpe_mm"] == pytest.approx((6 * 400 + 6 * 180 + 250) / 15)
    assert made.figures["recall"] == pytest.approx(800 / 15)


def test_a_missing_joint_makes_its_limbs_wrong():
    """Without the right elbow both limbs of the arm are wrong; the joint is not recalled and not in
    MPJPE.
    """
    predicted = upright(*HERE)
    predicted[0, BODY_25.index("RElbow")] = np.nan
    made = score(people(predicted), annotated(upright(*HERE)))
    assert wrong_limbs(made) == {"right upper arm", "right lower arm"}
    assert made.figures["recall"] == pytest.approx(1400 / 15)
    assert made.figures["mpjpe_mm"] == 0.0


def test_a_missing_joint_counts_half_a_metre_in_the_choice():
    """One elbow missing costs 0.5 / 15 = 33.3 mm in the mean: a complete one 33 mm off wins, 34 mm
    off loses.
    """
    holey = upright(*HERE)
    holey[0, BODY_25.index("RElbow")] = np.nan
    truth = annotated(upright(*HERE))
    near = score(people(holey, upright(0, 0, 0.033)), truth).figures
    assert near["mpjpe_mm"] == pytest.approx(33.0) and near["pcp"] == 100
    far = score(people(holey, upright(0, 0, 0.034)), truth).figures
    assert far["mpjpe_mm"] == 0.0 and far["pcp"] == 80


def test_limbs_may_share_a_prediction_and_strangers_cost_nothing():
    """PCP takes the nearest prediction for each person, the other figures match one to one."""
    truth = annotated(upright(*HERE), upright(0, 0.05, 0))
    made = score(people(upright(*HERE), upright(*THERE), upright(9, 9, 9)), truth)
    assert made.people == {0: 100.0, 1: 100.0} and made.found == 1
    assert made.tracks.false_positives == 0


def test_nobody_there():
    """One of two people is predicted, the other takes the far prediction: no limb, no joint, not
    found.
    """
    made = score(people(upright(*HERE)), annotated(upright(*HERE), upright(*THERE)))
    assert made.people == {0: 100.0, 1: 0.0} and made.found == 1
    assert made.figures["pcp"] == made.figures["recall"] == 50.0
    made = score(people(covered=[range(1)]), annotated(upright(*HERE)))
    assert made.people[0] == made.figures["recall"] == 0.0
    assert made.as_dict()["mpjpe_mm"] is None


def test_average_is_over_actors_only():
    """Actor 1 in three frames, all right; actor 3 in one, all wrong; id 3 is not scored."""
    truth = annotated(
        *[upright(*HERE)] * 3,
        upright(*THERE),
        upright(5, 0, 0),
        actor=[0, 0, 0, 2, 3],
        frame=[0, 1, 2, 2, 2],
    )
    made = score(people(*[upright(*HERE)] * 3, frame=[0, 1, 2]), truth)
    assert made.people == {0: 100.0, 2: 0.0} and made.figures["pcp"] == 50.0


def test_predictions_of_other_frames_are_not_taken():
    truth = annotated(upright(*HERE), upright(*HERE), actor=[0, 0], frame=[3, 4])
    assert score(people(upright(*HERE), frame=[3]), truth).people[0] == 50.0


def test_only_reconstructed_frames_are_scored_if_the_run_says_which():
    truth = annotated(*[upright(*HERE)] * 3, actor=[0, 0, 0], frame=[2, 3, 7])
    part = people(upright(*HERE), frame=[3], covered=[range(3, 6)])
    made = score(part, truth)
    assert (made.frames, made.people[0]) == (1, 100.0)
    whole = people(upright(*HERE), frame=[3])
    assert score(whole, truth, range(10)).people[0] == pytest.approx(100 / 3)
    with pytest.raises(InputError, match="2-3, 7"):
        score(part, truth, [5])


def test_without_ears_the_head_is_not_compared():
    """Joints of other skeletons are mapped by name; Shelf's Neck is not that between shoulders."""
    names = ("Neck", *BODY_25.joints[2:8], *BODY_25.joints[9:15])
    joints = upright(*HERE)[:, [BODY_25.index(name) for name in names]]
    made = score(PlainPeople(np.zeros(1, int), joints, np.zeros(1, int), names),
                 annotated(upright(*HERE)))  # fmt: skip
    assert "Neck" not in made.joints and len(made.limbs) == 8 and made.figures["pcp"] == 100


FILE = """15\t3
1
2
{row}
{row}
{row}
{row}
0
2
0
{row}
{row}
{row}
{row}
3
{row}
{row}
{row}
{row}
""".format(row=" ".join(str(i / 10) for i in range(15)))


def test_reading_a_small_file(tmp_path):
    path = tmp_path / "gt.txt"
    path.write_text(FILE)
    truth = read_shelf_ground_truth(path)
    assert truth.frame.tolist() == [0, 2, 2]
    assert truth.person.tolist() == [2, 0, 3]
    np.testing.assert_allclose(truth.joints[1, 4], [0.4, 0.4, 0.4])


LINES = FILE.splitlines()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["17 3", *LINES[1:]], "line 1 must say 15 joints"),
        (["15", *LINES[1:]], "line 1 must hold the number of joints and of frames, got 1 values"),
        (LINES[:5], "ends after line 5, before 15 values of z in frame 0"),
        (LINES[:8], "ends after line 8, before the number of people in frame 2"),
        ([*LINES[:2], "two", *LINES[3:]], "line 3 must hold a person's id in frame 0, .*'two'"),
        (
            [*LINES[:3], LINES[3] + " 1", *LINES[4:]],
            "line 4 must hold 15 values of x in frame 0, got 16",
        ),
        ([*LINES[:3], LINES[3].replace("0.3", "nan"), *LINES[4:]], "line 4 .* finite"),
        ([*LINES[:3], LINES[3].replace("0.3", "0,3"), *LINES[4:]], "line 4 .* finite"),
        ([*LINES[:1], "-1", *LINES[2:]], "line 2 must be the number of people in frame 0, got -1"),
        ([*LINES[:1], "1e3", *LINES[2:]], "line 2 must hold the number of people"),
        ([*LINES[:1], "99999999999", *LINES[2:]], "line 2 must be the number of people"),
        ([*LINES[:14], "0", *LINES[15:]], "line 15 gives the id 0 in frame 2"),
        ([*LINES, "1"], "line 20 goes on after the 3 frames"),
    ],
)
def test_a_broken_file_is_one_clear_sentence(tmp_path, lines, message):
    path = tmp_path / "gt.txt"
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=message) as caught:
        read_shelf_ground_truth(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_file_and_no_text(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_shelf_ground_truth(tmp_path / "gt.txt")
    (tmp_path / "gt.txt").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match=r"gt\.txt"):
        read_shelf_ground_truth(tmp_path / "gt.txt")


def test_limbs_join_the_joints_that_their_names_say():
    named = {name: set(ends) for name, ends in LIMB_ENDS.items()}
    assert named["left upper arm"] == {"LShoulder", "LElbow"}
    assert named["right upper arm"] == {"RShoulder", "RElbow"}
    assert named["left lower arm"] == {"LElbow", "LWrist"}
    assert named["right lower arm"] == {"RElbow", "RWrist"}
    assert named["left upper leg"] == {"LHip", "LKnee"}
    assert named["right upper leg"] == {"RHip", "RKnee"}
    assert named["left lower leg"] == {"LKnee", "LAnkle"}
    assert named["right lower leg"] == {"RKnee", "RAnkle"}
    assert named["head"] == {"Neck", "HeadTop"}
    assert named["torso"] == {"Neck", "MidHip"}


@pytest.fixture(scope="module")
def shelf(shared_data):
    return read_shelf_ground_truth(shared_data / "shelf" / "gt_dev.txt")


def test_the_real_annotation(shelf):
    assert np.bincount(shelf.person).tolist() == [131, 19, 93, 11]
    assert np.unique(shelf.frame).tolist() == [*range(101), *range(216, 231), *range(270, 285)]
    assert np.isfinite(shelf.joints).all()
    # People: lower legs of 30 to 60 cm, in a room of a few metres, standing on the floor z = 0.
    shin = np.linalg.norm(shelf.joints[:, 0] - shelf.joints[:, 1], axis=1)
    assert 0.3 < shin.min() < shin.max() < 0.6
    assert np.abs(shelf.joints[..., 2].min()) < 0.2


def test_the_real_annotation_against_itself(shelf):
    """Ears put where they give the annotated Neck: all limbs but heads are exact, heads depend on
    the mapping.
    """
    body25 = np.full((len(shelf.frame), 25, 3), np.nan)
    for i, name in enumerate(SHELF_JOINTS[:12]):
        body25[:, BODY_25.index(name)] = shelf.joints[:, i]
    body25[:, BODY_25.index("MidHip")] = shelf.joints[:, 14]
    body25[:, BODY_25.index("Neck")] = shelf.joints[:, 12]
    shoulders = shelf.joints[:, 8:10].mean(axis=1)
    for ear in ("REar", "LEar"):
        body25[:, BODY_25.index(ear)] = shoulders + 2 * (shelf.joints[:, 12] - shoulders)
    made = score(PlainPeople(shelf.frame, body25, shelf.person), shelf)
    assert made.found == 131 + 19 + 93
    assert {name for name, correct in made.limbs.items() if correct < 100} <= {"head"}
    # Annotated head tops are 2 to 16 cm from the fixed mapping; 98 % of the heads are right all the
    # same.
    assert made.limbs["head"] > 95
    assert made.figures["recall"] == 100
