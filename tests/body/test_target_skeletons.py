"""The points that a body can be fitted to: each against the mesh and the joints, mirrored, with
offsets.
"""

import numpy as np
import pytest

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.keypoint_offsets import RIDES_ON, KeypointOffsets
from shapepose_fg.body.model.target_skeletons import BODY_POINTS, MIRROR, TARGET_SKELETONS, slots
from shapepose_fg.core.skeleton import BODY_25, SMPL_24


def points_of_the_mesh(model: BodyModel, parameters: BodyParameters) -> dict[str, np.ndarray]:
    """Every body point (B, 3) from vertices and joints."""
    vertices, joints = model.vertices(parameters), model.joints(parameters)
    keypoints = model.arrays.keypoint_regressor @ vertices
    top = vertices[:, np.argmax(model.arrays.template[:, 1])]
    points = {name: keypoints[:, row] for row, name in enumerate(BODY_25.joints)} | {"Head": top}
    return points | {name: joints[:, row] for row, name in enumerate(SMPL_24)}


@pytest.mark.parametrize("name", TARGET_SKELETONS)
def test_keypoints_of_each_skeleton_are_those_of_the_mesh(any_body, random_parameters, name):
    names, parameters = TARGET_SKELETONS[name], random_parameters()
    expected = points_of_the_mesh(any_body, parameters)
    chosen = any_body.with_keypoints(names)
    assert chosen.keypoint_names == names
    xyz, jacobian = chosen.keypoints_with_jacobian(parameters)
    expected = np.stack([expected[joint] for joint in names], axis=1)
    np.testing.assert_allclose(chosen.keypoints(parameters), expected, atol=1e-12)
    np.testing.assert_allclose(xyz, expected, atol=1e-12)
    assert jacobian.shape == (5, len(names), 3, 85)


def test_skeletons_have_the_joints_that_their_names_promise():
    count = {name: len(joints) for name, joints in TARGET_SKELETONS.items()}
    assert count == {"BODY_25": 25, "COCO_17": 17, "HALPE_26": 26, "SMPL_24": 24}
    for joints in TARGET_SKELETONS.values():
        assert len(set(joints)) == len(joints)
    assert TARGET_SKELETONS["COCO_17"][:7] == (
        "Nose",
        "LEye",
        "REye",
        "LEar",
        "REar",
        "LShoulder",
        "RShoulder",
    )
    assert TARGET_SKELETONS["HALPE_26"][17:20] == ("Head", "Neck", "MidHip")


def test_the_mirror_swaps_sides_and_comes_back():
    assert [MIRROR[place] for place in MIRROR] == list(range(len(BODY_POINTS)))
    for name, place in zip(BODY_POINTS, MIRROR, strict=True):
        if name.startswith("left_"):
            assert BODY_POINTS[place] == name.replace("left", "right")
        elif name[0] in "LR":
            assert BODY_POINTS[place] == {"L": "R", "R": "L"}[name[0]] + name[1:]
        elif not name.startswith("right_"):
            assert BODY_POINTS[place] == name


def test_a_mirrored_point_is_where_the_mirror_shows_it():
    model = BodyModel.default().with_keypoints(BODY_POINTS)
    xyz = model.keypoints(BodyParameters.zeros(1))[0]
    # The shipped body's two sides are alike to some millimetres; neighbouring joints are
    # centimetres apart.
    np.testing.assert_allclose(xyz[list(MIRROR)] * [-1, 1, 1], xyz, atol=0.01)


def test_unknown_points_are_named():
    with pytest.raises(ValueError, match="a body has no Tail; it has Nose"):
        slots(("Nose", "Tail"))
    with pytest.raises(ValueError, match="Tail"):
        BodyModel.default().with_keypoints(("Tail",))


def test_bodies_turn_about_the_pelvis_of_the_rest_pose(any_body, random_parameters):
    parameters = random_parameters()
    pelvis = any_body.rest_pelvis(parameters.betas)
    zero = np.zeros((5, 3))
    posed = BodyParameters(parameters.betas, parameters.global_orient, parameters.body_pose, zero)
    np.testing.assert_allclose(any_body.joints(posed)[:, 0], pelvis, atol=1e-12)


def test_offsets_go_with_the_keypoints_that_are_chosen(any_body, random_parameters):
    rng, parameters = np.random.default_rng(0), random_parameters()
    offsets = KeypointOffsets(
        rng.normal(0, 0.03, (25, 3)), np.full(25, 0.01), np.arange(25), RIDES_ON
    )
    plain = any_body.with_keypoints(TARGET_SKELETONS["HALPE_26"])
    assert plain.offsets_of_keypoints is None
    moved = plain.with_keypoint_offsets(offsets)
    assert moved.keypoint_names == plain.keypoint_names
    assert moved.offsets_of_keypoints is not None
    xyz, bones = moved.offsets_of_keypoints
    shift = (any_body.bone_rotations(parameters)[:, bones] @ xyz[..., None]).squeeze(-1)
    expected = plain.keypoints(parameters) + shift
    np.testing.assert_allclose(moved.keypoints(parameters), expected, atol=1e-12)
    for row, name in enumerate(moved.keypoint_names):
        own = offsets.xyz_m[BODY_25.index(name)] if name in BODY_25.joints else np.zeros(3)
        np.testing.assert_array_equal(xyz[row], own)
    smpl = any_body.with_keypoints(SMPL_24).with_keypoint_offsets(offsets)
    np.testing.assert_allclose(smpl.keypoints(parameters), any_body.joints(parameters), atol=1e-12)
