"""Feet and floor in a whole run: standing feet are still, moving ones as before, no body sinks into
the floor.
"""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.contact import feet_of
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import built_in_scene, simulate

FEET = feet_of(BODY_25.joints)


@pytest.fixture(scope="module")
def without(dance):
    """The shared recording without contact and floor."""
    config = PipelineConfig()
    config = replace(config, motion=replace(config.motion, contact=False, floor=False))
    return reconstruct(dance.recording, dance.scene.rig, config, times=dance.times)


def errors(scene, people):
    """How fast feet are in truth, and by how much their velocities and places are wrong: m/s, m/s,
    m.
    """
    truth = scene.keypoints[people.frame]
    apart = np.linalg.norm(people.joints[:, None] - truth, axis=-1).mean(axis=2)
    who, rows = apart.argmin(axis=1), np.arange(len(people))
    speed = np.gradient(scene.keypoints, 1 / scene.fps, axis=0)[people.frame, who][:, FEET]
    velocity = np.linalg.norm(people.velocity[:, FEET] - speed, axis=-1)
    place = np.linalg.norm(people.joints[:, FEET] - truth[rows, who][:, FEET], axis=-1)
    return np.linalg.norm(speed, axis=-1), velocity, place


@pytest.mark.slow
def test_standing_feet_are_still_and_others_as_before(dance, without):
    scene, people = dance.scene, dance.people
    speed, velocity, place = errors(scene, people)
    before_speed, before, place_before = errors(scene, without)
    standing, moving = speed < 0.02, speed > 0.5
    assert standing.sum() > 300 and moving.sum() > 300
    assert velocity[standing].mean() < 0.5 * before[before_speed < 0.02].mean()
    assert velocity[moving].mean() < 1.05 * before[before_speed > 0.5].mean()
    assert place.mean() < place_before.mean()
    assert without.run["floor"] == {"found": False, "why": "not sought"}


def test_covariances_of_feet_hold(dance):
    scene, people = dance.scene, dance.people
    truth = scene.keypoints[people.frame]
    who = np.linalg.norm(people.joints[:, None] - truth, axis=-1).mean(axis=2).argmin(axis=1)
    apart = (people.joints - truth[np.arange(len(people)), who])[:, FEET]
    squared = np.einsum("nji,njik,njk->nj", apart, np.linalg.inv(people.covariance[:, FEET]), apart)
    # Of a Gaussian 95 % are within 7.81. Eight feet of four people stand twice or so: of 16 that
    # are independent 12 or more are, but once in 1,000; with half the covariance it is 55 to 73 %.
    assert 0.75 < (squared < 7.81).mean() <= 1.0


def test_bodies_stay_above_the_floor(dance):
    people = dance.people
    floor = people.run["floor"]
    assert floor["found"] and floor["share"] > 0.9
    # The scene's floor is at 0; SOLE_M.
    assert abs(floor["height_m"]) < 0.015 and floor["normal"][2] > 0.9999
    ok = people.status == "ok"
    model = BodyModel.default()
    columns = (people.betas, people.global_orient, people.body_pose, people.transl)
    bodies = model.vertices(BodyParameters(*(each[ok] for each in columns)))
    assert (bodies @ floor["normal"]).min() > floor["height_m"] - 0.02


@pytest.mark.slow
def test_frames_alone_have_neither():
    scene = built_in_scene(frames=2)
    people = reconstruct(simulate(scene), scene.rig, replace(PipelineConfig(), temporal=False))
    assert people.run["floor"] == {"found": False, "why": "frame by frame"}
