from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.single_person import (
    ARM_UP,
    BYSTANDER_M,
    bystander_seen,
    man_of,
    measure_single_person,
    residual_to_nearest,
)
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import built_in_scene
from shapepose_fg.simulation.files import truth_of

RWRIST, RSHOULDER = BODY_25.index("RWrist"), BODY_25.index("RShoulder")


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=1, frames=40, cameras=4)


@pytest.fixture
def truth(scene):
    """One man, moved on the floor into the middle of the cameras."""
    people = truth_of(scene)
    middle = scene.rig.centres.mean(axis=0) * [1, 1, 0]
    return replace(people, joints=people.joints - people.joints.mean(axis=1, keepdims=True) * [1, 1, 0] + middle)


def seen(rig, people):
    """Every joint of every row in every view, exactly."""
    frames = []
    for frame in range(40):
        xy, _ = rig.project(people.joints[people.frame == frame])
        view, _, joint = (index.ravel() for index in np.indices(xy.shape[:3]))
        none = np.zeros((0, 2), dtype=np.intp)
        frames.append(Detections(view, joint, xy.reshape(-1, 2), np.full(len(view), 0.8), none, np.zeros(0)))
    return Recording(BODY_25, frames)


def test_a_perfect_man(scene, truth):
    found = measure_single_person(truth, seen(scene.rig, truth), scene.rig, fps=scene.fps)
    assert (found["frames"], found["man_found"], found["torn_limbs"]) == (40, 40, 0)
    assert found["residual_px"] == pytest.approx(0.0, abs=1e-6)
    assert found["forearm_spread"] < 5  # per cent: bones keep their length, the skin over them moves
    height = truth.joints[ARM_UP.start : ARM_UP.stop, [RSHOULDER, RWRIST], 2]
    assert found["lowest_wrist_m"] == pytest.approx((height[:, 0] - height[:, 1]).max())
    assert (found["bystander_seen"], found["bystander_found"]) == (0, 0)


def test_a_forearm_torn_in_two_frames(scene, truth):
    joints = truth.joints.copy()
    joints[[5, 20], RWRIST] += 2.0 * (joints[[5, 20], RWRIST] - joints[[5, 20], BODY_25.index("RElbow")])
    torn = measure_single_person(replace(truth, joints=joints), seen(scene.rig, truth), scene.rig, fps=scene.fps)
    whole = measure_single_person(truth, seen(scene.rig, truth), scene.rig, fps=scene.fps)
    assert torn["torn_limbs"] == 2
    assert torn["forearm_spread"] > whole["forearm_spread"] + 10
    assert torn["wrist_acceleration"] > whole["wrist_acceleration"] + 10
    assert torn["largest_acceleration"] > torn["wrist_acceleration"]


def test_the_residual_is_that_of_the_nearest_detection(scene, truth):
    """All of it 3 cm to the side: pixels as focal length and distance make of them."""
    moved = replace(truth, joints=truth.joints + np.array([0.0, 0.0, 0.03]))
    xy, _ = scene.rig.project(truth.joints)
    up, _ = scene.rig.project(moved.joints)
    arms = [4, 7, 3, 6]
    expected = np.median(np.linalg.norm(up - xy, axis=-1)[:, :, arms])
    assert residual_to_nearest(moved, seen(scene.rig, truth), scene.rig) == pytest.approx(expected, rel=1e-6)


def test_the_man_is_in_the_middle_and_missing_frames_are_missing(scene, truth):
    far = replace(truth, joints=truth.joints + np.array([4.0, 0, 0]))
    both = type(truth).concatenate([far, truth.rows(truth.frame != 7)])
    assert len(man_of(both, scene.rig)) == 39
    assert measure_single_person(both, seen(scene.rig, truth), scene.rig)["man_found"] == 39
    nobody = measure_single_person(truth.rows(truth.frame < 0), seen(scene.rig, truth), scene.rig)
    assert nobody["man_found"] == 0
    assert nobody["forearm_spread"] is None


def test_the_bystander(scene, truth):
    """A second person where the bystander stands, seen in all frames, reconstructed in ten."""
    at = np.array([*BYSTANDER_M, 0.0])
    other = replace(truth, joints=truth.joints - truth.joints.mean(axis=1, keepdims=True) * [1, 1, 0] + at)
    other = replace(other, person=other.person + 1)
    both = type(truth).concatenate([truth, other])
    recording = seen(scene.rig, both)
    assert bystander_seen(recording, scene.rig).sum() == pytest.approx(40, abs=4)  # where the rays meet well
    found = measure_single_person(
        type(truth).concatenate([truth, other.rows(other.frame < 10)]), recording, scene.rig
    )
    assert found["man_found"] == 40
    seen_in = bystander_seen(recording, scene.rig)
    assert found["bystander_found"] == pytest.approx(100 * seen_in[:10].sum() / seen_in.sum())


def test_the_recording(shared_data):
    """Ten of its frames: there is a man, and two views have the bystander."""
    folder = shared_data / "pose2sim_single"
    if not folder.is_dir():
        pytest.skip("no pose2sim_single among the recordings")
    rig = read_rig(folder / "rig.json")
    recording = read_detections(folder / "openpose", rig)
    some = Recording(recording.skeleton, [recording[t] for t in range(10)])
    found = measure_single_person(reconstruct(some, rig, PipelineConfig()), some, rig)
    assert found["man_found"] >= 9
    assert found["bystander_seen"] == 10
