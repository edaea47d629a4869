"""SMPL-only, and ours from the same detections."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.body.fitting.energy import robust_cost
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.linearisation import ObservationConfig, triangulate
from shapepose_fg.evaluation.experiments.methods import scored
from shapepose_fg.evaluation.metrics import PlainPeople, joint_metrics
from shapepose_fg.evaluation.smplify import MultiViewSmplify, ViewTargets, smpl_only
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import built_in_scene, simulate

FRAMES = 3


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(frames=FRAMES)


@pytest.fixture(scope="module")
def exact(scene):
    """Everybody in the three frames, seen by all six views without error."""
    joints = scene.keypoints.reshape(-1, 25, 3)
    xy = np.moveaxis(scene.rig.project(joints)[0], 0, 2)
    frame = np.repeat(np.arange(FRAMES), scene.people)
    return Observations(xy, np.ones(xy.shape[:3]), np.full(joints.shape, np.nan), frame=frame), joints


def placed(observations, rig):
    return triangulate(observations, Views.of(rig), ObservationConfig())


def test_bodies_that_are_seen_exactly_are_found(scene, exact):
    """Priors hold against exact detections, and a hundred steps end before the last millimetres."""
    observations, joints = exact
    found, parameters = MultiViewSmplify().fit(observations, scene.rig, placed(observations, scene.rig))
    assert joint_metrics(PlainPeople(observations.frame, found), scene.keypoints).mpjpe_mm < 5
    # The parameters are those of the joints.
    model = MultiViewSmplify().model
    np.testing.assert_allclose(model.keypoints(parameters), found, atol=1e-4)
    assert np.linalg.norm(found - joints, axis=-1).max() < 0.05


def test_a_view_that_saw_somebody_else_s_wrist_does_not_count(scene, exact):
    observations, joints = exact
    wrist, xy = BODY_25.index("RWrist"), observations.xy.copy()
    xy[:, wrist, 0] += 0.4 * scene.rig.focal_px[0] / scene.rig.project(joints[:, wrist])[1][0][:, None]
    wrong = replace(observations, xy=xy)
    start = placed(wrong, scene.rig)
    error = {}
    for name, scale in {"robust": 2.5, "squares": 1e4}.items():
        found, _ = MultiViewSmplify(kernel_scale=scale).fit(wrong, scene.rig, start)
        error[name] = np.linalg.norm(found - joints, axis=-1)[:, wrist].mean()
    assert error["robust"] < 0.01
    assert error["squares"] > 2 * error["robust"]


def test_who_is_hardly_seen_has_no_body(scene, exact):
    observations, _ = exact
    confidence = observations.confidence.copy()
    confidence[0, 2:] = 0.0
    seen = replace(observations, confidence=confidence)
    start = placed(seen, scene.rig)
    found, parameters = MultiViewSmplify().fit(seen, scene.rig, start)
    assert np.isnan(found[0]).all() and np.isnan(parameters.transl[0]).all()
    assert np.isfinite(found[1:]).all()
    nobody, _ = MultiViewSmplify().fit(seen.rows(np.array([0])), scene.rig, start[:1])
    assert np.isnan(nobody).all()


def test_forces_are_the_slope_of_the_energy(scene, exact):
    """Against differences: half the gradient of sum of confidence times Geman-McClure."""
    observations, joints = exact
    rng = np.random.default_rng(0)
    origin = joints[:, BODY_25.root]
    targets = ViewTargets.of(observations, scene.rig, origin, 0.02)
    xyz = joints - origin[:, None] + rng.normal(0, 0.03, joints.shape)
    scale, weight, step = 2.5, 0.3, 1e-6

    def energy(at: np.ndarray) -> np.ndarray:
        """Of each joint: (B, J)."""
        camera = np.einsum("vij,bkj->bkvi", targets.cTw, at) + targets.origin[:, None]
        residual = (camera[..., :2] / camera[..., 2:] - targets.xy) * targets.scale[:, None, :, None]
        return (weight * targets.weight * robust_cost(np.square(residual).sum(-1), scale)).sum(axis=-1)

    _, forces = targets.pull(xyz, scale, weight, None)
    for axis, away in enumerate(step * np.eye(3)):
        slope = (energy(xyz + away) - energy(xyz - away)) / (2 * step)
        np.testing.assert_allclose(forces[..., axis], slope / 2, rtol=1e-5, atol=1e-4)


@pytest.mark.slow
def test_smpl_only_is_of_the_same_people_and_detections(scene):
    """Fitted bodies are nearer to the truth than what the same detections are triangulated to."""
    config = replace(PipelineConfig(), temporal=False)
    people = reconstruct(simulate(scene), scene.rig, config)
    same = smpl_only(people, scene.rig, config.observations)
    assert same.cpu_s > 0
    assert same.people.frame.tolist() == people.frame.tolist()
    before = joint_metrics(PlainPeople(people.frame, same.triangulated), scene.keypoints)
    assert joint_metrics(same.people, scene.keypoints).mpjpe_mm < before.mpjpe_mm
    with pytest.raises(ValueError, match="without observations"):
        smpl_only(replace(people, observations=None), scene.rig, config.observations)


def test_scores_by_hand(scene):
    """One of four people is missing, another 8 cm off: three of four are right at 0.2 m, two at 0.05 m."""
    joints = scene.keypoints[:1, :3].copy()
    joints[0, 0] += [0.08, 0, 0]
    figures = scored(PlainPeople(np.zeros(3, dtype=int), joints[0]), scene.keypoints[:1])
    found = {
        limit: [figures[f"{name}_{limit}"] for name in ("precision", "recall", "f1")] for limit in (0.2, 0.05)
    }
    assert found[0.2] == pytest.approx([100, 75, 600 / 7])
    assert found[0.05] == pytest.approx([200 / 3, 50, 400 / 7])
    assert figures["mpjpe_mm"] == pytest.approx(80 / 3)
    assert (figures["missed"], figures["false_positives"]) == (1, 0)
    assert (figures["precision_hip"], figures["recall_hip"]) == (100, 75)
