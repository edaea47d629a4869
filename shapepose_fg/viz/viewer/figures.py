"""Who is drawn, in which colour, and from where."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.drawing import PALETTE, rgb
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.viz.rendering import look_at, render_depth, zoom
from shapepose_fg.viz.viewer.floor import Floor

if TYPE_CHECKING:
    from shapepose_fg.body.model.body_model import BodyModel

Array = NDArray[np.float64]

_SOLE_M = 0.015
"""How far the lowest keypoint of a foot is above its sole, metres."""
_CLAY = np.array([0.74, 0.74, 0.75])


@dataclass(frozen=True)
class Mesh:
    """Bodies as one coloured mesh."""

    vertices: Array
    """(M, 3) metres in the world."""
    faces: NDArray[np.integer]
    """(F, 3)."""
    colours: Array
    """(M, 3) one per vertex, 0..1."""

    @classmethod
    def of(cls, bodies: NDArray[np.floating], faces: NDArray[np.integer], colours: Array) -> "Mesh":
        """Bodies (P, Nv, 3) that share `faces` (F, 3), with a colour each (P, 3)."""
        people, count = bodies.shape[:2]
        all_faces = (faces[None] + count * np.arange(people)[:, None, None]).reshape(-1, 3)
        return cls(bodies.reshape(-1, 3).astype(np.float64), all_faces, np.repeat(colours, count, axis=0))

    @classmethod
    def clay(cls, bodies: NDArray[np.floating] | None, faces: NDArray[np.integer]) -> "Mesh":
        """Grey bodies (P, Nv, 3); an empty mesh for None."""
        bodies = np.zeros((0, 0, 3)) if bodies is None else bodies
        return cls.of(bodies, faces, np.tile(_CLAY, (len(bodies), 1)))


@dataclass(frozen=True)
class Figures:
    """The people of one frame, ready to be drawn."""

    joints: Array
    """(N, 25, 3) BODY_25, metres; NaN where unknown."""
    has_body: NDArray[np.bool_]
    """(N,) whether `mesh` holds the person."""
    colours: Array
    """(N, 3) one per person, 0..1."""
    labels: tuple[str, ...]
    """(N,) names for the legend."""
    mesh: Mesh
    """The bodies of those who have one."""

    @classmethod
    def of(cls, people: Reconstruction, body: "BodyModel") -> "Figures":
        """The rows of one frame, coloured in the order of their identities."""
        people = people.rows(np.argsort(people.person, kind="stable"))
        colours = np.array([rgb(PALETTE[index % len(PALETTE)]) for index in range(len(people))]).reshape(-1, 3)
        names = ("betas", "global_orient", "body_pose", "transl")
        has_body = people.status == str(Status.OK)
        for name in names:
            known = np.isfinite(getattr(people, name))
            has_body = has_body & known.all(axis=tuple(range(1, known.ndim)))
        bodies = _bodies(body, *(getattr(people, name)[has_body] for name in names))
        names_there = people.joint_names.tolist()
        return cls(
            joints=people.joints[:, [names_there.index(name) for name in BODY_25.joints]],
            has_body=has_body,
            colours=colours,
            labels=tuple(f"person {person}" for person in people.person),
            mesh=Mesh.of(bodies, body.faces, colours[has_body]),
        )

    @property
    def points(self) -> Array:
        """(K, 3) all that is known of where people are."""
        points = np.concatenate([self.joints.reshape(-1, 3), self.mesh.vertices])
        return points[np.isfinite(points).all(axis=1)]


def _bodies(body: "BodyModel", *parameters: Array) -> Array:
    """Surfaces (P, Nv, 3) of P bodies from betas, global_orient, body_pose and transl."""
    import torch

    from shapepose_fg.body.model.body_model import BodyParameters

    if len(parameters[0]) == 0:
        return np.zeros((0, body.num_vertices, 3))
    with torch.no_grad():
        tensors = (torch.from_numpy(value).to(body.dtype) for value in parameters)
        return body.vertices(BodyParameters(*tensors)).numpy().astype(np.float64)


def floor_under(rig: Rig, figures: Figures, ghosts: Mesh) -> Floor:
    """The floor under the true soles where they are known, else under most people's lowest joints."""
    up = rig.up_vector
    points = np.concatenate([figures.points, ghosts.vertices])
    lowest = np.where(np.isfinite(figures.joints).all(axis=-1), figures.joints @ up, np.inf).min(axis=1)
    lowest = lowest[np.isfinite(lowest)] - _SOLE_M
    # The median: one foot fitted through the floor does not lower it for everybody.
    heights = [(ghosts.vertices @ up).min()] if len(ghosts.vertices) else lowest
    height = float(np.median(heights)) if len(heights) else 0.0
    floor = Floor.under(points, up, height, radius_m=1.0)
    reach = np.linalg.norm(floor.coordinates(rig.centres), axis=1).max()
    return replace(floor, radius_m=float(np.clip(1.05 * reach, 3.6, 10.0)))


def two_views(rig: Rig, mesh: Mesh) -> tuple[int, int]:
    """The view in which bodies cover each other least, and one that looks from across, about 90 degrees."""
    if len(mesh.vertices) == 0:
        return 0, len(rig) // 2
    area_m2 = np.zeros(len(rig))
    for view, camera in enumerate(rig.cameras):
        small = zoom(camera, (0, 0, *camera.image_size), 240)
        depth = render_depth(mesh.vertices, mesh.faces, small, cull_back=True).depth
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
