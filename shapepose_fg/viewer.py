"""A picture of one frame: the people found, with bodies, over two views and in 3D."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.camera import Camera, Rig
from shapepose_fg.detections import Detections
from shapepose_fg.errors import InputError
from shapepose_fg.floor import Floor, floor_picture
from shapepose_fg.reconstruction import Reconstruction, Status
from shapepose_fg.rendering import look_at, render_depth, render_shaded, zoom
from shapepose_fg.skeleton import BODY_25

if TYPE_CHECKING:
    from shapepose_fg.body.model import BodyModel

Array = NDArray[np.float64]

PALETTE = ("#3f7fb8", "#e0962f", "#2f9e80", "#c06c9c", "#6cb6dd", "#c8623f", "#7d70b8", "#a8a03c")
"""One colour per person, after Okabe and Ito's: apart for every kind of colour vision."""
_INK, _QUIET = "#2b2d33", "#7b7d84"
_CLAY = np.array([0.74, 0.74, 0.75])
_GAP = 14
_HEADER, _FOOTER = 92, 14


@dataclass(frozen=True)
class Figures:
    """The people of one frame, ready to be drawn."""

    joints: Array
    """(N, 25, 3) metres; NaN where unknown."""
    colours: Array
    """(N, 3) one per person, 0..1."""
    labels: tuple[str, ...]
    """(N,) names for the legend."""
    vertices: Array
    """(M, 3) of all bodies together."""
    faces: NDArray[np.integer]
    """(F, 3)."""
    vertex_colours: Array
    """(M, 3)."""


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
    """Write a PNG of the people of `frame`: over two views on the left, and from a free viewpoint on the right.

    `detections` of that frame are drawn as dots; `truth` (P, Nv, 3), the true surfaces where they are known, as
    grey figures. `body` is the model that was fitted (default: the shipped one), `views` the two cameras (default:
    the one that sees people least covered, and one across from it). Who has no body is drawn as a skeleton.
    InputError where matplotlib is missing.
    """
    try:
        import matplotlib

        matplotlib.use("Agg", force=False)
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError("the picture needs matplotlib: pip install shapepose-fg[viewer]") from None
    model = _default_body() if body is None else body
    figures = _figures(reconstruction.at(frame), model)
    ghosts = _ghosts(truth, model)
    floor = _floor(rig, figures, ghosts[0])
    views = _two_views(rig, figures) if views is None else views

    left = round(0.44 * width_px) - _GAP
    panel_height = round(left * 9 / 16)
    right, tall = width_px - left - 3 * _GAP, 2 * panel_height + _GAP
    total = tall + _HEADER + _FOOTER
    page = Figure(figsize=(width_px / 100, total / 100), dpi=100, facecolor="white")
    for place, view in enumerate(views):
        box = (_GAP, _HEADER + place * (panel_height + _GAP), left, panel_height)
        camera = _framed(rig.cameras[view], figures, left, panel_height)
        axes = _axes(page, box, width_px, total)
        axes.imshow(_view_picture(camera, figures, ghosts, floor), interpolation="none")
        shown = None if detections is None else detections.xy[detections.view == view]
        _draw_dots(axes, rig.cameras[view], camera, shown)
        _draw_skeletons(axes, camera, figures, width=1.5)
        _tag(axes, rig.cameras[view].name)
    axes = _axes(page, (left + 2 * _GAP, _HEADER, right, tall), width_px, total)
    _draw_room(axes, rig, views, figures, floor, (right, tall))
    _header(
        page,
        figures,
        title,
        _count(figures, rig, frame),
        truth is not None,
        detections is not None,
        width_px,
        total,
    )
    page.savefig(path, dpi=100)


