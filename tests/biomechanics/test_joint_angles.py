from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.biomechanics.joint_angles import (
    DEFINITIONS,
    NAMES,
    OPENSIM,
    angles_and_slopes,
    joint_angles,
    segment_axes,
)
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Known
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.simulation import built_in_scene
from shapepose_fg.simulation.files import truth_of

MODEL = BodyModel.default()


def posed(joint=None, axis=None, degrees=0.0, *, more=()):
    """The T-pose with rotations, about axes of the body model (x left, y up, z forward)."""
    pose = np.zeros((1, 24, 3))
    for name, about, angle in ((joint, axis, degrees), *more):
        if name is not None:
            pose[0, SMPL_24.index(name)] = np.radians(angle) * np.array(about, dtype=float)
    return BodyParameters(np.zeros((1, 10)), pose[:, 0], pose[:, 1:], np.zeros((1, 3)))


def angles(body, definitions=DEFINITIONS, world=None):
    axes = segment_axes(MODEL, body.betas)
    degrees, _ = angles_and_slopes(body.local, axes, np.eye(3) if world is None else world,
                                   definitions)  # fmt: skip
    names = NAMES if definitions is DEFINITIONS else range(degrees.shape[1])
    return dict(zip(names, degrees[0].tolist(), strict=True))


LEFT, UP, FORWARD = (1, 0, 0), (0, 1, 0), (0, 0, 1)
MOVEMENTS = {
    # The distal segment moves: forward with a negative rotation about the left, and so on.
    "hip_flexion": [("hip", LEFT, LEFT, -30)],
    "hip_adduction": [("hip", (0, 0, 1), (0, 0, -1), 20)],
    "hip_rotation": [("hip", (0, 1, 0), (0, -1, 0), 25)],
    "knee_flexion": [("knee", LEFT, LEFT, 60)],
    "ankle_flexion": [("ankle", LEFT, LEFT, -15)],
    "ankle_inversion": [("ankle", (0, 0, 1), (0, 0, -1), 10)],
}


@pytest.mark.parametrize("name", MOVEMENTS)
def test_a_movement_changes_its_own_angle_equally_on_both_sides(name):
    """Flexion forward (of the knee backward), adduction, internal rotation, inversion: positive."""
    ((joint, right, left, degrees),) = MOVEMENTS[name]
    for side, axis in (("right", right), ("left", left)):
        moved, still = angles(posed(f"{side}_{joint}", axis, degrees)), angles(posed())
        change = {key: moved[key] - still[key] for key in NAMES}
        own = f"{side}_{name}"
        assert change[own] == pytest.approx(abs(degrees), abs=1.5)
        others = [value for key, value in change.items() if not key.startswith(f"{side}_{joint}")]
        assert np.abs(others).max() < 1e-6


def test_arms():
    """Hanging arms have elevation 0, raised to the side 90; forward is the plane of 90 degrees."""
    for side, sign in (("right", 1), ("left", -1)):
        hanging = posed(f"{side}_shoulder", FORWARD, 90 * sign)
        assert angles(posed())[f"{side}_shoulder_elevation"] == pytest.approx(90, abs=10)
        assert angles(posed())[f"{side}_shoulder_plane"] == pytest.approx(0, abs=10)
        assert angles(hanging)[f"{side}_shoulder_elevation"] < 15
        forward = angles(posed(f"{side}_shoulder", UP, 90 * sign))
        assert forward[f"{side}_shoulder_plane"] == pytest.approx(90, abs=10)
        assert forward[f"{side}_shoulder_elevation"] == pytest.approx(90, abs=15)
        bent = angles(posed(f"{side}_elbow", UP, 70 * sign))
        straight = angles(posed())[f"{side}_elbow_flexion"]
        assert bent[f"{side}_elbow_flexion"] - straight == pytest.approx(70, abs=3)


def test_trunk_and_pelvis():
    bent = angles(posed("spine1", LEFT, 10, more=(("spine2", LEFT, 15), ("spine3", LEFT, 5))))
    assert bent["trunk_flexion"] == pytest.approx(30, abs=1e-6)
    assert angles(posed("spine2", FORWARD, 12))["trunk_bending"] == pytest.approx(12, abs=1e-6)
    assert angles(posed("spine2", UP, 12))["trunk_rotation"] == pytest.approx(12, abs=1e-6)
    tilted = angles(posed("pelvis", LEFT, 8))
    assert tilted["pelvis_tilt"] == pytest.approx(8, abs=1e-6)  # to the front
    assert tilted["trunk_flexion"] == pytest.approx(0, abs=1e-6)
    # The right hip is higher if the body turns about the forward axis from right to up to left.
    assert angles(posed("pelvis", FORWARD, -8))["pelvis_obliquity"] == pytest.approx(8, abs=1e-6)


