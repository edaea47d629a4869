"""The other model of motion, the whole way: by one setting, with covariances that hold."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from factors import MOTIONS, Motion
from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, FitStatus
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.notes import Notebook
from shapepose_fg.core.reconstruction import Status
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.pipeline.config import SolvingConfig
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.pipeline.setup import Setup
from shapepose_fg.simulation import built_in_scene, simulate


class NoFitter(BodyFitter):
    """Nobody has a body."""

    def fit(self, targets, initial=None):
        return BodyFit.failed(np.full(len(targets), FitStatus.TOO_FEW_JOINTS), targets.xyz.shape[1])


@pytest.mark.slow
def test_constant_acceleration_the_whole_way():
    """Two people before four cameras: tracked, solved, bodies linked, as near to the truth as by
    default.
    """
    scene = built_in_scene(people=2, cameras=4, frames=24)
    detections, by_default = simulate(scene), PipelineConfig()
    config = replace(
        by_default, solving=replace(by_default.solving, motion="constant acceleration")
    )
    errors = []
    for each in (by_default, config):
        people = reconstruct(detections, scene.rig, each, times=FrameTimes.from_fps(scene.fps, 24))
        assert len(set(people.person.tolist())) == 2 and len(people) == 48
        apart = np.linalg.norm(people.joints[:, None] - scene.keypoints[people.frame], axis=-1)
        who = np.nanmean(apart, axis=-1).argmin(axis=1)
        true = scene.keypoints[people.frame, who]
        errors.append(np.linalg.norm(people.joints - true, axis=-1).mean())
        speed = np.gradient(scene.keypoints, 1 / scene.fps, axis=0)[people.frame, who]
        for found, covariance, truth in (
            (people.joints, people.covariance, true),
            (people.velocity, people.velocity_covariance, speed),
        ):
            away = (found - truth)[..., None]
            inside = (away.mT @ np.linalg.solve(covariance, away))[..., 0, 0] < 7.815
            # Of two people few errors are independent: 83 to 94 %. With half the covariance 52 to
            # 69 % of joints, with a quarter 50 to 71 % of velocities.
            assert 0.75 < inside.mean() <= 1.0
        assert (people.status == Status.OK).all() and np.isfinite(people.body_pose).all()
    assert errors[1] < 1.1 * errors[0]
    assert errors[1] != errors[0]


def test_the_setting_is_checked():
    with pytest.raises(
        ValueError,
        match="motion must be one of constant velocity, constant acceleration, got straight",
    ):
        SolvingConfig(motion="straight")


def test_other_processes_need_not_know_a_model_of_one_s_own(monkeypatch, five_cameras):
    """What goes to a worker holds the model, whose name is known here alone."""
    mine = Motion(3, (1.0, 4.0))
    monkeypatch.setitem(MOTIONS, "mine", mine)
    config = PipelineConfig(solving=SolvingConfig(motion="mine"))
    content = pickle.dumps(Setup(five_cameras, BODY_25, config, NoFitter()))
    monkeypatch.delitem(MOTIONS, "mine")
    there = pickle.loads(content)
    assert there.estimator.law == there.engine(Notebook()).tracker.scale.motion == mine


def test_densities_are_those_of_equal_uncertainty():
    """After the time that is asked for, white accelerations and the model's own noise leave
    positions alike.
    """
    law = PipelineConfig(solving=SolvingConfig(motion="constant acceleration")).law
    speed = np.array([0.0, 2.0])[:, None]
    own, by_default = MotionModel.load(("RWrist",), law=law), MotionModel.load(("RWrist",))
    for within_s in (0.1, 0.4):
        expected = by_default.law.noise(within_s, by_default.density(speed))[..., 0, 0]
        np.testing.assert_allclose(
            law.noise(within_s, own.density(speed, within_s))[..., 0, 0], expected
        )
