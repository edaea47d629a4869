"""Every refusal of a file that is no body model, and the keypoints of SMPL's own mesh."""

import numpy as np
import pytest

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25, SMPL_24


@pytest.fixture
def save(tmp_path):
    def save(arrays):
        np.savez(tmp_path / "body.npz", **arrays)
        return tmp_path / "body.npz"

    return save


@pytest.mark.parametrize("name", "v_template shapedirs J_regressor weights kintree_table f".split())
def test_missing_key(name, save, make_smpl_arrays):
    arrays = make_smpl_arrays()
    del arrays[name]
    with pytest.raises(InputError, match=rf"body\.npz: {name} is missing"):
        BodyModel.load(save(arrays))


@pytest.mark.parametrize(
    "name", "v_template shapedirs posedirs J_regressor weights keypoint_regressor".split()
)
def test_nan(name, save, make_smpl_arrays):
    arrays = make_smpl_arrays()
    arrays[name].flat[3] = np.nan
    with pytest.raises(InputError, match=rf"body\.npz: {name} has values that are not finite"):
        BodyModel.load(save(arrays))


@pytest.mark.parametrize(
    "name", "v_template shapedirs posedirs J_regressor weights keypoint_regressor f".split()
)
def test_wrong_shape(name, save, make_smpl_arrays):
    arrays = make_smpl_arrays()
    arrays[name] = arrays[name][..., :-1]
    with pytest.raises(InputError, match=rf"body\.npz: {name} must be"):
        BodyModel.load(save(arrays))


def test_another_tree(save, make_smpl_arrays):
    arrays = make_smpl_arrays()
    arrays["kintree_table"][0, 20] = 17
    with pytest.raises(InputError, match="kintree_table is not the tree of SMPL's 24 joints"):
        BodyModel.load(save(arrays))


def test_a_face_without_vertex(save, make_smpl_arrays):
    arrays = make_smpl_arrays()
    arrays["f"][2, 1] = 60
    with pytest.raises(InputError, match=r"f names vertices outside 0\.\.59"):
        BodyModel.load(save(arrays))


def test_weights_that_do_not_sum_to_one(save, make_smpl_arrays):
    arrays = make_smpl_arrays()
    arrays["weights"][5] *= 0.9
    with pytest.raises(InputError, match="rows that sum to 1"):
        BodyModel.load(save(arrays))


def test_no_keypoint_regressor(save, make_smpl_arrays):
    arrays = make_smpl_arrays()
    regressor = arrays.pop("keypoint_regressor")
    with pytest.raises(InputError, match=r"pass keypoint_regressor= \(25, 60\)"):
        BodyModel.load(save(arrays))
    given = BodyModel.load(save(arrays), keypoint_regressor=regressor)
    np.testing.assert_array_equal(given.arrays.keypoint_regressor, regressor)
    with pytest.raises(InputError, match="keypoint_regressor must be"):
        BodyModel.load(save(arrays), keypoint_regressor=regressor[:24])


def test_not_a_body_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        BodyModel.load(tmp_path / "none.npz")
    (tmp_path / "body.obj").write_text("v 0 0 0")
    with pytest.raises(InputError, match=r"must be \.npz or \.pkl"):
        BodyModel.load(tmp_path / "body.obj")
    (tmp_path / "torn.npz").write_bytes(b"PK\x03\x04 torn")
    with pytest.raises(InputError, match=r"torn\.npz: cannot be read"):
        BodyModel.load(tmp_path / "torn.npz")


def test_npz_with_pickled_objects_is_refused(tmp_path, make_smpl_arrays):
    arrays = make_smpl_arrays()
    np.savez(tmp_path / "objects.npz", **{**arrays, "v_template": np.array([{}, []], dtype=object)})
    with pytest.raises(InputError, match=r"objects\.npz: cannot be read"):
        BodyModel.load(tmp_path / "objects.npz")


def test_the_first_ten_of_more_shape_components(save, make_smpl_arrays):
    arrays = make_smpl_arrays(num_betas=300)
    model = BodyModel.load(save(arrays))
    assert model.num_betas == 10
    np.testing.assert_array_equal(model.arrays.shapes, arrays["shapedirs"][..., :10])
    with pytest.raises(InputError, match="shapedirs must be"):
        BodyModel.load(save(make_smpl_arrays(num_betas=9)))


def test_keypoints_of_smpls_own_mesh(save, make_smpl_arrays):
    arrays = make_smpl_arrays(num_vertices=6890)
    del arrays["keypoint_regressor"], arrays["posedirs"]
    arrays["v_template"][:, 1] = np.clip(arrays["v_template"][:, 1], -1.2, 0.6)  # a person's height
    model = BodyModel.load(save(arrays))
    keypoints = dict(zip(BODY_25.joints, model.keypoints(BodyParameters.zeros(1))[0], strict=True))
    joints = dict(zip(SMPL_24, model.joints(BodyParameters.zeros(1))[0], strict=True))
    tolerance = {"atol": 1e-6}  # float32
    # Vertices as the community's SMPL tools have them (smplx, `vertex_ids`).
    vertices = {"Nose": 332, "REye": 6260, "LEye": 2800, "REar": 4071, "LEar": 583, "LBigToe": 3216}
    vertices |= {
        "LSmallToe": 3226,
        "LHeel": 3387,
        "RBigToe": 6617,
        "RSmallToe": 6624,
        "RHeel": 6787,
    }
    for name, vertex in vertices.items():
        np.testing.assert_allclose(keypoints[name], arrays["v_template"][vertex], **tolerance)
    np.testing.assert_allclose(keypoints["RKnee"], joints["right_knee"], **tolerance)
    hips = (joints["left_hip"] + joints["right_hip"]) / 2
    np.testing.assert_allclose(keypoints["MidHip"], hips, **tolerance)
