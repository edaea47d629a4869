"""What other programs call joints: synonyms, orders by name."""

import pytest

from shapepose_fg.core.joint_names import (
    body_points,
    keypoint_names,
    layouts_called,
    skeleton_of_names,
)
from shapepose_fg.core.skeleton import COCO_17, SKELETONS

COCO = (
    "nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow "
    "right_elbow left_wrist right_wrist left_hip right_hip left_knee right_knee left_ankle "
    "right_ankle"
).split()


@pytest.mark.parametrize(
    "name",
    "LShoulder,left_shoulder,Left_Shoulder,LEFT_SHOULDER,l_shoulder,shoulder_left,leftShoulder,shoulder.L,lshoulder,"
    "left-shoulder,shoulderLeft,L_SHOULDER,left shoulder".split(","),
)
def test_a_name_is_read_however_it_is_written(name):
    assert body_points([name]) == ["LShoulder"]
    assert body_points(["RHip", name]) == ["RHip", "LShoulder"]


@pytest.mark.parametrize(
    ("name", "point"),
    [
        ("pelvis", "MidHip"), ("root (pelvis)", "MidHip"), ("CHip", "MidHip"),
        ("mid_hip", "MidHip"), ("head_top", "Head"), ("top_head", "Head"), ("HeadTop", "Head"),
        ("upper_neck", "head"), ("thorax", "Neck"), ("left_big_toe", "LBigToe"),
        ("LEFT_FOOT_INDEX", "LBigToe"), ("Lknee", "LKnee"), ("RSmallToe", "RSmallToe"),
        ("right_ear", "REar"), ("belly", "spine1"), ("left eye (inner)", "LEye"),
        ("LEFT_EYE_INNER", ""), ("mouth_left", ""), ("right_pinky", ""), ("LThumb", ""),
        ("Nose1", ""), ("REye3", ""), ("kp_7", ""), ("", ""), ("left_tail", ""),
    ],
)  # fmt: skip
def test_what_names_mean(name, point):
    assert body_points([name]) == [point]


def test_what_a_name_means_beside_others():
    """A foot is the ankle of Human3.6M and no ankle of a set that has one; the same of heads and
    necks.
    """
    assert body_points(["left_knee", "left_foot"]) == ["LKnee", "LAnkle"]
    assert body_points(["left_ankle", "left_foot"]) == ["LAnkle", "left_foot"]
    assert body_points(["thorax", "neck_base", "head"]) == ["Neck", "head", "Head"]
    assert body_points(["neck", "head", "head_top"]) == ["Neck", "head", "Head"]
    assert body_points(["person1_nose", "person1_left_hip"]) == ["Nose", "LHip"]
    assert body_points(["root", "pelvis"]) == ["MidHip", ""]
    assert body_points(["left_upLeg_joint", "left_shoulder_1_joint"]) == ["LHip", "LShoulder"]
    bones = [
        "LeftUpLeg",
        "LeftLeg",
        "LeftFoot",
        "LeftShoulder",
        "LeftArm",
        "LeftForeArm",
        "LeftHand",
    ]
    points = ["LHip", "LKnee", "LAnkle", "left_collar", "LShoulder", "LElbow", "LWrist"]
    assert body_points(bones) == points
    assert body_points(["left_arm", "left_leg"]) == ["", ""]


@pytest.mark.parametrize("skeleton", SKELETONS.values(), ids=SKELETONS)
def test_every_layout_is_found_by_its_own_names(skeleton):
    assert (
        body_points(keypoint_names(skeleton))[: len(skeleton)]
        == keypoint_names(skeleton)[: len(skeleton)]
    )
    assert skeleton in layouts_called(skeleton.name) and skeleton in layouts_called(
        skeleton.name.lower()
    )


def test_names_in_another_order_are_a_skeleton_of_that_order():
    assert skeleton_of_names(COCO) == (COCO_17, [])
    mixed, passed = skeleton_of_names([*COCO[::-1], "mouth_left"])
    assert keypoint_names(mixed) == [*keypoint_names(COCO_17)[::-1], ""] and passed == [
        "mouth_left"
    ]
    assert set(mixed.joints) == set(COCO_17.joints)
    with pytest.raises(ValueError, match="there is no RHip and no LHip, but both shoulders"):
        skeleton_of_names([name for name in COCO if "hip" not in name])


def test_names_of_layouts_mean_several_where_programs_differ():
    assert [each.name for each in layouts_called("coco")] == ["COCO_17", "COCO_18"]
    assert [each.name for each in layouts_called("MPII")] == ["MPII_16", "MPI_15"]
    assert [each.name for each in layouts_called("Body_with_feet")] == ["HALPE_26"]
    assert layouts_called("") == layouts_called("horse10") == []
