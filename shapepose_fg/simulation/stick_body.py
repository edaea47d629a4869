"""Stand-in for the open body until it ships: tubes around SMPL's bones, as a file in SMPL's format."""

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from shapepose_fg.body.model import BodyModel

_L = {
    "hip": (0.09, 0.84, 0.0), "knee": (0.10, 0.46, 0.0), "ankle": (0.10, 0.075, -0.02), "foot": (0.11, 0.03, 0.11),
    "collar": (0.08, 1.36, -0.01), "shoulder": (0.18, 1.39, -0.02), "elbow": (0.44, 1.39, -0.03),
    "wrist": (0.69, 1.39, -0.03), "hand": (0.77, 1.39, -0.03),
}  # fmt: skip


def _joints() -> np.ndarray:
    j = np.zeros((24, 3))
    j[[0, 3, 6, 9, 12, 15]] = [
        (0, 0.93, 0),
        (0, 1.04, -0.01),
        (0, 1.17, 0),
        (0, 1.23, 0),
        (0, 1.44, -0.02),
        (0, 1.53, 0.02),
    ]
    for name, at in {"hip": 1, "knee": 4, "ankle": 7, "foot": 10}.items():
        j[at], j[at + 1] = _L[name], np.array(_L[name]) * (-1, 1, 1)
    for name, at in {"collar": 13, "shoulder": 16, "elbow": 18, "wrist": 20, "hand": 22}.items():
        j[at], j[at + 1] = _L[name], np.array(_L[name]) * (-1, 1, 1)
    return j


PARENTS = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21])
_RADIUS = {1: 0.1, 4: 0.075, 7: 0.05, 10: 0.04, 3: 0.13, 6: 0.13, 9: 0.14, 12: 0.1, 15: 0.06, 13: 0.08, 16: 0.06,
           18: 0.045, 20: 0.035, 22: 0.035}  # fmt: skip


def _keypoints(j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r = (-1.0, 1.0, 1.0)
    face = {0: (0, 1.56, 0.11), 16: (0.035, 1.6, 0.09), 18: (0.075, 1.57, 0.0)}
    feet = {19: (0.12, 0.02, 0.19), 20: (0.17, 0.02, 0.15), 21: (0.10, 0.02, -0.07)}
    xyz, bone = np.zeros((25, 3)), np.zeros(25, dtype=int)
    for k, b in {2: 17, 3: 19, 4: 21, 5: 16, 6: 18, 7: 20, 9: 2, 10: 5, 11: 8, 12: 1, 13: 4, 14: 7}.items():
        xyz[k], bone[k] = j[b], b
    xyz[1], bone[1] = (j[16] + j[17]) / 2, 9
    xyz[8], bone[8] = (j[1] + j[2]) / 2, 0
    for k, at in face.items():
        xyz[k], bone[k] = at, 15
    for k, at in ((15, 16), (17, 18)):
        xyz[k], bone[k] = xyz[at] * r, 15
    for k, at in feet.items():
        xyz[k], bone[k] = at, 7
        xyz[k + 3], bone[k + 3] = np.array(at) * r, 8
    return xyz, bone


def _tube(a, b, radius, n=10, rings=6):
    axis = (b - a) / np.linalg.norm(b - a)
    side = np.cross(axis, (0.3, 0.2, 0.9))
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    phi = np.arange(n) * 2 * np.pi / n
    circle = np.cos(phi)[:, None] * side + np.sin(phi)[:, None] * other
    verts, radial = [], []
    for s in np.linspace(0, 1, rings):
        verts.append(a + s * (b - a) + radius * circle)
        radial.append(circle)
    verts += [a[None] - axis * radius * 0.6, b[None] + axis * radius * 0.6]
    radial += [-axis[None], axis[None]]
    i = np.arange(n)
    k = (i + 1) % n
    faces = []
    for q in range(rings - 1):
        faces += [
            np.stack([q * n + i, q * n + k, (q + 1) * n + k], 1),
            np.stack([q * n + i, (q + 1) * n + k, (q + 1) * n + i], 1),
        ]
    m = rings * n
    faces += [np.stack([np.full(n, m), k, i], 1), np.stack([np.full(n, m + 1), m - n + i, m - n + k], 1)]
    return np.concatenate(verts), np.concatenate(radial), np.concatenate(faces)


def write_stick_body(path: Path) -> None:
    """Write the stand-in in SMPL's format."""
    j = _joints()
    kp, kp_bone = _keypoints(j)
    verts, radial, faces, bone = [j, kp], [np.zeros((49, 3))], [], [np.arange(24), kp_bone]
    count = 49
    pieces = [(j[p], j[c], _RADIUS.get(c, _RADIUS.get(c - 1, 0.05)), p) for c, p in enumerate(PARENTS) if p >= 0]
    pieces += [(np.array([0, 1.5, 0.02]), np.array([0, 1.64, 0.02]), 0.09, 15)]
    pieces += [(j[16], j[17], 0.08, 9), (j[1], j[2], 0.1, 0)]
    for a, b, radius, p in pieces:
        v, r, f = _tube(a, b, radius)
        verts.append(v)
        radial.append(r)
        faces.append(f + count)
        bone.append(np.full(len(v), p))
        count += len(v)
    v, r, f, b = np.concatenate(verts), np.concatenate(radial), np.concatenate(faces), np.concatenate(bone)
    shapes = np.zeros((len(v), 3, 10))
    shapes[..., 0], shapes[..., 1] = 0.035 * v, 0.01 * r
    weights = np.eye(24)[b]
    np.savez(
        path, v_template=v, shapedirs=shapes, posedirs=np.zeros((len(v), 3, 207)), J_regressor=np.eye(24, len(v)),
        weights=weights,
        kintree_table=np.stack([PARENTS.astype(np.uint32), np.arange(24, dtype=np.uint32)]),
        f=f.astype(np.uint32),
        keypoint_regressor=np.eye(len(v))[24:49],
    )  # fmt: skip


@cache
def stick_body() -> BodyModel:
    """The stand-in, loaded."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stick.npz"
        write_stick_body(path)
        return BodyModel.load(path)
