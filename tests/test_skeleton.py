import numpy as np
import pytest

from shapepose_fg.skeleton import BODY_25, SMPL_24


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
