"""A picture of one frame: the people found, with bodies, over two views and in 3D."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.arrays import Array, Index, Real
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.io.footage.footage import Picture
from shapepose_fg.io.footage.placement import Placement, PlacementKind
from shapepose_fg.viz.bodies import joined, surfaces
from shapepose_fg.viz.overlay import drawing
from shapepose_fg.viz.overlay.drawing import Colour
from shapepose_fg.viz.rendering import look_at, rasterise, zoom

_WIDE, _GAP, _HEADER = 1800, 14, 60
"""Width of the picture, space between its panels and above them, pixels."""
_LEFT = 780
"""Width of the views on the left."""
_SOLE_M = 0.015
"""How far the lowest keypoint of a foot is above its sole, metres."""
_CELL_M = 0.5
"""Between the lines of the floor."""
_CLAY, _LINE = (191, 189, 189), (212, 216, 217)
_INK, _QUIET, _DOT = (51, 45, 43), (132, 125, 123), (40, 40, 40)


@dataclass(frozen=True)
class Floor:
    """A horizontal plane with two axes of its own."""

    origin: Array
    """(3,) the point in the world around which the floor is drawn, metres."""
    axes: Array
    """(2, 3) unit vectors along the floor."""
    up: Array
    """(3,) unit vector."""
    radius_m: float
    """Where the floor has faded into the paper."""

    @classmethod
    def under(cls, points: Array, up: Array, height_m: float, radius_m: float) -> "Floor":
        """A floor `height_m` up, around the middle of `points` (N, 3)."""
        axis = np.eye(3)[np.abs(up).argmin()]
        level = axis - up * (axis @ up)
        first: Array = level / float(np.linalg.norm(level))
        axes = np.stack([first, np.cross(up, first)])
        # The middle falls on a crossing of grid lines, which stay where they are in the world.
        middle = (points @ axes.T).mean(axis=0) if len(points) else np.zeros(2)
        crossing: Array = np.round(middle / _CELL_M) * _CELL_M
        return cls(crossing @ axes + height_m * up, axes, up, radius_m)

    def coordinates(self, points: Array) -> Array:
        """(..., 2) metres along the floor's axes of points (..., 3)."""
        return (points - self.origin) @ self.axes.T

    def at(self, xy: Array) -> Array:
        """(..., 3) the points of the floor with coordinates (..., 2)."""
        return self.origin + xy @ self.axes


def demo_picture(
    path: Path,
    rig: Rig,
    reconstruction: Reconstruction,
    frame: int,
    detections: Detections | None = None,
    truth: Real | None = None,
) -> None:
    """Write a PNG of the people of `frame`: over two views on the left, from a free viewpoint on the right.

    `detections` of that frame are drawn as dots; `truth` (P, Nv, 3), the true surfaces where they are known, as
    grey figures. Who has no body is drawn as a skeleton. The views are the one that sees people least covered, and
    one across from it.
    """
    body = BodyModel.default()
    people = reconstruction.at(frame)
    people = people.rows(np.argsort(people.person, kind="stable"))
    bodies, rows = surfaces(people, body)
    found = bodies, [drawing.blue_green_red(person) for person in people.person[rows].tolist()]
    truth = np.zeros((0, body.num_vertices, 3)) if truth is None else np.asarray(truth, dtype=np.float64)
    points = np.concatenate([each.reshape(-1, 3) for each in (people.joints, bodies, truth)])
    points = points[np.isfinite(points).all(axis=1)]
    floor = floor_under(rig, people.joints, truth, points)

    short = round(_LEFT * 9 / 16)
    tall, across = 2 * short + _GAP, _WIDE - _LEFT - 3 * _GAP
    page = np.full((_HEADER + tall + _GAP, _WIDE, 3), 255, dtype=np.uint8)
    views = two_views(rig, *joined(bodies, body.faces))
    for place, view in enumerate(views):
        window = framed(rig.cameras[view], points, (_LEFT, short))
        panel = _bodies(window, floor, body.faces, [(truth, [_CLAY] * len(truth), 1.0), (*found, 0.72)])
        if detections is not None:
            _draw_dots(panel, window, rig.cameras[view], detections.xy[detections.view == view])
        _draw_people(panel, window, people, np.arange(len(people)))
        _place(page, panel, rig.names[view], (_GAP, _HEADER + place * (short + _GAP)))
    camera = free_viewpoint(rig, points, floor, (across, tall))
    panel = _bodies(camera, floor, body.faces, [(*found, 1.0)])
    _draw_people(panel, camera, people, np.setdiff1d(np.arange(len(people)), rows))
    for view, other in enumerate(rig.cameras):
        _draw_frustum(panel, camera, other, floor, _INK if view in views else _QUIET)
    _place(page, panel, "3D", (_LEFT + 2 * _GAP, _HEADER))
    signs = ["dots: 2D candidates"] * (detections is not None) + ["grey: the true people"] * (len(truth) > 0)
    count = f"{len(people)} {'person' if len(people) == 1 else 'people'}, {len(rig)} cameras, frame {frame}"
    _write(page, "Every person in 3D", (_GAP, 40), 0.95, _INK, 2)
    _write(page, "; ".join([count, *signs]), (_LEFT + 2 * _GAP, 40), 0.6, _QUIET, 1)
    drawing.write_picture(path, page)


