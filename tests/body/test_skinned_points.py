"""Points on a skinned body: gradients without a Jacobian against the Jacobian, parts against the whole."""

import numpy as np

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters, accumulate
from shapepose_fg.body.model.rotation import exp_so3
from shapepose_fg.body.model.skinned_points import SkinnedPoints

Posed = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]


def posed(points: SkinnedPoints, parameters: BodyParameters) -> Posed:
    """Local and world rotations, betas, transl and pose feature."""
    local = exp_so3(np.concatenate((parameters.global_orient[:, None], parameters.body_pose), 1))
    feature = (local[:, 1:] - np.eye(3, dtype=local.dtype)).flatten(1)
    feature = None if points.offsets_pose is None else feature
    return local, accumulate(local), parameters.betas, parameters.transl, feature


def test_forces_pulled_back_are_the_jacobians_transpose_times_them(any_body, random_parameters):
    points = any_body.points
    local, rotations, betas, transl, feature = posed(points, random_parameters(70))  # more than a chunk
    _, jacobian = points.positions_with_jacobian(rotations, betas, transl, local, feature)
    _, arms = points.positions_with_arms(rotations, betas, transl, feature)
    forces = np.random.default_rng(0).normal(size=(70, len(points.root), 3))
    expected = np.einsum("bkxp,bkx->bp", jacobian, forces)
    pulled = points.pull_back(forces, arms, rotations, local)
    # Sums of 150 products of numbers about 1, in double precision.
    np.testing.assert_allclose(pulled, expected, atol=1e-11)


def test_positions_are_the_same_by_each_way(any_body, random_parameters):
    points = any_body.points
    local, rotations, betas, transl, feature = posed(points, random_parameters())
    xyz = points.positions(rotations, betas, transl, feature)
    by_arms, _ = points.positions_with_arms(rotations, betas, transl, feature)
    by_jacobian, _ = points.positions_with_jacobian(rotations, betas, transl, local, feature)
    np.testing.assert_allclose(by_arms, xyz, atol=1e-12)
    np.testing.assert_allclose(by_jacobian, xyz, atol=1e-12)


def test_parts_are_rows_of_the_whole_and_join_to_it_again(any_body, random_parameters):
    points = any_body.points
    local, rotations, betas, transl, feature = posed(points, random_parameters())
    xyz, jacobian = points.positions_with_jacobian(rotations, betas, transl, local, feature)
    rows = [30, 2, 25, 7]
    part_xyz, part_jacobian = points.part(rows).positions_with_jacobian(rotations, betas, transl, local, feature)
    np.testing.assert_allclose(part_xyz, xyz[:, rows], atol=1e-13)
    np.testing.assert_allclose(part_jacobian, jacobian[:, rows], atol=1e-13)
    joined = points.part(list(range(20))).joined(points.part(list(range(20, 50))))
    again = joined.positions(rotations, betas, transl, feature)
    np.testing.assert_allclose(again, xyz, atol=1e-13)


def test_points_with_pose_blend_shapes_join_points_without(make_smpl_arrays, tmp_path, random_parameters):
    np.savez(tmp_path / "tiny.npz", **make_smpl_arrays())
    model = BodyModel.load(tmp_path / "tiny.npz")
    assert model.points.offsets_pose is not None
    joints = np.arange(26, 50)
    assert not model.points.offsets_pose[:, joints].any()  # joints do not blend
    assert bool(model.points.offsets_pose[:, :26].any())
    parameters = random_parameters()
    _, rotations, betas, transl, feature = posed(model.points, parameters)
    xyz = model.points.positions(rotations, betas, transl, feature)
    np.testing.assert_allclose(xyz[:, 26:], model.joints(parameters), atol=1e-12)
    np.testing.assert_allclose(xyz[:, :25], model.keypoints(parameters), atol=1e-12)