def test_angles_are_those_of_scipy_s_sequences():
    rng = np.random.default_rng(0)
    body = posed(more=[(name, rng.normal(size=3), 20) for name in SMPL_24])
    axes = segment_axes(MODEL, body.betas)
    local = dict(zip(SMPL_24, body.local[0], strict=True))
    turn = axes["right_hip"][0].T @ local["right_knee"] @ axes["right_knee"][0]
    z, x, y = Rotation.from_matrix(turn).as_euler("ZXY", degrees=True)
    ours = angles(body)
    names = ("flexion", "adduction", "rotation")
    assert [ours[f"right_knee_{name}"] for name in names] == pytest.approx([-z, x, y], abs=1e-9)
    world = Rotation.random(random_state=1).as_matrix()
    turn = world @ local["pelvis"] @ axes["pelvis"][0]
    y, x, z = Rotation.from_matrix(turn).as_euler("YXZ", degrees=True)
    ours = angles(body, world=world)
    names = ("rotation", "obliquity", "tilt")
    assert [ours[f"pelvis_{name}"] for name in names] == pytest.approx([y, -x, -z], abs=1e-9)
    turn = axes["spine3"][0].T @ local["right_collar"] @ local["right_shoulder"]
    turn = turn @ axes["right_shoulder"][0]
    _, x, _ = Rotation.from_matrix(turn).as_euler("YXY", degrees=True)
    names = ("plane", "elevation", "rotation")
    again = Rotation.from_euler(
        "YXY", np.multiply([ours[f"right_shoulder_{name}"] for name in names], [1, -1, 1]),
        degrees=True)  # fmt: skip
    assert (again.inv() * Rotation.from_matrix(turn)).magnitude() < 1e-9
    assert ours["right_shoulder_elevation"] == pytest.approx(abs(x), abs=1e-9)


@pytest.mark.parametrize("definitions", [DEFINITIONS, OPENSIM])
def test_slopes_are_derivatives(definitions):
    rng = np.random.default_rng(2)
    body = posed(more=[(name, rng.normal(size=3), 25) for name in SMPL_24])
    axes = segment_axes(MODEL, body.betas)
    before, slopes = angles_and_slopes(body.local, axes, np.eye(3), definitions)
    step = 1e-6 * rng.normal(size=(24, 3))
    moved = body.local @ Rotation.from_rotvec(step).as_matrix()
    after, _ = angles_and_slopes(moved, axes, np.eye(3), definitions)
    np.testing.assert_allclose(after - before, slopes @ step.ravel(), atol=1e-7)


@pytest.fixture(scope="module")
def people():
    """The true people of the built-in scene, seen with 1 cm per axis."""
    truth = truth_of(built_in_scene().part(range(0, 60, 6)))
    covariance = np.broadcast_to(0.01**2 * np.eye(3), (*truth.joints.shape, 3))
    known = np.full(truth.joints.shape[:2], Known.SEEN, dtype=np.uint8)
    return replace(truth, covariance=covariance, known=known)


def test_sigmas_follow_the_measurements(people):
    """Twice as noisy joints, joints that no view saw, and an arm that is almost straight."""
    found = joint_angles(people, "z")
    knee, axial = (NAMES.index(f"right_{name}") for name in ("knee_flexion", "shoulder_rotation"))
    noisy = joint_angles(replace(people, covariance=4 * people.covariance), "z")
    ratio = (noisy.sigma / found.sigma)[:, knee]
    assert (ratio > 1.5).all() and (ratio < 2.001).all()
    hidden = people.known.copy()
    hidden[:, [people.joint_names.tolist().index(name) for name in ("RAnkle", "RHeel",
               "RBigToe", "RSmallToe")]] = Known.BODY  # fmt: skip
    unseen = joint_angles(replace(people, known=hidden), "z").sigma[:, knee]
    assert (unseen > 2.5 * found.sigma[:, knee]).all()
    flexion = NAMES.index("right_elbow_flexion")
    pose = np.array(people.body_pose)
    axial_sigma = []
    for degrees in (0, 80):
        pose[:, SMPL_24.index("right_elbow") - 1] = np.radians(degrees) * np.array(UP)
        moved = BodyParameters(people.betas, people.global_orient, pose, people.transl)
        made = replace(people, body_pose=pose, joints=MODEL.keypoints(moved))
        sigma = joint_angles(made, "z").sigma
        axial_sigma.append(np.median(sigma[:, axial]))
        assert np.median(sigma[:, flexion]) < 8.5
    # The axial rotation of a straight arm is not determined: its sigma is that of the prior.
    assert axial_sigma[0] > 18 and axial_sigma[0] > 1.5 * axial_sigma[1]


def test_rows_without_a_body_are_unknown(people):
    betas = people.betas.copy()
    betas[3] = np.nan
    found = joint_angles(replace(people, betas=betas, status=np.where(
        np.arange(len(people)) == 3, "body undetermined", people.status)), "z")  # fmt: skip
    assert np.isnan(found.degrees[3]).all() and np.isnan(found.sigma[3]).all()
    assert np.isfinite(np.delete(found.sigma, 3, 0)).all()
    unknown = np.full(people.known.shape, Known.UNKNOWN, dtype=np.uint8)
    assert np.isnan(joint_angles(replace(people, known=unknown), "z").sigma).all()
    exact = replace(people, covariance=np.zeros_like(people.covariance))
    assert np.isnan(joint_angles(exact, "z").sigma).all()  # no measurement without a covariance
    with pytest.raises(InputError, match="up="):
        joint_angles(people)


def test_frames_of_pandas(people):
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    table = joint_angles(people, "z").to_frame()
    assert isinstance(table, pandas.DataFrame) and len(table) == len(people)
    assert {"frame", "person", "left_knee_flexion_deg", "trunk_bending_sigma_deg"} <= set(table)
    joints = people.to_frame()
    assert len(joints) == people.joints.shape[0] * people.joints.shape[1]
    knee = joints[(joints.joint == "RKnee") & (joints.person == 2)]
    rows = people.person == 2
    np.testing.assert_allclose(knee[["x_m", "y_m", "z_m"]], people.joints[rows, 10])
    assert knee["known"].eq("seen").all() and knee["sigma_m"].round(9).eq(0.01).all()


def test_a_missing_library_is_one_sentence(people):
    with pytest.raises(InputError, match=r"\[frames\]"):
        people.to_frame("no_such_library")
