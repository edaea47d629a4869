"""What stage II makes of stage I."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.evaluation.experiments.methods import initial_proposals
from shapepose_fg.evaluation.metrics import match_people
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import DetectorConfig, built_in_scene, simulate


@pytest.mark.slow
def test_stage_two_helps_whom_the_views_see_badly():
    """What the project promises; misses are frequent here, so that few frames hold enough doubtful joints."""
    scene = built_in_scene(1000, frames=10)
    detections = simulate(scene, DetectorConfig(misses=3.0), seed=1000)
    config = replace(PipelineConfig(), temporal=False)
    before, after = initial_proposals(detections, scene.rig, config), reconstruct(detections, scene.rig, config)
    error = np.full((2, *scene.keypoints.shape[:3]), np.nan)
    confidence = np.zeros(error.shape[1:])
    for table, people in zip(error, (before, after), strict=True):
        found = match_people(people.frame, people.joints, scene.keypoints)
        at = (found.frame, found.person)
        table[at] = np.linalg.norm(people.joints[found.row] - scene.keypoints[at], axis=-1)
    confidence[at] = after.confidence[found.row]  # the mean over views
    both = np.isfinite(error).all(axis=0)
    well, badly = error[:, both & (confidence >= 0.25)], error[:, both & (confidence < 0.25)]
    assert badly.shape[1] >= 20
    assert badly[1].mean() < 0.8 * badly[0].mean()
    assert well[1].mean() < well[0].mean()