def _figures(people: Reconstruction, model: "BodyModel") -> Figures:
    """The rows of one frame with their meshes, coloured in the order of their identities."""
    import torch

    from shapepose_fg.body.model import BodyParameters

    people = people.rows(np.argsort(people.person, kind="stable"))
    hexes = [PALETTE[index % len(PALETTE)] for index in range(len(people))]
    colours = np.array([_rgb(text) for text in hexes]).reshape(-1, 3)
    columns = {name: getattr(people, name) for name in ("betas", "global_orient", "body_pose", "transl")}
    has_body = np.array([status == Status.OK for status in people.status], dtype=bool)
    for value in columns.values():
        has_body &= np.isfinite(value.reshape(len(people), -1)).all(axis=1)
    tensors = {name: torch.from_numpy(value[has_body]).to(model.dtype) for name, value in columns.items()}
    count = int(has_body.sum())
    with torch.no_grad():
        meshes = (
            model.vertices(BodyParameters(**tensors)).numpy() if count else np.zeros((0, model.num_vertices, 3))
        )
    order = [people.joint_names.tolist().index(name) for name in BODY_25.joints]
    return Figures(
        joints=people.joints[:, order],
        colours=colours,
        labels=tuple(f"person {person}" for person in people.person),
        vertices=meshes.reshape(-1, 3).astype(np.float64),
        faces=_repeat(model.faces, count, model.num_vertices),
        vertex_colours=np.repeat(colours[has_body], model.num_vertices, axis=0),
    )


def _ghosts(truth: NDArray[np.floating] | None, model: "BodyModel") -> tuple[Array, NDArray[np.integer]]:
    """The true surfaces as one mesh; nobody where they are not known."""
    if truth is None:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.intp)
    return truth.reshape(-1, 3).astype(np.float64), _repeat(model.faces, len(truth), truth.shape[1])


def _floor(rig: Rig, figures: Figures, ghosts: Array) -> Floor:
    """The floor under the lowest point of anybody, which for a body is a sole."""
    points = np.concatenate([figures.joints.reshape(-1, 3), figures.vertices, ghosts])
    points = points[np.isfinite(points).all(axis=1)]
    height = (points @ rig.up_vector).min() if len(points) else 0.0
    return Floor.under(points, rig.up_vector, float(height), radius_m=3.6)


def _two_views(rig: Rig, figures: Figures) -> tuple[int, int]:
    """The view in which bodies cover each other least, and one that looks from across, about 90 degrees."""
    if len(figures.vertices) == 0:
        return 0, len(rig) // 2
    area_m2 = np.zeros(len(rig))
    for view, camera in enumerate(rig.cameras):
        small = zoom(camera, (0, 0, *camera.image_size), 240)
        depth = render_depth(figures.vertices, figures.faces, small, cull_back=True).depth
        area_m2[view] = (depth[np.isfinite(depth)] ** 2).sum() / small.K[0, 0] ** 2
    first = int(area_m2.argmax())
    axes = rig.cTw[:, 2, :3]
    across = 1.0 - np.abs(axes @ axes[first])
    across[first] = -1.0
    return first, int((across * area_m2).argmax())


def _framed(camera: Camera, figures: Figures, width: int, height: int) -> Camera:
    """`camera` enlarged on the people, with some room around them, in the shape of its panel."""
    image = np.array(camera.image_size, dtype=np.float64)
    points = np.concatenate([figures.joints.reshape(-1, 3), figures.vertices])
    xy, _ = camera.project(points)
    xy = xy[np.isfinite(xy).all(axis=1)]
    low, high = (xy.min(axis=0), xy.max(axis=0)) if len(xy) else (np.zeros(2), image)
    low, high = np.maximum(low, 0.0), np.minimum(high, image)
    shape = np.array([width, height]) / height
    tall = max(((high - low) / shape).max() * 1.16, 0.3 * image[1])
    tall = min(tall, (image / shape).min())
    middle = np.clip((low + high) / 2, shape * tall / 2, image - shape * tall / 2)
    corner = middle - shape * tall / 2
    return zoom(camera, (*corner, *(corner + shape * tall)), width)


def _view_picture(
    camera: Camera, figures: Figures, ghosts: tuple[Array, NDArray[np.integer]], floor: Floor
) -> Array:
    """What a camera sees: the room, the true people in grey where they are known, over them the bodies found."""
    light = _light(camera, floor)
    known = ghosts if len(ghosts[0]) else (figures.vertices, figures.faces)
    picture = floor_picture(floor, camera, *known, light)
    clay = np.tile(_CLAY, (len(ghosts[0]), 1))
    picture = _over(picture, *render_shaded(*ghosts, clay, camera, light=light), 1.0)
    found = render_shaded(figures.vertices, figures.faces, figures.vertex_colours, camera, light=light)
    return _over(picture, *found, 0.72)


def _over(picture: Array, rgb: NDArray[np.floating], coverage: NDArray[np.floating], opacity: float) -> Array:
    return picture * (1.0 - opacity * coverage[..., None]) + opacity * rgb


