"""A result with everything that exports must cope with: somebody who is out of sight, a hole, a
guessed joint.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.simulation import Scene, built_in_scene
from tests.conftest import read_body

FRAMES, FPS, FIRST = 24, 25.0, 100
AWAY = range(108, 116)
"""Frames in which person 7 is not there."""
BARE = 103
"""A frame in which person 7 has joints, but no body."""
GUESSED = (3, "RWrist")
"""Person 3's wrist in all frames: inferred."""
LOST = (120, 7, "LAnkle")
"""A joint that is not placed."""


@pytest.fixture(scope="session")
def scene() -> Scene:
    return built_in_scene(people=2, frames=FRAMES)


@pytest.fixture(scope="session")
def result(scene: Scene) -> Reconstruction:
    """The truth of the scene as a result: persons 3 and 7, frames 100 to 123."""
    frame, person = (index.ravel() for index in np.indices((FRAMES, 2)))
    motion, N = scene.motion, 2 * FRAMES
    wrist, ankle = BODY_25.index(GUESSED[1]), BODY_25.index(LOST[2])
    rng = np.random.default_rng(0)
    variance = rng.uniform(1e-5, 4e-4, (N, 25, 3))
    joints, covariance = scene.keypoints.reshape(N, 25, 3).copy(), variance[..., None] * np.eye(3)
    known = np.full((N, 25), Known.SEEN)
    known[person == 0, wrist] = Known.BODY
    lost = (frame + FIRST == LOST[0]) & (person == 1)
    joints[lost, ankle], covariance[lost, ankle], known[lost, ankle] = np.nan, np.nan, Known.UNKNOWN
    bare = (frame + FIRST == BARE) & (person == 1)
    orient, pose, transl = (
        value.reshape(N, -1).copy()
        for value in (motion.global_orient, motion.body_pose, motion.transl)
    )
    betas = motion.betas[person]
    for value in (betas, orient, pose, transl):
        value[bare] = np.nan
    people = Reconstruction(
        frame=frame + FIRST,
        person=np.where(person == 0, 3, 7),
        joint_names=np.array(BODY_25.joints),
        joints=joints,
        covariance=covariance,
        confidence=rng.uniform(0.3, 1, (N, 25)),
        betas=betas,
        global_orient=orient,
        body_pose=pose.reshape(N, 23, 3),
        transl=transl,
        status=np.where(bare, "body undetermined", "ok"),
        time_s=(frame + FIRST) / FPS,
        velocity=rng.normal(0, 1, (N, 25, 3)),
        known=known,
        run={
            "frames": [FIRST, FIRST + FRAMES],
            "configuration": {"temporal": True},
            "time": {"fps": FPS},
        },
    )
    people = replace(people, observations=observations(people, scene))
    return people.rows(~((people.person == 7) & np.isin(people.frame, AWAY)))


def observations(people: Reconstruction, scene: Scene) -> ObservationTable:
    """Every joint in every view where it is; one detection in 50 is too far off and was not
    used.
    """
    xy, _ = scene.rig.project(
        np.where(np.isfinite(people.joints), people.joints, scene.rig.centres.mean(axis=0))
    )
    xy = np.moveaxis(xy, 0, 2).astype(np.float32)
    N, J, V = xy.shape[:3]
    gate = np.full((N, J, V), Gate.USED)
    gate[np.random.default_rng(1).uniform(size=gate.shape) < 0.02] = Gate.TOO_FAR
    return ObservationTable(
        people.frame, people.person, people.joint_names, np.array(scene.rig.names),
        np.zeros((N, J, V), int), xy, np.full((N, J, V), 0.7), np.ones((N, J, V, 2)), gate,
    )  # fmt: skip


@pytest.fixture(scope="session")
def saved(result: Reconstruction, scene: Scene, tmp_path_factory) -> Path:
    """The result in a folder, as `reconstruct` leaves it."""
    folder = tmp_path_factory.mktemp("results")
    result.save(folder)
    write_rig(scene.rig, folder / "cameras.json")
    assert json.loads((folder / "run.json").read_text())["frames"] == [FIRST, FIRST + FRAMES]
    return folder


@pytest.fixture(scope="session")
def true_bodies(result: Reconstruction):
    """A function (person, frame) -> joints (24, 3) and vertices (Nv, 3), by the body model."""
    from shapepose_fg.body.model.body_model import BodyModel, BodyParameters

    body = BodyModel.default()

    def pose(person: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        row = result.rows((result.person == person) & (result.frame == frame))
        parts = (row.betas, row.global_orient, row.body_pose, row.transl)
        parameters = BodyParameters(*parts)
        return body.joints(parameters)[0], body.vertices(parameters)[0]

    return pose


@pytest.fixture(scope="session")
def arrays():
    return read_body()
