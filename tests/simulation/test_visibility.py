"""Visibility: against rays cast through the whole mesh, and where it is known who hides whom."""

import numpy as np
import pytest
from numpy.typing import NDArray

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.drawing import thinned
from shapepose_fg.core.rendering import look_at
from shapepose_fg.core.skeleton import BODY_25, SMPL_24
from shapepose_fg.simulation import Scene, built_in_scene
from shapepose_fg.simulation.visibility import (
    BORDER,
    ITSELF,
    NOBODY,
    OccludingSurface,
    Visibility,
    VisibilityConfig,
    see,
)

X, Y, Z = np.eye(3)
K = np.array([[900.0, 0, 640], [0, 900.0, 360], [0, 0, 1]])
FACE = [BODY_25.index(name) for name in ("Nose", "REye", "LEye", "REar", "LEar")]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return built_in_scene(seed=0, frames=6)


def rig_of(*views: tuple[NDArray, NDArray]) -> Rig:
    cameras = (
        Camera(f"c{i}", K, look_at(eye, target, Z), (1280, 720))
        for i, (eye, target) in enumerate(views)
    )
    return Rig(tuple(cameras), up="z")


def look(
    rig: Rig, joints: NDArray, meshes: NDArray, scene: Scene, config: VisibilityConfig
) -> Visibility:
    skin = OccludingSurface.of(scene.body, config.cell_m)
    return see(rig, joints, meshes[:, skin.vertices], skin, config)


def standing(scene: Scene) -> tuple[NDArray, NDArray]:
    """Joints (25, 3) and mesh (Nv, 3) of the mean body in its T-pose: z up, facing -y, left is
    +x.
    """
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return (
        scene.body.arrays.keypoint_regressor @ scene.body.arrays.template @ turn,
        scene.body.arrays.template @ turn,
    )


