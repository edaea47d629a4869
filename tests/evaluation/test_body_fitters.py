"""The table of bodies over time: recordings posed with our body keep their places, their pace and who they are."""

import numpy as np
import pytest
import torch

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.evaluation.experiments.body_fitters import FPS, acceleration, longest_recordings, recorded_bodies
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.training.split import split_of


def test_recordings_are_of_test_subjects_upright_and_where_they_were(shared_data):
    clips = list(longest_recordings(Mocap.load(shared_data / "cmu_mocap" / "cmu_smpl24.npz")))
    assert len(clips) == 8 and {split_of(clip.subject) for clip in clips} == {"test"}
    assert all(len(clip) <= 10 * FPS and clip.fps == FPS for clip in clips)
    model = BodyModel.default()
    bodies, joints = recorded_bodies(clips[:2], model)
    assert joints.shape == (len(clips[0]) + len(clips[1]), 25, 3)
    own = model.to(torch.float64).joints(bodies).numpy()
    # y up in the recording, z up here: (x, y, z) is (x, -z, y).
    recorded = np.concatenate([clip.pelvis for clip in clips[:2]])
    np.testing.assert_allclose(own[:, 0], recorded[:, [0, 2, 1]] * (1, -1, 1), atol=1e-6)
    head, feet = joints[:, 0, 2], joints[:, 19, 2]
    assert np.median(head - feet) > 1.2


def testacceleration_is_within_a_recording():
    """1 m/s² in one, 3 m/s² in the other; the step between the two is nobody's."""
    t = np.arange(10) / FPS
    one, other = 0.5 * t**2, 100.0 + 1.5 * t**2
    joints = np.concatenate([one, other])[:, None, None] * np.array([1.0, 0.0, 0.0])
    groups = np.arange(2).repeat(10)
    assert acceleration(joints, groups) == pytest.approx(2.0)
