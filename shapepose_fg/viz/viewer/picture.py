"""A picture of one frame: the people found, with bodies, over two views and in 3D."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.drawing import colour_of
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.io.footage.footage import Picture
from shapepose_fg.io.footage.placement import Placement, PlacementKind
from shapepose_fg.viz.bodies import joined, surfaces
from shapepose_fg.viz.overlay.drawing import PictureView, Skeletons, draw_label, draw_skeletons, write_picture
from shapepose_fg.viz.rendering import look_at, render_depth, render_shaded, zoom
from shapepose_fg.viz.viewer.floor import Floor, floor_picture

_WIDE, _GAP, _HEADER = 1800, 14, 60
"""Width of the picture, space between its panels and above them, pixels."""
_LEFT = 780
"""Width of the views on the left."""
_SOLE_M = 0.015
"""How far the lowest keypoint of a foot is above its sole, metres."""
_CLAY = (0.74, 0.74, 0.75)
_INK, _QUIET, _DOT = (51, 45, 43), (132, 125, 123), (40, 40, 40)


@dataclass(frozen=True)
class _Mesh:
    """Bodies as one coloured mesh."""

    vertices: Array
    """(M, 3) metres in the world."""
    faces: Index
    """(F, 3)."""
    colours: Array
    """(M, 3) one per vertex, red, green, blue, 0..1."""

    @classmethod
    def of(cls, bodies: Array, faces: NDArray[np.integer], colours: Array) -> "_Mesh":
        """Bodies (P, Nv, 3) with a colour each (P, 3)."""
        return cls(*joined(bodies, faces), np.repeat(colours, bodies.shape[1], axis=0))


def demo_picture(
    path: Path,
    rig: Rig,
    reconstruction: Reconstruction,
    frame: int,
    detections: Detections | None = None,
    truth: NDArray[np.floating] | None = None,
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
    colours = np.array([colour_of(person) for person in people.person.tolist()]).reshape(-1, 3)
    found = _Mesh.of(bodies, body.faces, colours[rows])
    truth = np.zeros((0, body.num_vertices, 3)) if truth is None else np.asarray(truth, dtype=np.float64)
    true = _Mesh.of(truth, body.faces, np.tile(_CLAY, (len(truth), 1)))
    points = np.concatenate([people.joints.reshape(-1, 3), found.vertices, true.vertices])
    points = points[np.isfinite(points).all(axis=1)]
    floor = floor_under(rig, people.joints, truth, points)

    short = round(_LEFT * 9 / 16)
    tall, across = 2 * short + _GAP, _WIDE - _LEFT - 3 * _GAP
    page = np.full((_HEADER + tall + _GAP, _WIDE, 3), 255, dtype=np.uint8)
    views = two_views(rig, found.vertices, found.faces)
    for place, view in enumerate(views):
        window = framed(rig.cameras[view], points, (_LEFT, short))
        casting = true if len(true.vertices) else found
        panel = _shaded(window, floor, casting, [(true, 1.0), (found, 0.72)])
        if detections is not None:
            _draw_dots(panel, window, rig.cameras[view], detections.xy[detections.view == view])
        _draw_people(panel, window, people, np.arange(len(people)))
        _place(page, panel, rig.names[view], (_GAP, _HEADER + place * (short + _GAP)))
    camera = free_viewpoint(rig, points, floor, (across, tall))
    panel = _shaded(camera, floor, found, [(found, 1.0)])
    _draw_people(panel, camera, people, np.setdiff1d(np.arange(len(people)), rows))
    for view, other in enumerate(rig.cameras):
        _draw_frustum(panel, camera, other, floor, _INK if view in views else _QUIET)
    _place(page, panel, "3D", (_LEFT + 2 * _GAP, _HEADER))
    signs = ["dots: 2D candidates"] * (detections is not None) + ["grey: the true people"] * (len(truth) > 0)
    count = f"{len(people)} {'person' if len(people) == 1 else 'people'}, {len(rig)} cameras, frame {frame}"
    _write(page, "Every person in 3D", (_GAP, 40), 0.95, _INK, 2)
    _write(page, "; ".join([count, *signs]), (_LEFT + 2 * _GAP, 40), 0.6, _QUIET, 1)
    write_picture(path, page)


def _shaded(camera: Camera, floor: Floor, casting: _Mesh, drawn: list[tuple[_Mesh, float]]) -> Picture:
    """The floor with the shadow of `casting`, and over it meshes, each with its opacity."""
    right, toward = camera.wTc[:3, 0], -camera.wTc[:3, 2]
    toward = toward - floor.up * (toward @ floor.up)
    # From above, over the viewer's left shoulder.
    light = 1.5 * floor.up - 0.55 * right + 0.75 * toward / max(float(np.linalg.norm(toward)), 1e-9)
    light /= np.linalg.norm(light)
    picture = floor_picture(floor, camera, casting.vertices, casting.faces, light)
    for mesh, opacity in drawn:
        rgb, coverage = render_shaded(mesh.vertices, mesh.faces, mesh.colours, camera, light)
        picture = picture * (1.0 - opacity * coverage[..., None]) + opacity * rgb
    return np.ascontiguousarray(np.rint(255 * np.clip(picture[..., ::-1], 0, 1)).astype(np.uint8))


def _draw_people(panel: Picture, camera: Camera, people: Reconstruction, rows: Index) -> None:
    """The skeletons of some rows, with who they are."""
    placement = Placement(PlacementKind.SAME, camera.image_size, camera.image_size)
    view = PictureView(camera, placement, camera.image_size)
    draw_skeletons(panel, view, Skeletons.of(people.rows(rows)))


def _draw_dots(panel: Picture, window: Camera, camera: Camera, xy: Array) -> None:
    """Detections of `camera` at its pixels `xy` (D, 2), in its enlarged window."""
    scale = window.K[0, 0] / camera.K[0, 0]
    shift = window.K[:2, 2] + 0.5 - scale * (camera.K[:2, 2] + 0.5)
    for x, y in np.rint(16 * (scale * (xy + 0.5) + shift - 0.5)).astype(int).tolist():
        cv2.circle(panel, (x, y), 28, _DOT, -1, cv2.LINE_AA, 4)


def _draw_frustum(
    panel: Picture, camera: Camera, other: Camera, floor: Floor, colour: tuple[int, int, int]
) -> None:
    """A small pyramid where a camera is, its name, and a thread down to the floor."""
    width, height = other.image_size
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]])
    rays = corners @ np.linalg.inv(other.K).T @ other.wTc[:3, :3].T
    foot = floor.at(floor.coordinates(other.centre))
    xy, _ = camera.project(np.concatenate([other.centre[None], other.centre + 0.34 * rays, foot[None]]))
    inside = (xy[0] > 0) & (xy[0] < camera.image_size)  # NaN behind the eye compares false
    if not inside.all() or not np.isfinite(xy).all():
        return
    fine = np.rint(16 * np.clip(xy, -3e4, 3e4)).astype(np.int32)
    sides = [fine[[0, corner]] for corner in range(1, 5)]
    cv2.polylines(panel, [*sides, fine[[1, 2, 3, 4, 1]]], False, colour, 1, cv2.LINE_AA, 4)
    cv2.polylines(panel, [fine[[0, 5]]], False, (205, 203, 202), 1, cv2.LINE_AA, 4)
    _write(panel, other.name, (round(xy[:5, 0].mean()) - 18, round(xy[:5, 1].min()) - 8), 0.45, colour, 1)


def _place(page: Picture, panel: Picture, name: str, at: tuple[int, int]) -> None:
    """Put a panel with its name on the page, its left upper corner `at`."""
    draw_label(panel, name, (0, 0), (255, 255, 255), centred=False)
    height, width = panel.shape[:2]
    page[at[1] : at[1] + height, at[0] : at[0] + width] = panel
    cv2.rectangle(page, (at[0] - 1, at[1] - 1), (at[0] + width, at[1] + height), (212, 216, 217), 1)


def _write(
    picture: Picture, text: str, at: tuple[int, int], size: float, colour: tuple[int, int, int], thick: int
) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, thick, cv2.LINE_AA)


def floor_under(rig: Rig, joints: Array, truth: Array, points: Array) -> Floor:
    """The floor around `points` (K, 3): under the true soles (P, Nv, 3) where they are known, else under most
    people's lowest `joints` (N, J, 3).
    """
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
        depth = render_depth(vertices, faces, small, cull_back=True).depth
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
