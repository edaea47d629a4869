"""A picture of one frame: the people found, with bodies, over two views and in 3D."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.viz.viewer.drawing import INK, QUIET, draw_skeletons, light_on, over, panel, tag
from shapepose_fg.viz.viewer.figures import Figures, Mesh, floor_under, framed, free_viewpoint, two_views
from shapepose_fg.viz.viewer.floor import Floor, floor_picture

if TYPE_CHECKING:
    from shapepose_fg.body.model.body_model import BodyModel

Array = NDArray[np.float64]

_GAP, _HEADER, _FOOTER = 14, 92, 14
"""Space between panels, above and below them, pixels."""


def demo_picture(
    path: str | Path,
    rig: Rig,
    reconstruction: Reconstruction,
    frame: int,
    *,
    detections: Detections | None = None,
    truth: NDArray[np.floating] | None = None,
    body: "BodyModel | None" = None,
    views: tuple[int, int] | None = None,
    title: str = "Every person in 3D",
    width_px: int = 1800,
) -> None:
    """Write a PNG of the people of `frame`: over two views on the left, from a free viewpoint on the right.

    `detections` of that frame are drawn as dots; `truth` (P, Nv, 3), the true surfaces where they are known,
    as grey figures. `body` is the model that was fitted (default: the shipped one), `views` the two cameras
    (default: the one that sees people least covered, and one across from it). Who has no body is drawn as a
    skeleton. InputError where matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError("the picture needs matplotlib: pip install shapepose-fg[viewer]") from None
    body = _default_body() if body is None else body
    figures, ghosts = Figures.of(reconstruction.at(frame), body), Mesh.clay(truth, body.faces)
    floor = floor_under(rig, figures, ghosts)
    views = two_views(rig, figures.mesh) if views is None else views

    left = round(0.44 * width_px) - _GAP
    short = round(left * 9 / 16)
    right, tall = width_px - left - 3 * _GAP, 2 * short + _GAP
    size = width_px, tall + _HEADER + _FOOTER
    page = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100, facecolor="white")
    for place, view in enumerate(views):
        axes = panel(page, (_GAP, _HEADER + place * (short + _GAP), left, short), size)
        seen = None if detections is None else detections.xy[detections.view == view]
        _draw_view(axes, rig.cameras[view], (left, short), figures, ghosts, floor, seen)
    axes = panel(page, (left + 2 * _GAP, _HEADER, right, tall), size)
    _draw_room(axes, rig, views, (right, tall), figures, floor)
    people = len(figures.labels)
    count = f"{people} {'person' if people == 1 else 'people'} · {len(rig)} cameras · frame {frame}"
    _draw_header(page, size, figures, (title, count), dots=detections is not None, grey=truth is not None)
    page.savefig(path, dpi=100)


def _default_body() -> "BodyModel":
    from shapepose_fg.body.model.body_model import BodyModel

    return BodyModel.default()


def _draw_view(
    axes: Any,
    camera: Camera,
    size: tuple[int, int],
    figures: Figures,
    ghosts: Mesh,
    floor: Floor,
    candidates: Array | None,
) -> None:
    """What a camera sees: the room, the true people in grey where they are known, over them what was found."""
    window = framed(camera, np.concatenate([figures.points, ghosts.vertices]), size)
    light = light_on(window, floor)
    casting = ghosts if len(ghosts.vertices) else figures.mesh
    picture = floor_picture(floor, window, casting.vertices, casting.faces, light)
    picture = over(picture, ghosts, window, light, 1.0)
    axes.imshow(over(picture, figures.mesh, window, light, 0.72), interpolation="none")
    draw_skeletons(axes, window, figures.joints, figures.colours, width=1.5)
    if candidates is not None:
        scale = window.K[0, 0] / camera.K[0, 0]
        shift = window.K[:2, 2] + 0.5 - scale * (camera.K[:2, 2] + 0.5)
        axes.scatter(*(scale * (candidates + 0.5) + shift - 0.5).T, s=5, color=INK, linewidths=0, zorder=4)
    tag(axes, camera.name)


