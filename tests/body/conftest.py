"""A tiny random body in SMPL's file format: joints are roughly where a person's are, and nothing
else is human: no symmetry hides a mistake.
"""

import numpy as np
import pytest

from shapepose_fg.body.fitting.weights import FitterWeights
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.smpl_file import SMPL_PARENTS
from tests.conftest import read_body

NUM_VERTICES = 60


def make_smpl_arrays(
    num_betas: int = 10, num_vertices: int = NUM_VERTICES
) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    person = read_body()
    joints = np.concatenate([person.joint_regressor, person.keypoint_regressor]) @ person.template
    template = rng.normal(0, 0.5, (num_vertices, 3))
    template[:49] = joints + rng.normal(0, 0.02, joints.shape)
    weights = rng.random((num_vertices, 24)) ** 4
    regressor, keypoints = (rng.random((count, num_vertices)) ** 4 for count in (24, 25))
    regressor[:, :24] += 5 * regressor.sum(1).mean() * np.eye(24)
    keypoints[:, 24:49] += 5 * keypoints.sum(1).mean() * np.eye(25)
    return {
        "v_template": template,
        "shapedirs": rng.normal(0, 0.05, (num_vertices, 3, num_betas)),
        "posedirs": rng.normal(0, 0.02, (num_vertices, 3, 207)),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.array([(2**32 - 1, *SMPL_PARENTS[1:]), range(24)], dtype=np.uint32),
        "f": rng.integers(0, num_vertices, (40, 3)).astype(np.uint32),
        "keypoint_regressor": keypoints / keypoints.sum(1, keepdims=True),
    }


def random_parameters(batch: int = 5) -> BodyParameters:
    rng = np.random.default_rng(0)
    return BodyParameters(
        *(rng.normal(size=(batch, *shape)) for shape in ((10,), (3,), (23, 3), (3,)))
    )


@pytest.fixture(name="make_smpl_arrays")
def _make_smpl_arrays():
    return make_smpl_arrays


@pytest.fixture(name="random_parameters")
def _random_parameters():
    return random_parameters


@pytest.fixture(params=["with pose blend shapes", "without"])
def tiny_file(request, tmp_path):
    arrays = make_smpl_arrays()
    if request.param == "without":
        arrays["posedirs"] *= 0
    path = tmp_path / "tiny.npz"
    np.savez(path, **arrays)
    return path


@pytest.fixture
def tiny_model(tiny_file) -> BodyModel:
    return BodyModel.load(tiny_file)


@pytest.fixture(params=["the shipped body", "tiny with pose blend shapes", "tiny without"])
def any_body(request, tmp_path) -> BodyModel:
    """A body."""
    if request.param == "the shipped body":
        return BodyModel.default()
    arrays = make_smpl_arrays()
    arrays["posedirs"] *= request.param == "tiny with pose blend shapes"
    np.savez(tmp_path / "tiny.npz", **arrays)
    return BodyModel.load(tmp_path / "tiny.npz")


@pytest.fixture(scope="session")
def shipped_weights() -> FitterWeights:
    """The learned fitter's weights that come with the package."""
    return FitterWeights.default()
