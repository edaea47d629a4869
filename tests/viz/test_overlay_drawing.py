import numpy as np
import pytest

from shapepose_fg.core.camera import Camera
from shapepose_fg.core.drawing import bones_of
from shapepose_fg.core.skeleton import BODY_25, COCO_18
from shapepose_fg.io.footage.placement import Placement, PlacementKind
from shapepose_fg.simulation import built_in_scene
from shapepose_fg.viz.overlay.drawing import (
    GATED,
    PictureView,
    Skeletons,
    draw_bodies,
    draw_detections,
    draw_label,
    draw_skeletons,
)

RED = (30, 30, 220)


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=2, frames=1)


def view_of(camera: Camera, size: tuple[int, int] | None = None) -> PictureView:
    placement = Placement(PlacementKind.SAME, camera.image_size, camera.image_size)
    return PictureView(camera, placement, size or camera.image_size)


def grey(view: PictureView) -> np.ndarray:
    return np.full((view.size[1], view.size[0], 3), 40, dtype=np.uint8)


def skeletons(joints: np.ndarray, seen: bool = True, label: str = "") -> Skeletons:
    P = len(joints)
    return Skeletons(
        joints, np.full(joints.shape[:2], seen), bones_of(BODY_25.joints), [RED] * P, [label] * P
    )


def bent(camera: Camera) -> Camera:
    """The same camera with a lens that bends."""
    return Camera(
        camera.name, camera.K, camera.wTc, camera.image_size, np.array([-0.7, 0.1, 0.001, 0, 0])
    )


