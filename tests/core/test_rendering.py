"""The z-buffer against surfaces whose depth is known in closed form."""

import numpy as np
import pytest

from shapepose_fg.core.camera import Camera
from shapepose_fg.core.drawing import vertex_normals
from shapepose_fg.core.rendering import (
    first_surface_at,
    look_at,
    scaled,
    shaded,
)

UP = np.array([0.0, 0.0, 1.0])


def sphere(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """A unit sphere: vertices, and faces that turn counter-clockwise seen from outside."""
    theta = np.linspace(0, np.pi, rings)[:, None]
    phi = np.arange(2 * rings) * np.pi / rings
    vertices = np.stack(
        np.broadcast_arrays(
            np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
        ),
        -1,
    )
    i, j = np.arange(rings - 1)[:, None] * 2 * rings, np.arange(2 * rings)[None]
    k = (j + 1) % (2 * rings)
    a, b, c, d = (q.ravel() for q in (i + j, i + 2 * rings + j, i + 2 * rings + k, i + k))
    return vertices.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


@pytest.fixture
def camera() -> Camera:
    K = np.array([[200.0, 0, 79.5], [0, 200.0, 59.5], [0, 0, 1]])
    return Camera("c", K, look_at(np.array([4.0, 1.0, 0.5]), np.zeros(3), UP), (160, 120))


def rays(camera: Camera) -> np.ndarray:
    """(H, W, 3) directions in camera coordinates with depth 1."""
    column, row = np.meshgrid(np.arange(camera.image_size[0]), np.arange(camera.image_size[1]))
    return np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(camera.K).T


def drawn(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth and vertex in all pixels."""
    row, column = np.mgrid[: camera.image_size[1], : camera.image_size[0]]
    return first_surface_at(vertices, faces.astype(np.int32), camera, column, row)


def of_pixels(
    xy: np.ndarray, depth: np.ndarray, faces: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Depth and vertex in all pixels of a picture, of corners at pixels `xy`."""
    K = np.array([[20.0, 0, size[0] / 2], [0, 20.0, size[1] / 2], [0, 0, 1]])
    points = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(K).T * depth[:, None]
    return drawn(points, faces, Camera("c", K, np.eye(4), size))


def test_depth_of_a_sphere(camera: Camera):
    vertices, faces = sphere(200)
    depth, vertex = drawn(vertices, faces, camera)
    centre = camera.cTw[:, 3]
    # |s ray - centre| = 1, the smaller root.
    ray = rays(camera)
    a, b = (ray**2).sum(-1), ray @ centre
    root = b**2 - a * (centre @ centre - 1)
    hit = vertex >= 0
    assert 0.995 < hit.sum() / (root > 0).sum() <= 1.0  # the facets lie inside the sphere
    inner = (
        root > 0.3
    )  # away from the rim, where a facet's error in depth is not multiplied by the slope
    expected = (b[inner] - np.sqrt(root[inner])) / a[inner]
    # A facet's edge is pi / 199 long, its diagonal d = 0.022, and lies d^2 / 8 = 6e-5 under the
    # sphere; root > 0.3 is a slope of at most 1 / sqrt(0.3).
    assert np.abs(depth[inner] - expected).max() < 1.2e-4
    assert np.isinf(depth[~hit]).all()


def test_depth_of_a_tilted_plane(camera: Camera):
    corners = np.array([[-0.4, -0.5, 0.3], [0.5, -0.4, -0.2], [0.3, 0.5, 0.1], [-0.6, 0.6, 0.6]])
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    corners[3] -= normal * (normal @ (corners[3] - corners[0])) / (normal @ normal)
    depth, vertex = drawn(corners, np.array([[0, 1, 2], [0, 2, 3]]), camera)
    n = camera.cTw[:, :3] @ normal
    point = camera.cTw[:, :3] @ corners[0] + camera.cTw[:, 3]
    expected = (n @ point) / (rays(camera) @ n)
    hit = vertex >= 0
    assert hit.sum() > 500
    assert (
        np.abs(depth[hit] - expected[hit]).max() < 1e-4
    )  # OpenCV keeps depths of 5 cm to 100 m in float32


def test_the_nearer_of_two_quads_wins_and_neighbours_leave_no_gap():
    square = np.array(
        [[1.75, 1.75], [12.25, 1.75], [12.25, 12.25], [1.75, 12.25]]
    )  # no edge on a pixel's centre
    xy = np.concatenate([square, square + np.array([5, 3])])
    faces = np.array([[2, 1, 0], [3, 2, 0], [6, 5, 4], [7, 6, 4]])  # counter-clockwise as seen
    depth, vertex = of_pixels(xy, np.repeat([3.0, 2.0], 4), faces, (24, 20))
    row, column = np.mgrid[:20, :24]
    first = (column >= 2) & (column <= 12) & (row >= 2) & (row <= 12)
    second = (column >= 7) & (column <= 17) & (row >= 5) & (row <= 15)
    expected = np.where(second, 2.0, np.where(first, 3.0, np.inf))
    np.testing.assert_allclose(depth, expected, rtol=1e-5)
    assert (vertex[second] >= 4).all()
    assert ((vertex >= 0) & (vertex < 4))[first & ~second].all()


def test_nearer_in_the_middle_only_where_planes_cross():
    xy = np.array([[-0.5, -0.5], [20.5, -0.5], [20.5, 10.5], [-0.5, 10.5]] * 2)
    depth = np.array([1.0, 3, 3, 1, 3, 1, 1, 3])
    faces = np.array([[2, 1, 0], [3, 2, 0], [6, 5, 4], [7, 6, 4]])  # counter-clockwise as seen
    met, vertex = of_pixels(xy, depth, faces, (21, 11))
    assert (vertex[:, :10] < 4).all()
    assert (vertex[:, 11:] >= 4).all()
    # 1/depth is linear: halfway between 1 m and 3 m it is 2/3.
    np.testing.assert_allclose(met[5, 10], 1.5, rtol=1e-5)


def test_what_is_behind_the_camera_or_nan_is_not_drawn(camera: Camera):
    vertices, faces = sphere(20)

    def any_drawn(vertices: np.ndarray, faces: np.ndarray) -> bool:
        white = np.ones((len(vertices), 3))
        xy, depth = camera.project(vertices)
        picture = shaded(xy, depth, faces, white, camera.image_size)
        assert (picture >= 0).any() == (picture == 1).any()
        return bool((picture >= 0).any())

    behind = vertices + 2 * camera.centre
    assert (drawn(behind, faces, camera)[1] == -1).all() and not any_drawn(behind, faces)
    around = (
        vertices + camera.centre
    )  # the camera is in the middle: no face crosses the image plane whole
    assert np.isfinite(drawn(around, faces[:, ::-1], camera)[0]).any()
    assert any_drawn(around, faces[:, ::-1])
    vertices = vertices.copy()
    vertices[:200] = np.nan
    assert any_drawn(vertices, faces)
    assert not any_drawn(np.zeros((0, 3)), np.zeros((0, 3), dtype=int))
    depth, vertex = drawn(np.zeros((0, 3)), np.zeros((0, 3), dtype=int), camera)
    assert np.isinf(depth).all() and (vertex == -1).all()


def test_look_at_puts_the_target_in_the_middle_and_up_up(camera: Camera):
    (centre, above), depth = camera.project(np.array([[0.0, 0, 0], [0, 0, 0.2]]))
    np.testing.assert_allclose(centre, (79.5, 59.5), atol=1e-9)
    np.testing.assert_allclose(depth[0], np.linalg.norm(camera.centre))
    assert above[1] < centre[1] and abs(above[0] - centre[0]) < 1e-9
    with pytest.raises(ValueError, match="parallel"):
        look_at(np.array([0.0, 0, 2]), np.zeros(3), UP)


def test_scale_moves_points_as_the_pixels_move(camera: Camera):
    points = np.array([[0.3, -0.2, 0.5], [-0.4, 0.1, 0.0]])
    xy, _ = camera.project(points)
    np.testing.assert_allclose(scaled(camera, 0.5).project(points)[0], (xy + 0.5) / 2 - 0.5)


def test_normals_of_a_sphere():
    vertices, faces = sphere(60)
    away_from_poles = np.abs(vertices[:, 2]) < 0.99
    normals = vertex_normals(vertices, faces)
    # Area weights on quads cut along one diagonal lean the mean by half a facet's angle at most: pi
    # / 60 / 2.
    assert np.abs(normals - vertices)[away_from_poles].max() < 0.03


def test_shading_shows_the_surfaces_that_are_met(camera: Camera):
    """Two spheres, one through the other, from outside, from near and from inside, by a camera with
    skew; each has its own grey.
    """
    ball, faces = sphere(40)
    points = np.concatenate([ball, 0.6 * ball + (0.5, 0.7, 0.2)])
    mesh = np.concatenate([faces, faces + len(ball)])
    grey = np.repeat([0.25, 0.75], len(ball))
    hits = []
    for eye, target in (
        ((4.0, 1, 0.5), (0, 0, 0)),
        ((1.0, 0.1, 1), (0.5, 0.7, 0.2)),
        ((0, 0, 0.1), (3.0, 1, 0)),
    ):
        skewed = np.array([[200.0, 3.0, 70.0], [0, 180.0, 66.0], [0, 0, 1]])
        seen_from = Camera(
            "c", skewed, look_at(np.array(eye), np.array(target), UP), camera.image_size
        )
        colour = np.repeat(grey[:, None], 3, axis=1)
        picture = shaded(*seen_from.project(points), mesh, colour, camera.image_size)
        _, vertex = drawn(points, mesh, seen_from)
        hits.append((vertex >= 0).mean())
        expected = np.where(vertex >= 0, grey[vertex], -1)
        # Pixel centres on an edge, to float32.
        assert np.mean(np.abs(picture - expected[..., None]).max(axis=-1) > 1e-3) < 2e-3
    assert min(hits) > 0.3  # also from inside the first ball, whose backs are not drawn
