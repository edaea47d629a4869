"""Three people who walk and wave before four cameras; what may be wrong with these."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Recording
from shapepose_fg.simulation.scene import ring_of_cameras
from tests.setup_check.conftest import seen_by, walkers

FPS = 25.0


def disturbed(rig: Rig, seed: int, degrees: float = 1.0, metres: float = 0.02, focal: float = 0.0) -> Rig:
    """The rig with every camera turned and moved by so much, in a random way, and its focal length off."""
    rng, cameras = np.random.default_rng(seed), []
    for camera in rig.cameras:
        axis, way = rng.normal(size=(2, 3))
        wTc, K = camera.wTc.copy(), camera.K.copy()
        turn = np.radians(degrees) * axis / np.linalg.norm(axis)
        wTc[:3, :3] = wTc[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
        wTc[:3, 3] += metres * way / np.linalg.norm(way)
        K[:2, :2] *= 1 + focal * rng.choice([-1, 1])
        cameras.append(replace(camera, wTc=wTc, K=K))
    return replace(rig, cameras=tuple(cameras))


def off_by(rig: Rig, truth: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Degrees and metres (V,) by which cameras are off, once the rig as a whole is laid on the true one."""
    a, b = rig.centres - rig.centres.mean(axis=0), truth.centres - truth.centres.mean(axis=0)
    near, far = (np.stack([each.wTc[:3, :3] for each in one.cameras]) for one in (rig, truth))
    size = np.linalg.norm(a) * np.linalg.norm(b) / len(rig)
    U, _, Vt = np.linalg.svd(b.T @ a / size + np.einsum("vij,vkj->ik", far, near))
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    turns = [Rotation.from_matrix((R @ one).T @ other).magnitude() for one, other in zip(near, far, strict=True)]
    return np.degrees(turns), np.linalg.norm(a @ R.T - b, axis=1)


@pytest.fixture(scope="session")
def rig() -> Rig:
    return ring_of_cameras(4, np.random.default_rng(3), distance_m=(4.0, 4.6))


@pytest.fixture(scope="session")
def people(two_people) -> np.ndarray:
    """(T, 3, 25, 3), ten seconds of them."""
    return walkers(two_people[0] + np.array([0.45, 0.0, 0.0]), 250)


@pytest.fixture(scope="session")
def recording(rig, people) -> Recording:
    """Seen by a detector whose errors of 2 px do not last."""
    return seen_by(rig, people)