def first_met(origin: NDArray, target: NDArray, mesh: NDArray, faces: NDArray) -> tuple[float, int]:
    """Share of the way from `origin` to `target` at which a face turned to the ray is met first,
    and that face.

    Moeller and Trumbore 1997; inf and -1 where none is.
    """
    a, b, c = mesh[faces[:, 0]], mesh[faces[:, 1]], mesh[faces[:, 2]]
    ray = target - origin
    p = np.cross(ray, c - a)
    determinant = ((b - a) * p).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((origin - a) * p).sum(axis=1) / determinant
        q = np.cross(origin - a, b - a)
        v = (q @ ray) / determinant
        share = ((c - a) * q).sum(axis=1) / determinant
    hit = (determinant > 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (share > 0)
    face = int(np.where(hit, share, np.inf).argmin())
    return (float(share[face]), face) if hit[face] else (np.inf, -1)


def bones_near(scene: Scene, own: str) -> NDArray:
    """The columns of the bones `own`, their parents and their children."""
    bones = {SMPL_24.index(name) for name in own.split()}
    tree = [(bone, parent) for bone, parent in enumerate(scene.body.parents) if parent >= 0]
    near = bones | {p for b, p in tree if b in bones} | {b for b, p in tree if p in bones}
    return np.array(sorted(near))


@pytest.mark.slow
def test_it_decides_as_rays_through_the_whole_mesh_do(scene: Scene):
    """The rule, worked out anew for joints that lie inside limbs: whose skin does a ray meet
    first.
    """
    owns = {"RElbow": "right_elbow", "LWrist": "left_wrist", "MidHip": "pelvis", "LHip": "left_hip"}
    owns |= {"RKnee": "right_knee", "LAnkle": "left_ankle", "Neck": "neck left_collar right_collar"}
    frame, faces = 3, scene.body.faces
    meshes, joints = scene.vertices_at(frame).astype(np.float64), scene.truth_at(frame)
    flat = (faces[None] + np.arange(4)[:, None, None] * meshes.shape[1]).reshape(-1, 3)
    weights = scene.body.arrays.weights[faces].mean(axis=1)
    exact = look(
        scene.rig, joints, meshes, scene, VisibilityConfig(image_scale=1.0, cell_m=0.0, probe_m=0.0)
    )
    quick = look(scene.rig, joints, meshes, scene, VisibilityConfig())
    wrong_exact, wrong_quick, seen = [], [], []
    for view in (0, 3):
        for person in range(4):
            for name, own in owns.items():
                joint = BODY_25.index(name)
                centre, target = scene.rig.cameras[view].centre, joints[person, joint]
                share, face = first_met(centre, target, meshes.reshape(-1, 3), flat)
                hidden_by = NOBODY
                if (1 - share) * np.linalg.norm(target - centre) > 0.02:
                    whose = face // len(faces)
                    shown = weights[face % len(faces), bones_near(scene, own)].sum() >= 0.5
                    hidden_by = (NOBODY if shown else ITSELF) if whose == person else whose
                if not exact.in_image[view, person, joint]:
                    hidden_by = BORDER
                seen.append(hidden_by == NOBODY)
                wrong_exact.append(exact.hidden_by[view, person, joint] != hidden_by)
                wrong_quick.append(quick.hidden_by[view, person, joint] != hidden_by)
    assert 0.4 < np.mean(seen) < 0.9
    # What is left: rays through a pixel's centre instead of the joint, and skin that is half one
    # bone's.
    assert np.mean(wrong_exact) <= 0.04
    assert np.mean(wrong_quick) <= 0.08


@pytest.mark.slow
def test_the_coarse_surface_decides_as_the_full_one_does(scene: Scene):
    differs, share = [], []
    for frame in (0, 2, 5):
        meshes, joints = scene.vertices_at(frame), scene.truth_at(frame)
        quick = look(scene.rig, joints, meshes, scene, VisibilityConfig())
        full = look(scene.rig, joints, meshes, scene, VisibilityConfig(image_scale=1.0, cell_m=0.0))
        differs.append(quick.hidden_by != full.hidden_by)
        share.append(np.abs(quick.seen - full.seen).mean())
    # 2.5 % over 20 frames of two scenes; 1,800 joints here, of which most stay as they were from
    # frame to frame.
    assert np.mean(differs) < 0.04
    assert np.mean(share) < 0.04


def test_who_stands_behind_is_hidden_and_who_hides_is_named(scene: Scene):
    joints, mesh = standing(scene)
    meshes, points = np.stack([mesh * 1.15, mesh + Y]), np.stack([joints * 1.15, joints + Y])
    rig = rig_of((-4 * Y, 0 * Y), (5 * Y, 0 * Y), (4 * X + 0.5 * Y, 0.5 * Y), (-4 * Y, -8 * Y))
    trunk = [BODY_25.index(name) for name in ("Neck", "MidHip", "RHip", "LHip")]
    for cell_m in (0.0, VisibilityConfig().cell_m):
        found = look(rig, points, meshes, scene, VisibilityConfig(cell_m=cell_m))
        front, back, side, away = range(4)
        assert (found.hidden_by[front, 0] == NOBODY).all() and (found.seen[front, 0] > 0.5).all()
        assert (found.hidden_by[front, 1, trunk] == 0).all() and (
            found.seen[front, 1, trunk] == 0
        ).all()
        assert (found.hidden_by[back, 0, trunk] == 1).all()
        # From behind nobody sees a face; the body itself is in front.
        assert (found.hidden_by[back, 1, FACE[:3]] == ITSELF).all()
        assert (found.hidden_by[back, 1, trunk] == NOBODY).all()
        # From the left the right arm is behind the trunk; the other person stands beside, hiding
        # nothing.
        assert (found.hidden_by[side] < 0).all()
        assert (found.hidden_by[side][:, [2, 3, 4, FACE[3]]] == ITSELF).all()
        assert (found.hidden_by[side][:, [7, 8, FACE[4]]] == NOBODY).all()
        assert not found.in_image[away].any() and (found.seen[away] == 0).all()
        assert (found.hidden_by[away] == BORDER).all()


def test_the_hider_is_who_stops_most_rays_and_half_seen_is_seen(scene: Scene):
    found = look(scene.rig, scene.truth_at(4), scene.vertices_at(4), scene, VisibilityConfig())
    np.testing.assert_allclose(found.seen * 9, np.rint(found.seen * 9), atol=1e-9)
    inside = found.in_image
    np.testing.assert_array_equal((found.hidden_by == NOBODY)[inside], (found.seen >= 0.5)[inside])
    np.testing.assert_array_equal(found.hidden_by == BORDER, ~inside)
    assert 0 < np.mean((found.seen > 0) & (found.seen < 1)) < 0.4
    assert (found.hidden_by != np.arange(4)[:, None]).all()  # itself is ITSELF, not its own index


def test_a_joint_that_no_surface_covers_is_seen(scene: Scene):
    joints, mesh = standing(scene)
    joints = (
        joints + 0.4 * Z
    )  # above the head, beside the arms: rays meet nothing, or what is behind
    rig = rig_of((-4 * Y, 0 * Y), (-4 * Y + X, 0 * Y))
    behind = np.stack([mesh, mesh + 1.5 * Y + 0.4 * Z])
    found = look(rig, np.stack([joints, joints + 1.5 * Y]), behind, scene, VisibilityConfig())
    outside = [BODY_25.index(name) for name in ("Nose", "RWrist", "LWrist", "RElbow", "LElbow")]
    assert (found.seen[:, 0, outside] == 1).all()


def test_nobody_is_seen_where_nobody_is(scene: Scene):
    found = look(
        scene.rig, np.zeros((0, 25, 3)), np.zeros((0, 12488, 3)), scene, VisibilityConfig()
    )
    assert found.seen.shape == found.in_image.shape == found.hidden_by.shape == (6, 0, 25)


def test_a_coarse_surface_is_a_surface(scene: Scene):
    body = scene.body
    kept, faces, cell = thinned(body.arrays.template, body.faces, 0.04)
    assert len(kept) < 2000 and len(cell) == body.num_vertices
    assert faces.min() >= 0 and faces.max() < len(kept)
    np.testing.assert_array_equal(cell[kept], np.arange(len(kept)))
    # Nobody is moved further than a cube's diagonal, and faces still turn outwards.
    away = np.linalg.norm(body.arrays.template - body.arrays.template[kept[cell]], axis=1)
    assert away.max() <= 0.04 * np.sqrt(3)
    a, b, c = (body.arrays.template[kept[faces[:, corner]]] for corner in range(3))
    volume = (a * np.cross(b, c)).sum() / 6
    a, b, c = (body.arrays.template[body.faces[:, corner]] for corner in range(3))
    assert 0.85 < volume / ((a * np.cross(b, c)).sum() / 6) < 1.0  # chords lie inside


def test_some_vertices_are_those_of_the_whole_surface(scene: Scene):
    only = np.array([5, 12000, 7])
    np.testing.assert_allclose(
        scene.vertices_at(2, only), scene.vertices_at(2)[:, only], atol=1e-6
    )  # float32
