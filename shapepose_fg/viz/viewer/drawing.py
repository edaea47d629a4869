"""What pictures of people are drawn with: panels, names, shaded bodies, skeletons."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Camera
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.viz.rendering import render_shaded
from shapepose_fg.viz.viewer.figures import Mesh
from shapepose_fg.viz.viewer.floor import Floor

Array = NDArray[np.float64]

INK, QUIET, _EDGE = "#2b2d33", "#7b7d84", "#d9d8d4"
_DRAWN = np.array([limb for limb in BODY_25.limbs if limb not in ((2, 17), (5, 18))])
"""The limbs of a drawing: without the detector's links from shoulders to ears."""


def over(picture: Array, mesh: Mesh, camera: Camera, light: Array, opacity: float) -> Array:
    """`picture` (H, W, 3) with shaded bodies over it."""
    rgb, coverage = render_shaded(mesh.vertices, mesh.faces, mesh.colours, camera, light=light)
    return picture * (1.0 - opacity * coverage[..., None]) + opacity * rgb


def light_on(camera: Camera, floor: Floor) -> Array:
    """From above, over the viewer's left shoulder."""
    right, toward = camera.wTc[:3, 0], -camera.wTc[:3, 2]
    toward = toward - floor.up * (toward @ floor.up)
    light = 1.5 * floor.up - 0.55 * right + 0.75 * toward / max(float(np.linalg.norm(toward)), 1e-9)
    return light / np.linalg.norm(light)


def draw_skeletons(axes: Any, camera: Camera, joints: Array, colours: Array, *, width: float) -> None:
    """Limbs and joints that are known, in a darker shade of each person's colour with a light rim."""
    from matplotlib.collections import LineCollection

    xy, _ = camera.project(joints)
    for points, colour in zip(xy, 0.55 * colours, strict=True):
        segments = points[_DRAWN]
        segments = segments[np.isfinite(segments).all(axis=(1, 2))]
        for line, paint in ((width + 1.6, (1, 1, 1, 0.75)), (width, tuple(colour))):
            axes.add_collection(LineCollection(segments, colors=[paint], linewidths=line, capstyle="round"))
        known = points[np.isfinite(points).all(axis=1)]
        axes.scatter(*known.T, s=9, color=[tuple(colour)], edgecolors="white", linewidths=0.5, zorder=3)


def panel(page: Any, box: tuple[int, int, int, int], size: tuple[int, int]) -> Any:
    """Axes over `box` (left, top, width, height) px of the page, whose units are pixels too."""
    left, top, across, down = box
    width, height = size
    axes = page.add_axes((left / width, 1 - (top + down) / height, across / width, down / height))
    axes.set(xlim=(-0.5, across - 0.5), ylim=(down - 0.5, -0.5), xticks=[], yticks=[], autoscale_on=False)
    for spine in axes.spines.values():
        spine.set(color=_EDGE, linewidth=0.8)
    return axes


def tag(axes: Any, text: str) -> None:
    """A name in the upper left corner of a panel."""
    axes.annotate(
        text,
        (0, 1),
        xycoords="axes fraction",
        xytext=(9, -9),
        textcoords="offset points",
        va="top",
        color=INK,
        fontsize=9.5,
        fontweight="bold",
        zorder=6,
        bbox={"boxstyle": "round,pad=0.35", "facecolor": "white", "edgecolor": "none", "alpha": 0.85},
    )
