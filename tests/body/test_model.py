"""The model against SMPL's formulas written out bone by bone, and its shortcuts against the
mesh.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.rotation import exp_so3, log_so3
from shapepose_fg.body.model.smpl_file import SMPL_PARENTS


def smpl_by_hand(arrays, parameters, b):
    """Vertices and joints of body b, as in the SMPL paper: 4 x 4 transforms, one bone after the
    other.
    """
    betas, transl = parameters.betas[b], parameters.transl[b]
    poses = np.concatenate((parameters.global_orient[b][None], parameters.body_pose[b]))
    R = Rotation.from_rotvec(poses).as_matrix()
    shaped = arrays["v_template"] + arrays["shapedirs"] @ betas
    rest = arrays["J_regressor"] @ shaped
    posed = shaped + arrays["posedirs"] @ (R[1:] - np.eye(3)).ravel()
    G = np.tile(np.eye(4), (24, 1, 1))
    for j in range(24):
        G[j, :3, :3] = R[j]
        G[j, :3, 3] = rest[j] - (rest[SMPL_PARENTS[j]] if j else 0)
        if j:
            G[j] = G[SMPL_PARENTS[j]] @ G[j]
    joints = G[:, :3, 3].copy()
    G[:, :3, 3] -= np.einsum("jxy,jy->jx", G[:, :3, :3], rest)
    per_vertex = np.einsum("vj,jxy->vxy", arrays["weights"], G)
    vertices = np.einsum("vxy,vy->vx", per_vertex[:, :3, :3], posed) + per_vertex[:, :3, 3]
    return vertices + transl, joints + transl


def test_vertices_and_joints_are_smpls(tiny_file, random_parameters):
    model = BodyModel.load(tiny_file)
    parameters = random_parameters()
    with np.load(tiny_file) as arrays:
        expected = [smpl_by_hand(arrays, parameters, b) for b in range(5)]
    np.testing.assert_allclose(model.vertices(parameters), [v for v, _ in expected], atol=1e-12)
    np.testing.assert_allclose(model.joints(parameters), [j for _, j in expected], atol=1e-12)


def test_keypoints_are_the_regressor_on_the_mesh(tiny_model, random_parameters):
    parameters = random_parameters()
    regressor = tiny_model.arrays.keypoint_regressor
    expected = regressor @ tiny_model.vertices(parameters)
    np.testing.assert_allclose(tiny_model.keypoints(parameters), expected, atol=1e-12)


def test_some_vertices_are_those_of_the_mesh_whatever_the_type_of_their_numbers(
    tiny_model, random_parameters
):
    """[1, 0] of 32 bits has the bytes of [1] of 64."""
    parameters = random_parameters()
    whole = tiny_model.vertices(parameters)
    for only in (np.array([1, 0], dtype=np.int32), np.array([1]), np.array([4, 2, 0])[::-1]):
        np.testing.assert_allclose(
            tiny_model.vertices(parameters, only), whole[:, only], atol=1e-12
        )
    with pytest.raises(ValueError, match=r"only` must be \(M,\)"):
        tiny_model.vertices(parameters, np.array([[1, 0]]))


def test_rows_that_do_not_sum_to_one(tmp_path, make_smpl_arrays, random_parameters):
    arrays = make_smpl_arrays()
    arrays["keypoint_regressor"] *= np.linspace(0.985, 1.015, 25)[
        :, None
    ]  # as printed with few digits
    np.savez(tmp_path / "odd.npz", **arrays)
    model = BodyModel.load(tmp_path / "odd.npz")
    expected = arrays["keypoint_regressor"] @ model.vertices(random_parameters())
    keypoints, _ = model.keypoints_with_jacobian(random_parameters())
    np.testing.assert_allclose(keypoints, expected, atol=1e-12)


def moved(parameters, column, step):
    """The parameters after a step along one column of the Jacobian."""
    pose = np.concatenate((parameters.global_orient[:, None], parameters.body_pose), 1)
    betas, transl = parameters.betas.copy(), parameters.transl.copy()
    if column < 10:
        betas[:, column] += step
    elif column >= 82:
        transl[:, column - 82] += step
    else:
        delta = np.zeros(3)
        delta[(column - 10) % 3] = step
        joint = (column - 10) // 3
        pose[:, joint] = log_so3(exp_so3(pose[:, joint]) @ exp_so3(delta))
    return BodyParameters(betas, pose[:, 0], pose[:, 1:], transl)


def test_jacobian_against_differences(tiny_model, random_parameters):
    parameters = random_parameters()
    keypoints, jacobian = tiny_model.keypoints_with_jacobian(parameters)
    assert jacobian.shape == (5, 25, 3, 85)
    np.testing.assert_allclose(keypoints, tiny_model.keypoints(parameters), atol=1e-13)
    for column in range(85):
        ahead = tiny_model.keypoints(moved(parameters, column, 1e-5))
        behind = tiny_model.keypoints(moved(parameters, column, -1e-5))
        # Central differences: truncation 1e-10, rounding 1e-16 / 1e-5.
        np.testing.assert_allclose(jacobian[..., column], (ahead - behind) / 2e-5, atol=2e-9)


def test_batches_longer_than_a_chunk(tiny_model, random_parameters):
    parameters = random_parameters(150)
    keypoints, jacobian = tiny_model.keypoints_with_jacobian(parameters)
    for b in (0, 63, 64, 149):
        one = BodyParameters(*(value[b : b + 1] for value in vars(parameters).values()))
        alone, jacobian_alone = tiny_model.keypoints_with_jacobian(one)
        np.testing.assert_allclose(keypoints[b], alone[0], atol=1e-13)
        np.testing.assert_allclose(jacobian[b], jacobian_alone[0], atol=1e-13)


def test_empty_batch(tiny_model):
    keypoints, jacobian = tiny_model.keypoints_with_jacobian(BodyParameters.zeros(0))
    assert keypoints.shape == (0, 25, 3)
    assert jacobian.shape == (0, 25, 3, 85)


def test_misuse_is_named():
    with pytest.raises(ValueError, match=r"body_pose must be \(B, 23, 3\)"):
        BodyParameters(np.zeros((2, 10)), np.zeros((2, 3)), np.zeros((2, 69)), np.zeros((2, 3)))
