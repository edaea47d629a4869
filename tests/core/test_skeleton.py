import numpy as np
import pytest

from shapepose_fg.body.model.target_skeletons import TARGET_SKELETONS, slots
from shapepose_fg.core.skeleton import BODY_25, COCO_17, SKELETONS, SMPL_24, Skeleton


def test_body_25_is_openpose_s():
    assert len(BODY_25) == 25 and len(BODY_25.limbs) == 26 and len(SMPL_24) == 24
    assert BODY_25.index("MidHip") == BODY_25.root == 8
    with pytest.raises(ValueError, match="has no joint 'Tail'"):
        BODY_25.index("Tail")


def test_mirror_swaps_left_and_right():
    mirror = np.array(BODY_25.mirror)
    np.testing.assert_array_equal(mirror[mirror], np.arange(25))
    for joint, other in zip(BODY_25.joints, mirror, strict=True):
        side = {"R": "L", "L": "R"}.get(joint[0]) if joint[1].isupper() else None
        assert BODY_25.joints[other] == (side + joint[1:] if side else joint)


def test_tree_hangs_on_limbs_and_reaches_every_joint():
    levels = np.concatenate(BODY_25.tree_levels)
    assert sorted(levels) == list(range(25))
    for joint, parent in enumerate(BODY_25.parents):
        assert parent < 0 or BODY_25.adjacency[joint, parent] == 1
    assert (BODY_25.adjacency == BODY_25.adjacency.T).all() and BODY_25.adjacency.sum() == 52


def test_tree_neighbours_are_parent_and_children():
    assert set(BODY_25.tree_neighbours[BODY_25.index("Neck")].tolist()) - {-1} == {8, 2, 5, 0}


@pytest.mark.parametrize("skeleton", SKELETONS.values(), ids=SKELETONS)
def test_every_skeleton_is_one_tree_on_its_limbs_and_mirrors_itself(skeleton):
    assert sorted(np.concatenate(skeleton.tree_levels)) == list(range(len(skeleton)))
    for joint, parent in enumerate(skeleton.parents):
        assert parent < 0 or skeleton.adjacency[joint, parent] == 1
    mirror = np.array(skeleton.mirror)
    np.testing.assert_array_equal(mirror[mirror], np.arange(len(skeleton)))
    wanted = [
        BODY_25.joints[joint] for joint in BODY_25.core if BODY_25.joints[joint] in skeleton.joints
    ]
    assert [skeleton.joints[joint] for joint in skeleton.core] == wanted and len(wanted) >= 14
    assert {skeleton.joints[hip] for hip in skeleton.hips} == {"RHip", "LHip"}
    assert skeleton.joints[skeleton.root] == "MidHip"
    # A body has a point for every joint.
    slots(skeleton.joints)


def test_a_skeleton_without_middles_has_them_made():
    assert [COCO_17.joints[joint] for joint, _, _ in COCO_17.middles] == ["Neck", "MidHip"]
    assert {COCO_17.joints[joint] for joint in COCO_17.anchor} == {"RHip", "LHip"}
    assert BODY_25.anchor == (8,) and BODY_25.middles == ()
    counts = {name: (each.keypoint_count, len(each)) for name, each in SKELETONS.items()}
    assert (
        counts.items()
        >= {
            "BODY_25": (25, 25),
            "COCO_17": (17, 19),
            "COCO_18": (18, 19),
            "HALPE_26": (26, 26),
            "COCO_133": (133, 25),
            "HALPE_136": (136, 26),
            "BODY_25B": (25, 27),
            "H36M_17": (17, 17),
            "BLAZEPOSE_33": (33, 23),
        }.items()
    )


def test_target_skeletons_have_the_detectors_order():
    for name in ("COCO_17", "HALPE_26", "BODY_25"):
        given = list(TARGET_SKELETONS[name])
        assert list(SKELETONS[name].joints[: len(given)]) == given


def test_an_anchor_needs_two_joints_that_mirror_each_other_beside_it():
    parts = {
        "limbs": [("A", "B"), ("B", "LC"), ("B", "RC")],
        "mirror": [("RC", "LC")],
        "core": ["A", "B"],
    }
    assert Skeleton.of("four", ["A", "B", "LC", "RC"], anchor="B", **parts).parents == (1, -1, 1, 1)
    with pytest.raises(ValueError, match="two joints next to the anchor A must be left and right"):
        Skeleton.of("four", ["A", "B", "LC", "RC"], anchor="A", **parts)
