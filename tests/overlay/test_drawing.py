import cv2
import numpy as np
import pytest
from shapepose_fg.evaluation.overlay import cropped, draw_bodies, draw_skeletons, undistorted

from shapepose_fg.camera import Camera
from shapepose_fg.simulation import built_in_scene


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=2, frames=1)


@pytest.fixture
def grey(scene):
    width, height = scene.rig.cameras[0].image_size
    return np.full((height, width, 3), 40, dtype=np.uint8)


def test_joints_are_drawn_where_the_camera_sees_them(scene, grey):
    camera = scene.rig.cameras[0]
    joints = scene.keypoints[0, :1].copy()  # a second person's bones may cross the first's joints
    joints[0, 4] = np.nan
    drawn = draw_skeletons(grey, camera, joints)
    xy, _ = camera.project(joints)
    for x, y in np.floor(xy[np.isfinite(xy).all(axis=-1)] + 0.5).astype(int):
        if 0 <= x < grey.shape[1] and 0 <= y < grey.shape[0]:
            assert drawn[y, x].min() > 200  # a white dot
    assert (grey == 40).all()
    assert (draw_skeletons(grey, camera, joints[:0]) == grey).all()


def test_bodies_cover_their_joints_and_nothing_far_away(scene, grey):
    camera = scene.rig.cameras[0]
    drawn = draw_bodies(grey, camera, scene.vertices_at(0), scene.body.faces)
    changed = (drawn != grey).any(axis=2)
    hips, _ = camera.project(scene.keypoints[0][:, 8])
    for x, y in np.round(hips).astype(int):
        assert changed[y, x]
    assert changed.mean() < 0.5
    assert (draw_bodies(grey, camera, scene.vertices_at(0)[:0], scene.body.faces) == grey).all()


def test_a_point_is_where_it_was_after_undistortion(scene):
    """A dot where the lens puts a point is, without the lens, where the pinhole puts it."""
    K = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
    camera = Camera("c", K, np.eye(4), (1280, 720), np.array([-0.2, 0.05, 0, 0, 0]))
    point = np.array([[0.5, 0.25, 1.2]])
    pinhole, _ = camera.project(point)
    lens = camera.distort(pinhole)[0]
    assert np.linalg.norm(lens - pinhole[0]) > 15
    picture = np.zeros((720, 1280, 3), dtype=np.uint8)
    cv2.circle(picture, tuple(np.round(lens).astype(int).tolist()), 4, (255, 255, 255), -1)
    row, column = np.nonzero(undistorted(picture, camera)[..., 0] > 100)
    np.testing.assert_allclose([column.mean(), row.mean()], pinhole[0], atol=1.0)
    # A picture a few columns narrower than the calibration says is filled up.
    assert undistorted(picture[:, :1272], camera).shape == (720, 1280, 3)


def test_a_crop_has_everybody_in_the_middle(scene, grey):
    camera = scene.rig.cameras[0]
    drawn = draw_skeletons(np.zeros_like(grey), camera, scene.keypoints[0, :1])
    small = cropped(drawn, camera, scene.keypoints[0, 0], (200, 200))
    row, column = np.nonzero(small.any(axis=2))
    assert small.shape == (200, 200, 3)
    # 15 % of margin on either side of the longer side: 30 of 260 parts, a few pixels for the dots.
    assert row.min() > 10 and row.max() < 190
    assert np.ptp(row) > 130 or np.ptp(column) > 130
    assert cropped(drawn, camera, np.full((3, 3), np.nan), (64, 48)).shape == (48, 64, 3)