def _bodies(
    camera: Camera, floor: Floor, faces: Index, drawn: Sequence[tuple[Array, Sequence[Colour], float]]
) -> Picture:
    """The floor, and over it bodies (P, Nv, 3) with colours and opacity; made smaller for smooth edges."""
    view = _view(camera, 2)
    panel = np.full((view.size[1], view.size[0], 3), 255, dtype=np.uint8)
    cells = np.arange(-floor.radius_m // _CELL_M, floor.radius_m // _CELL_M + 1) * _CELL_M
    start = np.stack(np.meshgrid(cells, cells), axis=-1).reshape(-1, 2)
    start = start[np.linalg.norm(start, axis=1) < floor.radius_m]
    pieces = np.concatenate([np.stack([start, start + side], axis=1) for side in _CELL_M * np.eye(2)])
    xy, _ = view.project(floor.at(pieces))
    drawing.draw_lines(panel, xy[np.isfinite(xy).all(axis=(1, 2))], _LINE)
    for bodies, colours, opacity in drawn:
        panel = drawing.draw_bodies(panel, view, bodies, faces, colours, opacity)
    return np.asarray(cv2.resize(panel, camera.image_size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _view(camera: Camera, scale: int = 1) -> drawing.PictureView:
    """The pictures of a camera without distortion, drawn `scale` times as large."""
    width, height = camera.image_size
    placement = Placement(PlacementKind.SAME, camera.image_size, camera.image_size)
    return drawing.PictureView(camera, placement, (scale * width, scale * height))


def _draw_people(panel: Picture, camera: Camera, people: Reconstruction, rows: Index) -> None:
    """The skeletons of some rows, with who they are."""
    drawing.draw_skeletons(panel, _view(camera), drawing.Skeletons.of(people.rows(rows)))


def _draw_dots(panel: Picture, window: Camera, camera: Camera, xy: Array) -> None:
    """Detections of `camera` at its pixels `xy` (D, 2), in its enlarged window."""
    scale = window.K[0, 0] / camera.K[0, 0]
    shift = window.K[:2, 2] + 0.5 - scale * (camera.K[:2, 2] + 0.5)
    for x, y in np.rint(16 * (scale * (xy + 0.5) + shift - 0.5)).astype(int).tolist():
        cv2.circle(panel, (x, y), 28, _DOT, -1, cv2.LINE_AA, 4)


def _draw_frustum(panel: Picture, camera: Camera, other: Camera, floor: Floor, colour: Colour) -> None:
    """A small pyramid where a camera is, its name, and a thread down to the floor."""
    width, height = other.image_size
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]])
    rays = corners @ np.linalg.inv(other.K).T @ other.wTc[:3, :3].T
    foot = floor.at(floor.coordinates(other.centre))
    xy, _ = camera.project(np.concatenate([other.centre[None], other.centre + 0.34 * rays, foot[None]]))
    inside = (xy[0] > 0) & (xy[0] < camera.image_size)  # NaN behind the eye compares false
    if not inside.all() or not np.isfinite(xy).all():
        return
    corner = np.arange(1, 5)
    drawing.draw_lines(panel, xy[np.stack([0 * corner, corner], axis=1)], colour)
    drawing.draw_lines(panel, xy[np.stack([corner, np.roll(corner, 1)], axis=1)], colour)
    drawing.draw_lines(panel, xy[[[0, 5]]], _LINE)
    _write(panel, other.name, (round(xy[:5, 0].mean()) - 18, round(xy[:5, 1].min()) - 8), 0.45, colour, 1)


