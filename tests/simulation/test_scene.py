"""The built-in scene: people on the floor, close to each other, in view."""

import numpy as np
import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation import Scene, built_in_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return built_in_scene(seed=0)


def test_shapes_and_truth(scene: Scene):
    assert (len(scene), scene.people, len(scene.rig)) == (60, 4, 6)
    assert scene.rig.up == "z"
    assert scene.keypoints.shape == (60, 4, 25, 3)
    np.testing.assert_array_equal(scene.truth_at(7), scene.keypoints[7])
    assert np.isfinite(scene.keypoints).all()
    # The shapes differ: standing heights (nose over the soles) spread over more than 5 cm.
    nose = scene.keypoints[0, :, 0, 2]
    assert np.ptp(nose) > 0.05


def test_feet_are_on_the_floor_and_heads_above(scene: Scene):
    lowest = np.array([scene.vertices_at(frame)[..., 2].min(axis=1) for frame in range(0, 60, 6)])
    # A flat sole is at 0 by construction; a foot that rolls over its toes may dip by a few
    # millimetres more.
    assert np.abs(lowest).max() < 0.05
    assert np.median(np.abs(lowest)) < 0.015
    assert (scene.keypoints[..., 2] > 0).all()
    assert (scene.keypoints[:, :, BODY_25.index("Nose"), 2] > 0.7).all()


def test_joints_are_inside_or_on_the_surface_of_their_own_body(scene: Scene):
    vertices, joints = scene.vertices_at(30), scene.truth_at(30)
    distance = np.linalg.norm(vertices[:, None] - joints[:, :, None], axis=-1).min(axis=-1)
    assert distance.max() < 0.2  # the middle of the hips is the deepest, 10 to 15 cm


def test_motion_is_close_and_human(scene: Scene):
    hips = scene.keypoints[:, :, BODY_25.index("MidHip")]
    couple = np.linalg.norm(hips[:, 0] - hips[:, 1], axis=-1)
    assert couple.min() > 0.4 and couple.max() < 0.75
    others = np.linalg.norm(hips[:, 2:3] - hips[:, [0, 1, 3]], axis=-1)
    assert others.min() < 0.65  # the walker passes close by
    assert (
        np.linalg.norm(hips[:, :, None] - hips[:, None], axis=-1)[:, *np.triu_indices(4, 1)].min()
        > 0.35
    )
    assert np.linalg.norm(hips[-1, 2] - hips[0, 2]) > 1.5  # and really walks
    # The couple turns about each other by more than a right angle.
    direction = hips[:, 0, :2] - hips[:, 1, :2]
    angle = np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))
    assert abs(angle[-1] - angle[0]) > np.pi / 2
    # Hands held: each one's left wrist is a hand's length from the other's right one.
    left, right = BODY_25.index("LWrist"), BODY_25.index("RWrist")
    for one, two in ((0, 1), (1, 0)):
        gap = scene.keypoints[:, one, left] - scene.keypoints[:, two, right]
        assert np.linalg.norm(gap, axis=-1).max() < 0.3
    # No joint is faster than a fast hand, so no pose jumps between frames.
    speed = np.linalg.norm(np.diff(scene.keypoints, axis=0), axis=-1) * scene.fps
    assert speed.max() < 9.0


def test_knees_and_elbows_bend_as_they_do(scene: Scene):
    pose = scene.motion.body_pose
    assert (pose[..., [3, 4], 0] > 0).all()  # knees: shank backward, positive about x
    assert (pose[..., 17, 1] < 0).all() and (pose[..., 18, 1] > 0).all()  # elbows: forearm forward
    hinges = np.linalg.norm(pose[:, :, [3, 4, 17, 18]], axis=-1)
    assert hinges.max() < 2.8  # radians: nobody folds a limb flat
    assert np.ptp(pose[:, 3, [3, 4], 0]) > 0.6  # one crouches


def test_standing_feet_do_not_slide(scene: Scene):
    heel, toe = BODY_25.index("LHeel"), BODY_25.index("LBigToe")
    walker = scene.keypoints[:, 2]
    flat = (walker[1:, heel, 2] < 0.06) & (walker[1:, toe, 2] < 0.06)
    step = np.linalg.norm(np.diff(walker[:, toe, :2], axis=0), axis=-1)
    assert flat.sum() > 10
    assert np.median(step[flat]) < 0.01  # the body moves 4 cm a frame over a foot that stays


def test_everybody_is_in_at_least_three_views(scene: Scene):
    xy, _ = scene.rig.project(scene.keypoints)
    inside = ((xy >= 0) & (xy < scene.rig.image_sizes[:, None, None, None])).all(axis=-1)
    assert inside.sum(axis=0).min() >= 3
    assert inside.mean() > 0.95


def test_cameras_look_inward_from_different_sides(scene: Scene):
    rig = scene.rig
    assert ((rig.centres[:, 2] > 1.8) & (rig.centres[:, 2] < 2.8)).all()
    xy, _ = rig.project(np.array([0.0, 0.0, 0.9]))
    assert (np.abs(xy - rig.image_sizes / 2) < 120).all()
    axes = rig.cTw[:, 2]
    assert np.ptp(np.degrees(np.arctan2(axes[:, 1], axes[:, 0]))) > 180


@pytest.mark.parametrize(
    ("people", "cameras", "frames"),
    [(0, 2, 3), (1, 2, 3), (2, 3, 1), (3, 4, 2), (12, 12, 2), (4, 6, 0)],
)
def test_any_number_of_people_cameras_and_frames(people: int, cameras: int, frames: int):
    scene = built_in_scene(1, people=people, cameras=cameras, frames=frames)
    assert isinstance(scene.rig, Rig) and len(scene.rig) == cameras
    assert scene.keypoints.shape == (frames, people, 25, 3)
    assert np.isfinite(scene.keypoints).all()
    if frames > 0:
        assert scene.vertices_at(0).shape == (people, scene.body.num_vertices, 3)


def test_a_seed_fixes_the_scene_and_another_changes_it():
    first, again, other = (built_in_scene(seed, frames=3) for seed in (5, 5, 6))
    assert first.keypoints.tobytes() == again.keypoints.tobytes()
    assert first.rig.cTw.tobytes() == again.rig.cTw.tobytes()
    assert np.abs(first.keypoints - other.keypoints).max() > 0.05


def test_impossible_numbers_are_refused():
    with pytest.raises(ValueError, match="cameras >= 2"):
        built_in_scene(cameras=1)
