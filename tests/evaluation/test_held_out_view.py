from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.estimation.linearisation import ObservationConfig
from shapepose_fg.evaluation.held_out_view import (
    INSIDE_95,
    compare_view,
    held_out,
    squared_distances,
    without_view,
)
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import built_in_scene, simulate

CONFIG = ObservationConfig()


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=2, frames=4, cameras=4)


@pytest.fixture(scope="module")
def recording(scene):
    return simulate(scene)


@pytest.fixture(scope="module")
def people(scene, recording):
    return reconstruct(recording, scene.rig)


def test_a_recording_without_a_view(recording):
    without = without_view(recording, 1)
    assert len(without) == 4
    whole, part = recording[2], without[2]
    assert len(part) == (whole.view != 1).sum()
    assert set(part.view.tolist()) == {0, 1, 2}
    # What was view 3 is view 2 now, with the same detections.
    np.testing.assert_array_equal(part.xy[part.view == 2], whole.xy[whole.view == 3])
    assert len(part.pairs) == len(part.affinity)
    assert part.pairs.max() < len(part)


def test_true_covariances_hold_95_percent(scene):
    """Joints scattered by C, detections by the graph's own sigma: 20,000 draws, so one sigma is
    0.15 %.
    """
    rng = np.random.default_rng(0)
    camera, count = scene.rig.cameras[0], 20000
    point = scene.keypoints[0, 0, 8]
    root = np.linalg.cholesky(np.diag([0.02, 0.03, 0.015]) ** 2 + 1e-4)
    points = point + rng.normal(size=(count, 3)) @ root.T
    true, depth = camera.project(np.broadcast_to(point, (count, 3)))
    confidence = np.full(count, 0.8)
    scatter = np.full(count, 1.3)
    weight = (0.8**CONFIG.confidence_power + CONFIG.least_weight) / (1 + CONFIG.least_weight)
    sigma = (
        1.3
        * camera.K[0, 0]
        * np.hypot(CONFIG.sigma_m / depth[0], CONFIG.floor_rad)
        / np.sqrt(weight)
    )
    xy = true + rng.normal(size=(count, 2)) * sigma
    covariance = np.broadcast_to(root @ root.T, (count, 3, 3))
    squared = squared_distances(camera, xy, confidence, points, covariance, scatter, CONFIG)
    assert squared.mean() == pytest.approx(
        2.0, abs=0.06
    )  # linear to a per cent at 2 % of the depth
    assert (squared <= INSIDE_95).mean() == pytest.approx(0.95, abs=0.006)


def test_behind_the_camera_there_is_no_distance(scene):
    camera = scene.rig.cameras[0]
    behind = camera.centre - camera.wTc[:3, 2]
    assert np.isnan(
        squared_distances(
            camera,
            np.zeros((1, 2)),
            np.ones(1),
            behind[None],
            1e-4 * np.eye(3)[None],
            np.ones(1),
            CONFIG,
        )
    )


def test_the_same_people_have_their_own_detections_inside(scene, people):
    """What was used lies near the projected joint: most are inside. A joint 30 cm off has all
    outside.
    """
    camera = scene.rig.cameras[0]
    same = compare_view(camera, 0, people, people, CONFIG)
    assert same.inside > 0.9
    assert same.unmatched == 0
    moved = replace(people, joints=people.joints + 0.3 * (np.arange(25) == 4)[:, None])
    away = compare_view(camera, 0, people, moved, CONFIG)
    wrists = people.observations.used[:, 4, 0].sum()
    assert len(same.squared) == len(away.squared)
    assert (away.squared > INSIDE_95).sum() >= 0.9 * wrists


def test_detections_that_nobody_else_confirms_are_counted(scene, people):
    camera = scene.rig.cameras[0]
    alone = compare_view(camera, 0, people, people.rows(people.frame < 2), CONFIG)
    whole = compare_view(camera, 0, people, people, CONFIG)
    assert 0 < alone.unmatched < len(whole.squared)
    assert alone.unmatched + len(alone.squared) == len(whole.squared)


@pytest.mark.slow
def test_what_a_camera_saw_lies_where_the_others_say(scene, recording, people):
    found = held_out(recording, scene.rig, 1, people, reconstruct, CONFIG)
    assert len(found.squared) > 10
    assert 0.7 < found.inside <= 1.0
    with pytest.raises(ValueError, match="no observations"):
        held_out(recording, scene.rig, 1, replace(people, observations=None), reconstruct, CONFIG)