def _light(camera: Camera, floor: Floor) -> Array:
    """From above, over the viewer's left shoulder."""
    right, toward = camera.wTc[:3, 0], -camera.wTc[:3, 2]
    toward = toward - floor.up * (toward @ floor.up)
    light = 1.5 * floor.up - 0.55 * right + 0.75 * toward / max(float(np.linalg.norm(toward)), 1e-9)
    return light / np.linalg.norm(light)


def _draw_room(
    axes: Any, rig: Rig, views: tuple[int, int], figures: Figures, floor: Floor, size: tuple[int, int]
) -> None:
    """The bodies on the floor from a free viewpoint, with the cameras around them."""
    camera = _free_viewpoint(rig, figures, floor, size)
    light = _light(camera, floor)
    picture = floor_picture(floor, camera, figures.vertices, figures.faces, light)
    bodies = render_shaded(figures.vertices, figures.faces, figures.vertex_colours, camera, light=light)
    axes.imshow(_over(picture, *bodies, 1.0), interpolation="none")
    bare = [
        index
        for index in range(len(figures.joints))
        if not (figures.vertex_colours == figures.colours[index]).all(1).any()
    ]
    _draw_skeletons(axes, camera, figures, width=2.2, only=bare)
    _tag(axes, "3D")
    for view, other in enumerate(rig.cameras):
        _draw_frustum(axes, camera, other, floor, strong=view in views)


def _free_viewpoint(rig: Rig, figures: Figures, floor: Floor, size: tuple[int, int]) -> Camera:
    """A long lens from above, in the widest gap between the cameras, that has people and far cameras in."""
    around = floor.coordinates(rig.centres)
    angles = np.sort(np.arctan2(around[:, 1], around[:, 0]))
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    angle = (angles + gaps / 2)[gaps.argmax()]
    eye = floor.at(9.0 * np.array([np.cos(angle), np.sin(angle)])) + 5.0 * floor.up
    pose = look_at(eye, floor.origin + 0.8 * floor.up, floor.up)
    points = np.concatenate([figures.joints.reshape(-1, 3), figures.vertices])
    points = np.concatenate([points[np.isfinite(points).all(axis=1)], floor.origin[None]])
    behind = (rig.centres - eye) @ pose[:3, 2] > np.linalg.norm(floor.origin - eye) - 0.5
    rays = np.concatenate([points, rig.centres[behind]]) - eye
    plane = rays @ pose[:3, :2] / (rays @ pose[:3, 2:3])
    low, high = plane.min(axis=0), plane.max(axis=0)
    focal = 0.88 * (np.array(size) / np.maximum(high - low, 0.05)).min()
    middle = np.array(size) / 2 - focal * (low + high) / 2
    K = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    return Camera("free", K, pose, size)


def _draw_frustum(axes: Any, camera: Camera, other: Camera, floor: Floor, *, strong: bool) -> None:
    """A small pyramid where a camera is, its name, and a thread down to the floor."""
    width, height = other.image_size
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]])
    rays = corners @ np.linalg.inv(other.K).T @ other.wTc[:3, :3].T
    base = other.centre + 0.34 * rays
    foot = floor.at(floor.coordinates(other.centre))
    xy, _ = camera.project(np.concatenate([other.centre[None], base, foot[None]]))
    inside = (xy[0] > 0) & (xy[0] < camera.image_size)  # NaN behind the eye compares false
    if not inside.all() or not np.isfinite(xy).all():
        return
    colour, width_pt = (_INK, 1.1) if strong else (_QUIET, 0.8)
    for corner in xy[1:5]:
        axes.plot(*np.stack([xy[0], corner]).T, color=colour, lw=width_pt, solid_capstyle="round")
    axes.fill(*xy[1:5].T, facecolor=colour, alpha=0.12, lw=0)
    axes.plot(*np.concatenate([xy[1:5], xy[1:2]]).T, color=colour, lw=width_pt, solid_joinstyle="round")
    axes.plot(*xy[[0, 5]].T, color=_QUIET, lw=0.6, ls=(0, (2, 3)))
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


