"""Points on a skinned body: their Jacobian against differences, parts against the whole."""

import numpy as np

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.rotation import exp_so3


def test_the_jacobian_is_that_of_the_positions(any_body, random_parameters):
    points, body, step = any_body.points, random_parameters(3), 1e-6
    xyz, jacobian = points.positions_with_jacobian(body.local, body.betas, body.transl)
    np.testing.assert_allclose(
        points.positions(body.local, body.betas, body.transl), xyz, atol=1e-12
    )
    for column in range(0, 85, 4):

        def moved(by: float, column: int = column) -> np.ndarray:
            local, betas, transl = body.local, body.betas.copy(), body.transl.copy()
            if column < 10:
                betas[:, column] += by
            elif column >= 82:
                transl[:, column - 82] += by
            else:
                joint, axis = divmod(column - 10, 3)
                local[:, joint] = local[:, joint] @ exp_so3(by * np.eye(3)[axis])
            return points.positions(local, betas, transl)

        numeric = (moved(step) - moved(-step)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., column], numeric, atol=1e-8)


def test_parts_are_rows_of_the_whole_and_join_to_it_again(any_body, random_parameters):
    points = any_body.points
    body = random_parameters()
    given = body.local, body.betas, body.transl
    xyz, jacobian = points.positions_with_jacobian(*given)
    rows = [30, 2, 25, 7]
    part_xyz, part_jacobian = points.part(rows).positions_with_jacobian(*given)
    np.testing.assert_allclose(part_xyz, xyz[:, rows], atol=1e-13)
    np.testing.assert_allclose(part_jacobian, jacobian[:, rows], atol=1e-13)
    joined = points.part(list(range(20))).joined(points.part(list(range(20, 50))))
    np.testing.assert_allclose(joined.positions(*given), xyz, atol=1e-13)


def test_points_with_pose_blend_shapes_join_points_without(
    make_smpl_arrays, tmp_path, random_parameters
):
    np.savez(tmp_path / "tiny.npz", **make_smpl_arrays())
    model = BodyModel.load(tmp_path / "tiny.npz")
    assert model.points.offsets_pose is not None
    joints = np.arange(26, 50)
    assert not model.points.offsets_pose[:, joints].any()  # joints do not blend
    assert model.points.offsets_pose[:, :26].any()
    parameters = random_parameters()
    xyz = model.points.positions(parameters.local, parameters.betas, parameters.transl)
    np.testing.assert_allclose(xyz[:, 26:], model.joints(parameters), atol=1e-12)
    np.testing.assert_allclose(xyz[:, :25], model.keypoints(parameters), atol=1e-12)
