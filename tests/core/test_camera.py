import cv2
import numpy as np
import pytest

from shapepose_fg.core.camera import Camera, Rig, Views

K = np.array([[1000.0, 2.0, 500.0], [0.0, 1010.0, 400.0], [0.0, 0.0, 1.0]])
LENS = np.array([-0.3, 0.1, 0.001, -0.002, 0.02])


def posed(name: str = "a", lens: np.ndarray = LENS) -> Camera:
    R, _ = cv2.Rodrigues(np.array([0.3, -0.5, 0.2]))
    return Camera.from_camera_from_world(
        name, K, np.hstack([R, [[0.1], [0.2], [4.0]]]), (1000, 800), list(lens)
    )


def test_projects_like_opencv():
    camera = posed()
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3))
    xy, depth = camera.project(points)
    rotation, _ = cv2.Rodrigues(camera.cTw[:, :3])
    # OpenCV's projectPoints has no skew, so the skew's part is added by hand.
    without_skew = K.copy()
    without_skew[0, 1] = 0.0
    expected, _ = cv2.projectPoints(points, rotation, camera.cTw[:, 3], without_skew, np.zeros(5))
    expected = expected[:, 0]
    expected[:, 0] += 2.0 * (expected[:, 1] - 400.0) / 1010.0
    np.testing.assert_allclose(xy, expected, atol=1e-8)
    np.testing.assert_allclose(depth, (points @ camera.cTw[:, :3].T + camera.cTw[:, 3])[:, 2])


def test_undistort_inverts_distort():
    plain = K.copy()
    plain[0, 1] = 0.0
    camera = Camera("a", plain, np.eye(4), (1000, 800), LENS)
    xy = np.random.default_rng(0).uniform((0, 0), (1000, 800), (50, 2))
    # The inverse is iterated to 1e-6 of a normalised coordinate, a thousandth of a pixel.
    np.testing.assert_allclose(camera.distort(camera.undistort(xy)), xy, atol=1e-6)
    assert np.abs(camera.undistort(xy) - xy).max() > 5.0, (
        "the lens must bend something for this to test anything"
    )


def test_behind_the_camera_is_nan():
    xy, depth = Camera("a", K, np.eye(4), (1000, 800)).project(
        np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    )
    assert np.isnan(xy[0]).all() and depth[0] == -1.0
    np.testing.assert_allclose(xy[1], [500.0, 400.0])


def test_rig_projects_as_its_cameras(five_cameras, two_people):
    xy, depth = five_cameras.project(two_people)
    for view, camera in enumerate(five_cameras.cameras):
        expected_xy, expected_depth = camera.project(two_people)
        np.testing.assert_allclose(xy[view], expected_xy, atol=1e-9)
        np.testing.assert_allclose(depth[view], expected_depth, atol=1e-12)


def test_normalise_inverts_the_intrinsics(five_cameras, two_people):
    xy, depth = five_cameras.project(two_people[0])
    view = np.repeat(np.arange(5), 25)
    rays = np.concatenate(
        [five_cameras.normalise(view, xy.reshape(-1, 2)), np.ones((125, 1))], axis=1
    )
    points_camera = rays * depth.reshape(-1, 1)
    cTw = five_cameras.cTw[view]
    points = np.einsum("dji,dj->di", cTw[:, :, :3], points_camera - cTw[:, :, 3])
    np.testing.assert_allclose(points, np.tile(two_people[0], (5, 1)), atol=1e-9)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"K": np.eye(4)}, "K must be"),
        ({"K": np.diag([-1.0, 1.0, 1.0])}, "positive focal"),
        ({"wTc": np.diag([1.0, 1.0, 1.1, 1.0])}, "orthonormal"),
        ({"wTc": np.diag([1.0, 1.0, -1.0, 1.0])}, "orthonormal"),
        ({"wTc": np.full((4, 4), np.nan)}, "not finite"),
        ({"image_size": (0, 5)}, "image_size"),
    ],
)
def test_refuses_what_is_no_camera(changed, message):
    with pytest.raises(ValueError, match=message):
        Camera(**({"name": "a", "K": K, "wTc": np.eye(4), "image_size": (10, 10)} | changed))


def test_printed_digits_do_not_scale():
    R, _ = cv2.Rodrigues(np.array([0.3, -0.5, 0.2]))
    camera = Camera.from_camera_from_world(
        "a", K, np.hstack([R.round(4), np.ones((3, 1))]), (10, 10)
    )
    np.testing.assert_allclose(camera.wTc[:3, :3] @ camera.wTc[:3, :3].T, np.eye(3), atol=1e-12)