def _draw_skeletons(
    axes: Any, camera: Camera, figures: Figures, *, width: float, only: list[int] | None = None
) -> None:
    """Limbs between known joints, and the joints, in a darker shade of each person's colour with a light rim."""
    from matplotlib.collections import LineCollection

    xy, _ = camera.project(figures.joints)
    for person in range(len(xy)) if only is None else only:
        segments = xy[person][np.array(_DRAWN)]
        segments = segments[np.isfinite(segments).all(axis=(1, 2))]
        dark = tuple(0.55 * figures.colours[person])
        axes.add_collection(
            LineCollection(segments, colors=[(1, 1, 1, 0.75)], linewidths=width + 1.6, capstyle="round")
        )
        axes.add_collection(LineCollection(segments, colors=[dark], linewidths=width, capstyle="round"))
        known = xy[person][np.isfinite(xy[person]).all(axis=1)]
        axes.scatter(*known.T, s=9, color=[dark], edgecolors="white", linewidths=0.5, zorder=3)


def _draw_dots(axes: Any, camera: Camera, framed: Camera, xy: Array | None) -> None:
    """The detector's candidates `xy` (D, 2), in pixels of the whole image."""
    if xy is None or len(xy) == 0:
        return
    scale = framed.K[0, 0] / camera.K[0, 0]
    shift = framed.K[:2, 2] + 0.5 - scale * (camera.K[:2, 2] + 0.5)
    axes.scatter(*(scale * (xy + 0.5) + shift - 0.5).T, s=5, color=_INK, linewidths=0, zorder=4)


def _axes(page: Any, box: tuple[int, int, int, int], width: int, height: int) -> Any:
    """Axes of `box` (left, top, width, height) px whose units are pixels."""
    left, top, across, down = box
    axes = page.add_axes((left / width, 1 - (top + down) / height, across / width, down / height))
    axes.set(xlim=(-0.5, across - 0.5), ylim=(down - 0.5, -0.5), xticks=[], yticks=[], autoscale_on=False)
    for spine in axes.spines.values():
        spine.set(color="#d9d8d4", linewidth=0.8)
    return axes


def _count(figures: Figures, rig: Rig, frame: int) -> str:
    """How many are seen by how many, and when."""
    people = len(figures.labels)
    return f"{people} {'person' if people == 1 else 'people'} · {len(rig)} cameras · frame {frame}"


def _tag(axes: Any, text: str) -> None:
    box = {"boxstyle": "round,pad=0.35", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    axes.annotate(
        text,
        (0, 1),
        xycoords="axes fraction",
        xytext=(10, -10),
        textcoords="offset points",
        va="top",
        color=_INK,
        fontsize=9.5,
        fontweight="bold",
        bbox=box,
    )


def _header(
    page: Any, figures: Figures, title: str, subtitle: str, truth: bool, dots: bool, width: int, height: int
) -> None:
    """Title, people and signs above the panels."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    page.text(_GAP / width, 1 - 22 / height, title, va="center", fontsize=16, fontweight="bold", color=_INK)
    page.text(1 - _GAP / width, 1 - 22 / height, subtitle, va="center", ha="right", fontsize=11, color=_QUIET)
    handles: list[Any] = [
        Patch(facecolor=tuple(c), label=label) for c, label in zip(figures.colours, figures.labels, strict=True)
    ]
    handles.append(Line2D([], [], color=_INK, lw=1.5, marker="o", ms=3.5, label="skeleton"))
    if dots:
        handles.append(Line2D([], [], color=_INK, lw=0, marker="o", ms=2.6, label="2D candidates"))
    if truth:
        handles.append(Patch(facecolor=tuple(_CLAY), label="true people"))
    legend = page.legend(
        handles=handles,
        loc="center left",
        bbox_to_anchor=((_GAP - 8) / width, 1 - 62 / height),
        ncols=len(handles),
        frameon=False,
        fontsize=10.5,
        handlelength=1.2,
        handleheight=0.9,
        handletextpad=0.55,
        columnspacing=1.7,
    )
    for text in legend.get_texts():
        text.set_color(_INK)


def _repeat(faces: NDArray[np.integer], count: int, vertices: int) -> NDArray[np.integer]:
    """The faces of `count` copies of a mesh, one after the other."""
    return (faces[None] + vertices * np.arange(count)[:, None, None]).reshape(-1, 3)


def _rgb(text: str) -> tuple[float, float, float]:
    red, green, blue = (int(text[at : at + 2], 16) / 255 for at in (1, 3, 5))
    return red, green, blue


def _default_body() -> "BodyModel":
    from shapepose_fg.body.model import BodyModel

    return BodyModel.default()


_DRAWN = tuple(limb for limb in BODY_25.limbs if limb not in ((2, 17), (5, 18)))
"""The limbs of a drawing: without the detector's links from shoulders to ears."""
