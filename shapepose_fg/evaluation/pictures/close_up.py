"""People as a camera sees them from near: true bodies in grey, what was found as skeletons, and what is wrong."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.viz.rendering import render_depth, zoom
from shapepose_fg.viz.viewer.drawing import draw_skeletons, light_on, over
from shapepose_fg.viz.viewer.figures import Mesh, framed
from shapepose_fg.viz.viewer.floor import Floor, floor_picture
from shapepose_fg.viz.viewer.palette import rgb

Array = NDArray[np.float64]

MISSING, WRONG, ODD = "#e8871e", "#2f6fd0", "#8a3fb0"
"""Circles as in the paper's figure: orange for missing joints, blue for wrong ones, purple for abnormal poses."""
_OWN, _OTHERS = np.array([0.66, 0.66, 0.67]), np.array([0.86, 0.86, 0.855])
_SMALL_PX = 240
"""Width of the picture in which it is counted who is seen."""


@dataclass(frozen=True)
class Circle:
    """Something that is wrong."""

    at: Array
    """(3,) where, metres in the world."""
    colour: str
    """One of the three."""


def greyed(bodies: NDArray[np.floating], faces: NDArray[np.integer], people: Sequence[int]) -> Mesh:
    """All true bodies (P, Nv, 3), those of `people` darker than the others'."""
    colours = np.tile(_OTHERS, (len(bodies), 1))
    colours[list(people)] = _OWN
    return Mesh.of(bodies, faces, colours)


def clear_views(
    rig: Rig, bodies: NDArray[np.floating], faces: NDArray[np.integer], people: Sequence[int]
) -> tuple[int, int]:
    """The view that shows most of some people, and of those from across (60 degrees and more) the next."""
    mesh = Mesh.of(bodies, faces, np.zeros((len(bodies), 3)))
    area_m2 = np.zeros(len(rig))
    for view, camera in enumerate(rig.cameras):
        small = zoom(camera, (0, 0, *camera.image_size), _SMALL_PX)
        surface = render_depth(mesh.vertices, mesh.faces, small, cull_back=True)
        own = (surface.face >= 0) & np.isin(surface.face // len(faces), people)
        area_m2[view] = (surface.depth[own].astype(np.float64) ** 2).sum() / small.K[0, 0] ** 2
    first = int(area_m2.argmax())
    axes = rig.cTw[:, 2, :3]
    across = np.abs(axes @ axes[first]) < 0.5
    return first, int(np.where(across, area_m2, -1.0).argmax())


def draw_close_up(
    axes: Any,
    camera: Camera,
    size: tuple[int, int],
    ghosts: Mesh,
    floor: Floor,
    joints: Array,
    colours: Sequence[str],
    *,
    focus: Array,
    circles: tuple[Circle, ...] = (),
    candidates: Array | None = None,
) -> None:
    """Draw people's `joints` (N, 25, 3) over the true bodies, enlarged on the points `focus` (K, 3).

    `candidates` (D, 2) are what the detector saw in this view, undistorted pixels.
    """
    window = framed(camera, focus[np.isfinite(focus).all(axis=1)], size)
    light = light_on(window, floor)
    picture = floor_picture(floor, window, ghosts.vertices, ghosts.faces, light)
    axes.imshow(over(picture, ghosts, window, light, 1.0), interpolation="none")
    if candidates is not None:
        scale = window.K[0, 0] / camera.K[0, 0]
        xy = scale * (candidates - camera.K[:2, 2]) + window.K[:2, 2]
        axes.scatter(*xy.T, s=5, color="#2b2d33", linewidths=0, zorder=2)
    if len(joints) > 0:
        draw_skeletons(axes, window, joints, np.array([rgb(each) for each in colours]) / 0.55, width=1.8)
    for circle in circles:
        xy, _ = window.project(circle.at[None])
        axes.scatter(*xy.T, s=110, facecolors="none", edgecolors=circle.colour, linewidths=1.8, zorder=5)
