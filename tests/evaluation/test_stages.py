"""What stage II makes of stage I."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.gated_views import triangulate
from shapepose_fg.evaluation.metrics import PlainPeople, match_people
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people, reconstruct
from shapepose_fg.simulation import DetectorConfig, built_in_scene, simulate


@pytest.mark.slow
def test_stage_two_helps_whom_the_views_see_badly():
    """What the project promises; misses are frequent here, so that few frames hold enough doubtful
    joints.
    """
    scene = built_in_scene(1000, frames=10)
    detections = simulate(scene, DetectorConfig(misses=3.0), seed=1000)
    config = replace(PipelineConfig(), temporal=False)
    found = [find_people(seen, scene.rig, detections.skeleton, config) for seen in detections]
    frame = np.repeat(np.arange(len(found)), [len(people) for people in found])
    placed = triangulate(Observations.concatenate(found), Views.of(scene.rig), config.observations)
    before, after = PlainPeople(frame, placed), reconstruct(detections, scene.rig, config)
    error = np.full((2, *scene.keypoints.shape[:3]), np.nan)
    confidence = np.zeros(error.shape[1:])
    for table, people in zip(error, (before, after), strict=True):
        match = match_people(people.frame, people.joints, scene.keypoints)
        at = (match.frame, match.person)
        table[at] = np.linalg.norm(people.joints[match.row] - scene.keypoints[at], axis=-1)
    confidence[at] = after.confidence[match.row]  # the mean over views
    both = np.isfinite(error).all(axis=0)
    well, badly = error[:, both & (confidence >= 0.25)], error[:, both & (confidence < 0.25)]
    assert badly.shape[1] >= 20
    assert badly[1].mean() < 0.8 * badly[0].mean()
    assert well[1].mean() < well[0].mean()
