"""Three cameras around a point, made from numbers alone: what the projection tests share."""

from dataclasses import dataclass

import gtsam
import numpy as np
import pytest

from factors import make_camera


@dataclass(frozen=True)
class Scene:
    K: np.ndarray  # (V, 3, 3) px
    wTc: np.ndarray  # (V, 4, 4) m
    points: np.ndarray  # (J, 3) m

    @property
    def cameras(self):
        return [make_camera(K, wTc) for K, wTc in zip(self.K, self.wTc, strict=True)]

    @property
    def cTw(self):
        return np.linalg.inv(self.wTc)[:, :3]

    def project(self, view, point):
        """Pixels by the pinhole formula written out, not by the code under test."""
        x, y, z = self.cTw[view] @ [*point, 1.0]
        K = self.K[view]
        return np.array([K[0, 0] * x / z + K[0, 1] * y / z + K[0, 2], K[1, 1] * y / z + K[1, 2]])

    def values(self, keys):
        values = gtsam.Values()
        for key, point in zip(keys, self.points, strict=True):
            values.insert(int(key), point)
        return values


def look_at(eye, target):
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    wTc = np.eye(4)
    wTc[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    wTc[:3, 3] = eye
    return wTc


@pytest.fixture
def scene():
    rng = np.random.default_rng(0)
    eyes = np.array([[4.0, 0, 1.5], [-1, 3.5, 2.0], [-2, -3, 1.0]])
    K = np.array([[[900.0 + 40 * v, 3.0, 510], [0, 880, 390], [0, 0, 1]] for v in range(3)])
    points = np.array([0.0, 0, 1]) + rng.normal(scale=0.4, size=(4, 3))
    return Scene(K, np.stack([look_at(eye, np.array([0, 0, 1.0])) for eye in eyes]), points)
