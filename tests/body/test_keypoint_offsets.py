"""Keypoints where a detector puts them: exact, differentiable, kept in files."""

import json

import numpy as np
import pytest

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.keypoint_offsets import RIDES_ON, KeypointOffsets
from shapepose_fg.body.model.rotation import exp_so3, log_so3
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25, SMPL_24


def random_offsets() -> KeypointOffsets:
    rng = np.random.default_rng(0)
    return KeypointOffsets(rng.normal(0, 0.03, (25, 3)), np.full(25, 0.01), np.arange(25), RIDES_ON)


def test_a_keypoint_moves_with_its_bone(tiny_model, random_parameters):
    offsets, parameters = random_offsets(), random_parameters()
    moved = tiny_model.with_keypoint_offsets(offsets)
    turned = tiny_model.bone_rotations(parameters)[:, RIDES_ON]
    shift = (turned @ offsets.xyz_m[..., None]).squeeze(-1)
    expected = tiny_model.keypoints(parameters) + shift
    np.testing.assert_allclose(moved.keypoints(parameters), expected, atol=1e-12)
    # The body itself stays as it is.
    np.testing.assert_array_equal(moved.vertices(parameters), tiny_model.vertices(parameters))
    np.testing.assert_array_equal(moved.joints(parameters), tiny_model.joints(parameters))


def nudged(parameters: BodyParameters, column: int, step: float) -> BodyParameters:
    """The parameters with one column of the Jacobian's tangent stepped."""
    betas, transl = parameters.betas.copy(), parameters.transl.copy()
    rotations = np.concatenate((parameters.global_orient[:, None], parameters.body_pose), 1)
    if column < 10:
        betas[:, column] += step
    elif column >= 82:
        transl[:, column - 82] += step
    else:
        joint, axis = divmod(column - 10, 3)
        turn = np.zeros((3,))
        turn[axis] = step
        rotations[:, joint] = log_so3(exp_so3(rotations[:, joint]) @ exp_so3(turn))
    return BodyParameters(betas, rotations[:, 0], rotations[:, 1:], transl)


def test_the_jacobian_knows_of_the_offsets(tiny_model, random_parameters):
    moved, parameters = tiny_model.with_keypoint_offsets(random_offsets()), random_parameters()
    keypoints, jacobian = moved.keypoints_with_jacobian(parameters)
    np.testing.assert_allclose(keypoints, moved.keypoints(parameters), atol=1e-12)
    step = 1e-6
    for column in range(85):
        ahead, behind = (
            moved.keypoints(nudged(parameters, column, sign * step)) for sign in (1, -1)
        )
        numeric = (ahead - behind) / (2 * step)
        # Central differences in double precision: truncation 1e-12, rounding 1e-16 / 1e-6.
        np.testing.assert_allclose(jacobian[..., column], numeric, atol=1e-7)


def test_offsets_outlast_a_change_of_type_and_replace_each_other(tiny_model, random_parameters):
    parameters = random_parameters()
    single = tiny_model.with_keypoint_offsets(random_offsets())
    double = tiny_model.with_keypoint_offsets(random_offsets())
    # Single precision, some metres from the origin and through a chain of eight turns: some
    # micrometres.
    expected = double.keypoints(random_parameters())
    np.testing.assert_allclose(single.keypoints(parameters), expected, atol=2e-5)
    back = double.with_keypoint_offsets(KeypointOffsets.identity())
    expected = tiny_model.keypoints(random_parameters())
    np.testing.assert_array_equal(back.keypoints(random_parameters()), expected)


def test_every_joint_rides_on_a_bone_that_the_keypoints_show():
    model = BodyModel.default()
    _, jacobian = model.keypoints_with_jacobian(BodyParameters.zeros(1))
    speed = np.abs(jacobian[0, ..., 10:-3]).reshape(25, 3, 24, 3).max(axis=(0, 1, 3))
    assert (speed[np.unique(RIDES_ON)] > 0.01).all()  # metres a radian


def test_mirrored_joints_ride_on_mirrored_bones():
    for joint, mirror in enumerate(BODY_25.mirror):
        bone, other = SMPL_24[RIDES_ON[joint]], SMPL_24[RIDES_ON[mirror]]
        swapped = bone.replace("left", "?").replace("right", "left").replace("?", "right")
        assert other == swapped


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("xyz_m", np.zeros((24, 3)), r"xyz_m must be \(25, 3\)"),
        ("xyz_m", np.full((25, 3), np.nan), "finite"),
        ("xyz_m", np.full((25, 3), 30.0), "metres"),
        ("sigma_m", np.full(25, -1.0), "negative"),
        ("bones", np.full(25, 24), "indices"),
    ],
)
def test_nonsense_is_refused(name, value, message):
    with pytest.raises(ValueError, match=message):
        KeypointOffsets(**{**vars(KeypointOffsets.identity()), name: value})


def test_files_give_back_what_was_written(tmp_path):
    offsets = random_offsets()
    offsets.save(tmp_path / "offsets.json")
    (tmp_path / "run.json").write_text(
        json.dumps({"seconds": {}, "keypoint_offsets": offsets.as_dict()})
    )
    for name in ("offsets.json", "run.json"):
        again = KeypointOffsets.load(tmp_path / name)
        np.testing.assert_allclose(
            again.xyz_m, offsets.xyz_m, atol=5.1e-7
        )  # written to a micrometre
        np.testing.assert_allclose(again.sigma_m, offsets.sigma_m, atol=5.1e-7)
        np.testing.assert_array_equal(again.count, offsets.count)
        np.testing.assert_array_equal(again.bones, offsets.bones)


@pytest.mark.parametrize("damage", ["format", "joint", "bone", "text", "huge", "list"])
def test_a_damaged_file_is_an_input_error(tmp_path, damage):
    content = random_offsets().as_dict()
    if damage == "format":
        content["format"] = "something else"
    elif damage == "joint":
        del content["joints"]["Neck"]
    elif damage == "bone":
        content["joints"]["Neck"]["bone"] = "tail"
    elif damage == "text":
        content["joints"]["Neck"]["xyz_mm"] = ["1", 2, 3]
    elif damage == "huge":
        content["joints"]["Neck"]["xyz_mm"] = [1e5, 0, 0]
    else:
        content["joints"] = [1, 2]
    path = tmp_path / "damaged.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"damaged\.json"):
        KeypointOffsets.load(path)
