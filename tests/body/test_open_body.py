"""The body that ships: is it a human, in SMPL's pose, on SMPL's joints, with keypoints where people
have them?
"""

from pathlib import Path

import numpy as np
import pytest

import shapepose_fg.body.model.body_model
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.skeleton import BODY_25, SMPL_24


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return BodyModel.default()


def zeros(batch: int = 1) -> BodyParameters:
    return BodyParameters.zeros(batch)


def posed(**degrees: tuple[float, float, float]) -> BodyParameters:
    parameters = zeros()
    for name, angles in degrees.items():
        parameters.body_pose[0, SMPL_24.index(name) - 1] = np.deg2rad(np.array(angles))
    return parameters


def joints_by_name(body: BodyModel, parameters: BodyParameters) -> dict[str, np.ndarray]:
    return dict(zip(SMPL_24, body.joints(parameters)[0], strict=True))


def volume(body: BodyModel, parameters: BodyParameters) -> float:
    a, b, c = body.vertices(parameters)[0][body.faces].transpose(1, 0, 2)
    return float(np.einsum("fx,fx->", a, np.cross(b, c)) / 6)


def winding(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """How often a mesh (F, 3, 3) goes round each point: 1 inside, 0 outside (van Oosterom and
    Strackee 1983).
    """
    a, b, c = (triangles[None, :, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    dot = [np.einsum("pfx,pfx->pf", u, v) for u, v in ((a, b), (b, c), (c, a))]
    numerator = np.einsum("pfx,pfx->pf", a, np.cross(b, c))
    denominator = la * lb * lc + dot[0] * lc + dot[1] * la + dot[2] * lb
    return 2 * np.arctan2(numerator, denominator).sum(1) / (4 * np.pi)


def test_it_is_read_once_and_small():
    assert BodyModel.default() is BodyModel.default()
    data = Path(shapepose_fg.body.model.body_model.__file__).parents[1] / "data"
    assert (data / "open_body.npz").stat().st_size < 4e6
    assert BodyModel.default().num_vertices < 14000


def test_heights_are_those_of_adults(body):
    parameters = zeros(5)
    parameters.betas[:, 0] = np.arange(-2, 3)
    heights = np.ptp(body.vertices(parameters)[..., 1], axis=1)
    assert 1.66 < heights[2] < 1.74
    np.testing.assert_allclose(
        np.diff(heights), 0.1, atol=0.02
    )  # a standard deviation over women and men


def test_betas_are_standard_deviations_of_many_lengths(body):
    """Limbs vary by some 3 % about what stature foretells, as people's do."""
    betas = np.random.default_rng(0).normal(size=(2000, 10))
    parameters = zeros(2000)
    joints = body.joints(
        BodyParameters(betas, parameters.global_orient, parameters.body_pose, parameters.transl)
    )
    for first, second in (
        ("left_hip", "left_knee"),
        ("left_knee", "left_ankle"),
        ("left_elbow", "left_wrist"),
    ):
        length = np.linalg.norm(
            joints[:, SMPL_24.index(first)] - joints[:, SMPL_24.index(second)], axis=-1
        )
        beside_stature = length - np.polyval(np.polyfit(betas[:, 0], length, 1), betas[:, 0])
        assert 0.02 < beside_stature.std() / length.mean() < 0.05


def test_t_pose(body):
    at = joints_by_name(body, zeros())
    keypoints = dict(zip(BODY_25.joints, body.keypoints(zeros())[0], strict=True))
    assert np.linalg.norm(at["pelvis"]) < 2e-3
    for side, sign in (("left", 1), ("right", -1)):
        arm = at[f"{side}_wrist"] - at[f"{side}_shoulder"]
        np.testing.assert_allclose(arm / np.linalg.norm(arm), [sign, 0, 0], atol=0.01)
        leg = at[f"{side}_ankle"] - at[f"{side}_hip"]
        np.testing.assert_allclose(leg / np.linalg.norm(leg), [0, -1, 0], atol=0.01)
        toe = keypoints[f"{side[0].upper()}BigToe"] - keypoints[f"{side[0].upper()}Heel"]
        assert toe[2] > 0.18
    assert keypoints["Nose"][2] > keypoints["REar"][2] + 0.08  # it faces +z
    assert keypoints["LEye"][0] > 0.02


def test_it_is_symmetric(body):
    flip = [1 if n.startswith("left") else -1 if n.startswith("right") else 0 for n in SMPL_24]
    assert sum(flip) == 0
    parameters = zeros(20)
    parameters.betas[:] = np.random.default_rng(0).normal(size=(20, 10))
    keypoints = body.keypoints(parameters)
    mirrored = keypoints[:, list(BODY_25.mirror)] * [-1, 1, 1]
    np.testing.assert_allclose(keypoints, mirrored, atol=1e-4)  # metres; the file has four digits


def test_joints_and_keypoints_lie_within(body):
    triangles = body.vertices(zeros())[0][body.faces]
    assert (winding(body.joints(zeros())[0], triangles) > 0.5).all()
    skin = [
        BODY_25.index(name)
        for name in "Nose REye LEye REar LEar LBigToe LSmallToe RBigToe RSmallToe".split()
    ]
    inside = winding(np.delete(body.keypoints(zeros())[0], skin, axis=0), triangles)
    assert (inside > 0.5).all()
    face = body.keypoints(zeros())[0][skin]
    distance = np.linalg.norm(face[:, None] - body.vertices(zeros())[0], axis=-1).min(1)
    assert distance.max() < 0.02


def test_volume_is_a_persons_and_survives_bending(body):
    rest = volume(body, zeros())  # triangles look outwards, or it would be negative
    assert 0.055 < rest < 0.085  # m^3, about as many tonnes
    sitting = posed(
        left_hip=(-90, 0, 0), right_hip=(-90, 0, 0), left_knee=(90, 0, 0), right_knee=(90, 0, 0),
        left_shoulder=(0, 0, -70), right_shoulder=(0, 0, 70), left_elbow=(0, -90, 0),
        right_elbow=(0, 90, 0),
    )  # fmt: skip
    # Linear blend skinning loses volume in bent joints, here 7.6 %; wrong weights would take half.
    assert 0.9 < volume(body, sitting) / rest < 1.02


def test_turning_a_joint_turns_what_hangs_on_it(body):
    """SMPL's signs: -x at the hip lifts the thigh forwards, -y at the left elbow folds the fore-arm
    forwards.
    """
    at = joints_by_name(body, zeros())
    lifted = joints_by_name(body, posed(left_hip=(-90, 0, 0)))
    thigh = np.linalg.norm(at["left_knee"] - at["left_hip"])
    np.testing.assert_allclose(lifted["left_knee"] - at["left_hip"], [0, 0, thigh], atol=0.01)
    folded = joints_by_name(body, posed(left_elbow=(0, -90, 0)))
    fore_arm = np.linalg.norm(at["left_wrist"] - at["left_elbow"])
    np.testing.assert_allclose(folded["left_wrist"] - at["left_elbow"], [0, 0, fore_arm], atol=0.01)
    for name in ("head", "right_ankle", "right_hand"):
        np.testing.assert_allclose(folded[name], at[name], atol=1e-12)


def test_keypoints_are_the_regressor_on_the_mesh(body, random_parameters):
    parameters = random_parameters(4)
    regressor = body.arrays.keypoint_regressor
    expected = regressor @ body.vertices(parameters)
    np.testing.assert_allclose(body.keypoints(parameters), expected, atol=1e-12)


def test_neck_and_midhip_are_the_middles_that_openpose_learned(body, random_parameters):
    keypoints = body.keypoints(random_parameters(4))
    for middle, part in (("Neck", "Shoulder"), ("MidHip", "Hip")):
        sides = [BODY_25.index(side + part) for side in "RL"]
        np.testing.assert_allclose(
            keypoints[:, BODY_25.index(middle)], keypoints[:, sides].mean(1), atol=1e-6
        )


def test_few_bones_move_a_vertex(body):
    weights = body.arrays.weights
    assert (weights != 0).sum(1).max() <= 7  # six, and a seventh where left and right tie
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    assert body.arrays.pose_blend is None