@pytest.mark.parametrize("scale", [0.5, 1.0])
def test_joints_are_drawn_where_the_lens_shows_them(scene, scale):
    camera = bent(scene.rig.cameras[0])
    view = view_of(
        camera, (round(camera.image_size[0] * scale), round(camera.image_size[1] * scale))
    )
    joints = scene.keypoints[0, :1].copy()  # a second person's bones may cross the first's joints
    hip = (np.linalg.inv(camera.wTc) @ np.append(joints[0, 8], 1.0))[:3]
    joints += (0.3 * hip[2] - hip[0]) * camera.wTc[
        :3, 0
    ]  # half-way to the right border, where the lens bends
    joints[0, 4] = np.nan
    drawn = grey(view)
    draw_skeletons(drawn, view, skeletons(joints))
    xy = camera.distort(camera.project(joints[0])[0])
    inside = 0
    for x, y in np.round((xy[np.isfinite(xy).all(axis=-1)] + 0.5) * scale - 0.5).astype(int):
        if 0 <= x < view.size[0] and 0 <= y < view.size[1]:
            dot = drawn[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
            assert dot.min(axis=2).max() > 180  # white, where a neighbour's rim does not cover it
            inside += 1
    assert inside > 15
    # Without its lens the camera shows them elsewhere.
    straight, _ = view_of(scene.rig.cameras[0], view.size).project(joints)
    assert np.nanmax(np.linalg.norm(straight - view.project(joints)[0], axis=-1)) > 3


def test_joints_that_were_not_seen_are_rings(scene):
    view = view_of(scene.rig.cameras[0])
    drawn = grey(view)
    draw_skeletons(drawn, view, skeletons(scene.keypoints[0, :1], seen=False))
    x, y = np.round(view.project(scene.keypoints[0, 0, 8])[0]).astype(int)
    assert drawn[y, x].max() < 60  # dark inside
    assert (np.abs(drawn[y - 6 : y + 7, x - 6 : x + 7].astype(int) - RED).max(axis=2) < 30).any()


def test_nothing_is_drawn_of_who_is_behind_the_camera_or_far_outside(scene):
    camera = bent(scene.rig.cameras[0])
    view = view_of(camera)
    behind = (
        camera.centre - 2 * camera.wTc[:3, 2] + np.random.default_rng(0).normal(0, 0.3, (1, 25, 3))
    )
    beside = camera.centre + camera.wTc[:3, 2] + 5 * camera.wTc[:3, 0] + np.zeros((1, 25, 3))
    for joints in (behind, beside, np.full((1, 25, 3), np.nan), np.zeros((0, 25, 3))):
        drawn = grey(view)
        draw_skeletons(drawn, view, skeletons(joints, label="nobody"))
        assert (drawn == 40).all()


def test_a_bone_bends_as_the_lens_bends_it():
    K = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    camera = Camera("c", K, np.eye(4), (640, 480), np.array([-0.25, 0.05, 0, 0, 0]))
    view = view_of(camera)
    joints = np.full((1, 25, 3), np.nan)
    joints[0, 1], joints[0, 8] = [-1.1, -0.8, 2.0], [1.1, -0.8, 2.0]
    drawn = grey(view)
    draw_skeletons(drawn, view, skeletons(joints))
    middle = camera.distort(camera.project(np.array([[0.0, -0.8, 2.0]]))[0])[0]
    ends = camera.distort(camera.project(joints[0, [1, 8]])[0])
    assert abs(middle[1] - ends[:, 1].mean()) > 8
    x, y = np.round(middle).astype(int)
    assert drawn[y, x, 2] > 150


def test_bodies_cover_their_joints_and_nothing_far_away(scene):
    view = view_of(scene.rig.cameras[0], (640, 360))
    colours = [(200, 40, 40), (40, 200, 40)]
    plain = grey(view)
    drawn = draw_bodies(plain, view, scene.vertices_at(0), scene.body.faces, colours)
    changed = (drawn != plain).any(axis=2)
    hips, _ = view.project(scene.keypoints[0][:, 8])
    assert all(changed[y, x] for x, y in np.round(hips).astype(int))
    assert changed.mean() < 0.5
    assert (plain == 40).all()
    none = scene.vertices_at(0)[:0]
    assert (draw_bodies(plain, view, none, scene.body.faces, []) == plain).all()


def test_detections_that_were_not_used_are_red_crosses():
    picture = np.full((100, 200, 3), 40, dtype=np.uint8)
    xy = np.array([[50.0, 50], [150, 50], [np.nan, np.nan]])
    draw_detections(picture, xy, np.array([True, False, False]), np.array([[200, 100, 20]] * 3))
    assert (np.abs(picture[40:60, 140:160].astype(int) - GATED).max(axis=2) < 40).any()
    assert not (np.abs(picture[:, :100].astype(int) - GATED).max(axis=2) < 60).any()
    assert (picture[40:60, 40:60] != 40).any()


@pytest.mark.parametrize("at", [(-50, -20), (100, 50), (900, 900)])
def test_labels_stay_in_the_picture(at):
    picture = np.full((120, 240, 3), 40, dtype=np.uint8)
    draw_label(picture, "person 3", at, RED)
    assert 600 < (np.abs(picture.astype(int) - RED).max(axis=2) < 20).sum() < 6000


def test_bones_are_those_of_the_skeleton():
    def names(joints: tuple[str, ...]) -> set[frozenset[str]]:
        return {frozenset({joints[a], joints[b]}) for a, b in bones_of(joints)}

    assert names(BODY_25.joints) > {frozenset({"Neck", "MidHip"})}
    assert frozenset({"RShoulder", "REar"}) not in names(COCO_18.joints)
    assert names(("Tail", "Neck", "MidHip")) == {frozenset({"Neck", "MidHip"})}
    assert bones_of(("Tail", "Horn")).shape == (0, 2)


def test_a_letterboxed_picture_is_drawn_on_where_the_people_are(scene):
    """The same person in the same camera, whose pictures were halved and got bars on two sides."""
    camera = scene.rig.cameras[0]
    width, height = camera.image_size
    placement = Placement(
        PlacementKind.LETTERBOX, (width // 2 + 100, height // 2), camera.image_size
    )
    view = PictureView(camera, placement, placement.picture_size)
    xy, _ = view.project(scene.keypoints[0, 0])
    plain, _ = camera.project(scene.keypoints[0, 0])
    np.testing.assert_allclose(xy, (plain + 0.5) / 2 - 0.5 + [50, 0], atol=1e-9)