def _draw_room(
    axes: Any, rig: Rig, views: tuple[int, int], size: tuple[int, int], figures: Figures, floor: Floor
) -> None:
    """The bodies on the floor from a free viewpoint, with the cameras around them."""
    camera = free_viewpoint(rig, figures.points, floor, size)
    light = light_on(camera, floor)
    picture = floor_picture(floor, camera, figures.mesh.vertices, figures.mesh.faces, light)
    axes.imshow(over(picture, figures.mesh, camera, light, 1.0), interpolation="none")
    bare = ~figures.has_body
    draw_skeletons(axes, camera, figures.joints[bare], figures.colours[bare], width=2.2)
    for view, other in enumerate(rig.cameras):
        _draw_frustum(axes, camera, other, floor, strong=view in views)
    tag(axes, "3D")


def _draw_frustum(axes: Any, camera: Camera, other: Camera, floor: Floor, *, strong: bool) -> None:
    """A small pyramid where a camera is, its name, and a thread down to the floor."""
    width, height = other.image_size
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]])
    rays = corners @ np.linalg.inv(other.K).T @ other.wTc[:3, :3].T
    foot = floor.at(floor.coordinates(other.centre))
    xy, _ = camera.project(np.concatenate([other.centre[None], other.centre + 0.34 * rays, foot[None]]))
    inside = (xy[0] > 0) & (xy[0] < camera.image_size)  # NaN behind the eye compares false
    if not inside.all() or not np.isfinite(xy).all():
        return
    colour, width_pt = (INK, 1.1) if strong else (QUIET, 0.8)
    for corner in xy[1:5]:
        axes.plot(*np.stack([xy[0], corner]).T, color=colour, lw=width_pt, solid_capstyle="round")
    axes.fill(*xy[1:5].T, facecolor=colour, alpha=0.12, lw=0)
    axes.plot(*np.concatenate([xy[1:5], xy[1:2]]).T, color=colour, lw=width_pt, solid_joinstyle="round")
    axes.plot(*xy[[0, 5]].T, color=QUIET, lw=0.6, ls=(0, (2, 3)))
    axes.annotate(
        other.name,
        (xy[:5, 0].mean(), xy[:5, 1].min()),
        xytext=(0, 5),
        textcoords="offset points",
        ha="center",
        color=colour,
        fontsize=8.5,
        fontweight="bold" if strong else "normal",
    )


def _draw_header(
    page: Any, size: tuple[int, int], figures: Figures, texts: tuple[str, str], *, dots: bool, grey: bool
) -> None:
    """Title, people and signs above the panels."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    width, height = size
    top = 1 - 22 / height
    page.text(_GAP / width, top, texts[0], va="center", fontsize=16, fontweight="bold", color=INK)
    page.text(1 - _GAP / width, top, texts[1], va="center", ha="right", fontsize=11, color=QUIET)
    people = zip(figures.colours, figures.labels, strict=True)
    handles: list[Any] = [Patch(facecolor=tuple(colour), label=label) for colour, label in people]
    handles.append(Line2D([], [], color=INK, lw=1.5, marker="o", ms=3.5, label="skeleton"))
    if dots:
        handles.append(Line2D([], [], color=INK, lw=0, marker="o", ms=2.6, label="2D candidates"))
    if grey:
        handles.append(Patch(facecolor="#bdbdbf", label="true people"))
    page.legend(
        handles=handles,
        loc="center left",
        bbox_to_anchor=((_GAP - 8) / width, 1 - 62 / height),
        ncols=min(len(handles), 12),
        frameon=False,
        labelcolor=INK,
        fontsize=10.5,
        handlelength=1.2,
        handleheight=0.9,
        handletextpad=0.55,
        columnspacing=1.7,
    )