def _place(page: Picture, panel: Picture, name: str, at: tuple[int, int]) -> None:
    """Put a panel with its name on the page, its left upper corner `at`."""
    drawing.draw_label(panel, name, (0, 0), (255, 255, 255), centred=False)
    height, width = panel.shape[:2]
    page[at[1] : at[1] + height, at[0] : at[0] + width] = panel
    cv2.rectangle(page, (at[0] - 1, at[1] - 1), (at[0] + width, at[1] + height), (212, 216, 217), 1)


def _write(picture: Picture, text: str, at: tuple[int, int], size: float, colour: Colour, thick: int) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, thick, cv2.LINE_AA)


def floor_under(rig: Rig, joints: Array, truth: Array, points: Array) -> Floor:
    """The floor around `points` (K, 3): under true soles (P, Nv, 3) or most people's lowest `joints` (N, J, 3)."""
    up = rig.up_vector
    lowest = np.where(np.isfinite(joints).all(axis=-1), joints @ up, np.inf).min(axis=1, initial=np.inf)
    lowest = lowest[np.isfinite(lowest)] - _SOLE_M
    # The median: one foot fitted through the floor does not lower it for everybody.
    heights = [(truth @ up).min()] if len(truth) else lowest
    height = float(np.median(heights)) if len(heights) else 0.0
    floor = Floor.under(points, up, height, radius_m=1.0)
    reach = np.linalg.norm(floor.coordinates(rig.centres), axis=1).max()
    return replace(floor, radius_m=float(np.clip(1.05 * reach, 3.6, 10.0)))


def two_views(rig: Rig, vertices: Array, faces: Index) -> tuple[int, int]:
    """The view in which bodies cover each other least, and one that looks from across, about 90 degrees."""
    if len(vertices) == 0:
        return 0, len(rig) // 2
    area_m2 = np.zeros(len(rig))
    for view, camera in enumerate(rig.cameras):
        small = zoom(camera, (0, 0, *camera.image_size), 240)
        depth = rasterise(*small.project(vertices), faces, small.image_size).depth
        area_m2[view] = (depth[np.isfinite(depth)] ** 2).sum() / small.K[0, 0] ** 2
    first = int(area_m2.argmax())
    axes = rig.cTw[:, 2, :3]
    across = 1.0 - np.abs(axes @ axes[first])
    across[first] = -1.0
    return first, int((across * area_m2).argmax())


def framed(camera: Camera, points: Array, size: tuple[int, int]) -> Camera:
    """`camera` enlarged on `points` (K, 3), with some room around them, to a picture of `size`."""
    image = np.array(camera.image_size, dtype=np.float64)
    xy, _ = camera.project(points)
    xy = xy[np.isfinite(xy).all(axis=1)]
    low, high = (xy.min(axis=0), xy.max(axis=0)) if len(xy) else (np.zeros(2), image)
    low, high = np.clip(low, 0.0, image), np.clip(high, 0.0, image)
    shape = np.array(size) / size[1]
    tall = max(((high - low) / shape).max() * 1.16, 0.3 * image[1])
    tall = min(tall, (image / shape).min())
    middle = np.clip((low + high) / 2, shape * tall / 2, image - shape * tall / 2)
    corner = middle - shape * tall / 2
    return zoom(camera, (*corner, *(corner + shape * tall)), size[0])


def free_viewpoint(rig: Rig, points: Array, floor: Floor, size: tuple[int, int]) -> Camera:
    """A long lens from above, in the widest gap between the cameras, that has people and far cameras in."""
    around = floor.coordinates(rig.centres)
    angles = np.sort(np.arctan2(around[:, 1], around[:, 0]))
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    angle = (angles + gaps / 2)[gaps.argmax()]
    eye = floor.at(9.0 * np.array([np.cos(angle), np.sin(angle)])) + 5.0 * floor.up
    pose = look_at(eye, floor.origin + 0.8 * floor.up, floor.up)
    behind = (rig.centres - eye) @ pose[:3, 2] > np.linalg.norm(floor.origin - eye) - 0.5
    rays = np.concatenate([points, floor.origin[None], rig.centres[behind]]) - eye
    plane = rays @ pose[:3, :2] / (rays @ pose[:3, 2:3])
    low, high = plane.min(axis=0), plane.max(axis=0)
    focal = 0.88 * (np.array(size) / np.maximum(high - low, 0.05)).min()
    middle = np.array(size) / 2 - focal * (low + high) / 2
    K = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    return Camera("free", K, pose, size)