def test_rig_needs_a_camera_different_names_and_an_up_axis():
    with pytest.raises(ValueError, match="at least one camera"):
        Rig((), "z")
    assert Rig((posed(),), "z").names == (posed().name,)  # enough to detect in its pictures
    with pytest.raises(ValueError, match="names must differ"):
        Rig((posed(), posed()), "z")
    with pytest.raises(ValueError, match="up must be"):
        Rig((posed(), posed("b")), "up")  # type: ignore[arg-type]
    np.testing.assert_array_equal(Rig((posed(), posed("b")), "-y").up_vector, [0, -1, 0])


LENSES = {
    "five": ("perspective", [-0.3, 0.1, 0.001, -0.002, 0.02]),
    "rational": ("perspective", [5.1, 2.3, 1e-4, -2e-4, 0.12, 5.4, 3.9, 0.6]),
    "thin prism": ("perspective", [-0.2, 0.05, 1e-3, -1e-3, 0, 0.1, 0, 0, 1e-3, -2e-3, 1e-3, 0]),
    "fisheye": ("fisheye", [0.05, -0.01, 0.003, -0.001]),
}


@pytest.mark.parametrize("lens", LENSES)
def test_a_lens_bends_as_opencv_says_and_is_undone(lens):
    family, coefficients = LENSES[lens]
    plain = K.copy()
    plain[0, 1] = 0.0  # OpenCV's own functions have no skew
    camera = Camera("a", plain, np.eye(4), (1000, 800), np.array(coefficients), family)
    rays = np.random.default_rng(0).uniform(-0.45, 0.45, (60, 2))
    points = np.concatenate([rays, np.ones((60, 1))], axis=1)
    project = cv2.fisheye.projectPoints if family == "fisheye" else cv2.projectPoints
    seen, _ = project(
        points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), plain, np.array(coefficients)
    )
    ideal, _ = camera.project(points)
    np.testing.assert_allclose(camera.distort(ideal), seen[:, 0], atol=1e-9)
    np.testing.assert_allclose(camera.undistort(seen[:, 0]), ideal, atol=1e-6)  # pixels


def test_skew_is_bent_too():
    camera = posed()
    xy = np.random.default_rng(0).uniform((100, 100), (900, 700), (50, 2))
    np.testing.assert_allclose(camera.distort(camera.undistort(xy)), xy, atol=1e-6)


def test_what_the_lens_does_not_reach_is_nan():
    # r (1 - 0.28 r^2 + 0.08 r^4 - 0.01 r^6) stays under 1.0: a corner at r = 1.1 is no point of any
    # ray.
    camera = Camera(
        "a",
        np.diag([1000.0, 1000, 1]),
        np.eye(4),
        (1000, 800),
        np.array([-0.28, 0.08, 0, 0, -0.01]),
    )
    ideal = camera.undistort(np.array([[960.0, 540.0], [300.0, 200.0]]))
    assert np.isnan(ideal[0]).all() and np.isfinite(ideal[1]).all()


def test_refuses_coefficients_of_another_lens():
    with pytest.raises(ValueError, match="distortion must be"):
        Camera("a", K, np.eye(4), (10, 10), np.zeros(6))
    with pytest.raises(ValueError, match=r"distortion must be \(4,\)"):
        Camera("a", K, np.eye(4), (10, 10), np.zeros(5), "fisheye")
    with pytest.raises(ValueError, match="lens must be"):
        Camera("a", K, np.eye(4), (10, 10), np.zeros(5), "mirror")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at most 4"):
        Camera.from_camera_from_world("a", K, np.eye(4), (10, 10), [0.1] * 5, "fisheye")


def test_pixels_are_those_of_the_projection_with_derivatives_moving_cameras_too(
    five_cameras, two_people
):
    still = Views.of(five_cameras)
    for views in (still, Views(still.K, np.tile(still.cTw, (2, 1, 1, 1)))):
        points = two_people.copy()
        points[1, 3] = 100.0  # behind some
        xy, depth, _ = views.project(points)
        np.testing.assert_allclose(views.pixels(points)[0], xy, atol=1e-8)
        np.testing.assert_allclose(views.pixels(points)[1], depth, atol=1e-12)
        assert np.isnan(xy).any()
