"""The picture of a frame: made for whoever is there, and bodies where their skeletons are."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation import DetectorConfig, Scene, built_in_scene, simulate
from shapepose_fg.viz.bodies import joined, surfaces
from shapepose_fg.viz.rendering import rasterise
from shapepose_fg.viz.viewer.picture import Floor, demo_picture, floor_under, framed, free_viewpoint, two_views

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return built_in_scene(seed=0, frames=2)


@pytest.fixture(scope="module")
def found(scene: Scene) -> Reconstruction:
    """The truth of both frames, as a reconstruction."""
    motion, people = scene.motion, scene.people
    return Reconstruction.concatenate(
        [
            Reconstruction(
                frame=np.full(people, frame),
                person=np.arange(people)[::-1],
                joint_names=np.array(BODY_25.joints),
                joints=scene.truth_at(frame),
                covariance=np.tile(1e-4 * np.eye(3), (people, 25, 1, 1)),
                confidence=np.ones((people, 25)),
                betas=motion.betas,
                global_orient=motion.global_orient[frame],
                body_pose=motion.body_pose[frame],
                transl=motion.transl[frame],
                status=np.array(["ok"] * people),
            )
            for frame in range(2)
        ]
    )


def without_body(people: Reconstruction, row: int) -> Reconstruction:
    """Take the body and the arms of one row away."""
    columns = {name: getattr(people, name).copy() for name in ("betas", "global_orient", "body_pose", "transl")}
    for value in columns.values():
        value[row] = np.nan
    status, joints = people.status.astype("U20"), people.joints.copy()
    status[row] = "body undetermined"
    joints[row, [3, 4, 6, 7]] = np.nan
    return replace(people, **columns, status=status, joints=joints)


def picture(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return image


def test_the_picture_is_written_with_everything(tmp_path: Path, scene: Scene, found: Reconstruction):
    detections = simulate(scene, DetectorConfig())[1]
    path = tmp_path / "people.png"
    demo_picture(path, scene.rig, found, 1, detections=detections, truth=scene.vertices_at(1))
    image = picture(path)
    assert image.shape[1] == 1800 and 900 < image.shape[0] < 1100
    # Somebody of each colour is drawn, besides paper and floor: colourful pixels of at least four hues.
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    hues = np.bincount(hsv[hsv[..., 1] > 100][:, 0] // 15, minlength=12)
    assert (hues > 1200).sum() >= 4


@pytest.mark.slow
def test_a_person_without_body_and_an_empty_frame_are_drawn(tmp_path: Path, scene: Scene, found: Reconstruction):
    partial = without_body(found, 3)  # the blue one: the most saturated
    for name, people in (("partial", partial), ("full", found), ("nobody", Reconstruction.empty())):
        demo_picture(tmp_path / f"{name}.png", scene.rig, people, 0)
    partly, full, empty = (picture(tmp_path / f"{name}.png") for name in ("partial", "full", "nobody"))

    def inked(image: np.ndarray) -> int:
        return int((cv2.cvtColor(image, cv2.COLOR_BGR2HSV)[..., 1] > 100).sum())

    assert inked(empty) < 0.02 * inked(full)
    assert 0.5 * inked(full) < inked(partly) < 0.95 * inked(full)


@pytest.mark.slow
def test_two_cameras_are_enough(tmp_path: Path, scene: Scene, found: Reconstruction):
    demo_picture(tmp_path / "two.png", Rig(scene.rig.cameras[:2], up="z"), found, 0)
    assert picture(tmp_path / "two.png").shape[1] == 1800


def test_there_are_no_surfaces_of_no_rows(scene: Scene):
    bodies, rows = surfaces(Reconstruction.empty(), scene.body)
    assert bodies.shape == (0, scene.body.num_vertices, 3) and len(rows) == 0


def test_surfaces_are_those_of_rows_with_a_body_and_lie_under_skeletons(scene: Scene, found: Reconstruction):
    people = without_body(found, 0).at(0)
    bodies, rows = surfaces(people, scene.body)
    np.testing.assert_array_equal(rows, [1, 2, 3])
    np.testing.assert_allclose(bodies, scene.vertices_at(0)[1:], atol=1e-5)
    vertices, faces = joined(bodies, scene.body.faces)
    # In a view, every joint's pixel is covered by a body or next to one: joints lie inside the silhouette.
    camera = framed(scene.rig.cameras[0], vertices, (800, 450))
    surface = rasterise(*camera.project(vertices), faces, camera.image_size)
    xy, _ = camera.project(people.joints[rows].reshape(-1, 3))
    column, row = np.clip(np.rint(xy), 0, (799, 449)).astype(int).T
    assert (surface.face[row, column] >= 0).mean() > 0.95


def test_views_and_frames_are_well_chosen(scene: Scene, found: Reconstruction):
    joints, none = found.at(0).joints, np.zeros((0, 3, 3))
    vertices, faces = joined(scene.vertices_at(0), scene.body.faces)
    points = np.concatenate([joints.reshape(-1, 3), vertices])
    first, second = two_views(scene.rig, vertices, faces)
    assert first != second
    axes = scene.rig.cTw[:, 2, :3]
    assert abs(axes[first] @ axes[second]) < 0.8
    for camera in scene.rig.cameras:
        window = framed(camera, points, (640, 360))
        assert window.image_size == (640, 360)
        inside = camera.project(points)[0]
        seen = ((inside >= 0) & (inside <= np.array(camera.image_size) - 1)).all(axis=1)
        xy, _ = window.project(points[seen])
        assert (xy > -1).all() and (xy < (640, 360)).all()
    floor = floor_under(scene.rig, joints, none, points)
    assert abs(floor.origin @ UP) < 0.01  # the floor of the built-in scene is at 0
    sunk = joints - np.array([0.5, 0, 0, 0])[:, None, None] * UP
    assert abs(floor_under(scene.rig, sunk, none, points).origin @ UP) < 0.02
    assert abs(floor_under(scene.rig, sunk, scene.vertices_at(0), points).origin @ UP) < 0.01
    free = free_viewpoint(scene.rig, points, floor, (900, 800))
    xy, _ = free.project(points)
    assert (xy > 0).all() and (xy < (900, 800)).all()


@pytest.mark.parametrize("up", [UP, -np.eye(3)[1]])
def test_a_floor_has_axes_of_its_own_at_its_height(up: np.ndarray):
    points = np.random.default_rng(0).normal(size=(20, 3))
    floor = Floor.under(points, up, -0.3, 3.0)
    np.testing.assert_allclose(floor.axes @ floor.axes.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(floor.axes @ up, 0, atol=1e-12)
    assert abs(floor.origin @ up + 0.3) < 1e-12
    xy = np.array([[0.2, -0.4], [1.0, 2.0]])
    np.testing.assert_allclose(floor.coordinates(floor.at(xy) + 0.7 * up), xy)
    np.testing.assert_allclose((floor.at(xy) - floor.origin) @ up, 0, atol=1e-12)
