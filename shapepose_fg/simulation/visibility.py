"""Visibility of joints: the first surface on the rays to each joint, and the person it
belongs to.
"""

from collections.abc import Generator, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index, Mask, Real
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.drawing import thinned
from shapepose_fg.core.rendering import first_surface_at, scaled
from shapepose_fg.core.skeleton import BODY_25, SMPL_24
from shapepose_fg.pipeline.workers import workers as worker_processes

if TYPE_CHECKING:
    from shapepose_fg.body.model.body_model import BodyModel

NOBODY, ITSELF, BORDER = -1, -2, -3
"""Codes of `Visibility.hidden_by` without another person in front."""

_BONES = (
    "head neck+left_collar+right_collar right_shoulder+right_collar right_elbow right_wrist "
    "left_shoulder+left_collar left_elbow left_wrist pelvis right_hip right_knee right_ankle "
    "left_hip left_knee left_ankle head head head head left_foot left_foot left_ankle right_foot "
    "right_foot right_ankle"
).split()
"""Bones of each joint of BODY_25: SMPL's that begin there; for face, toes and heels the nearest. A
collar has hardly any skin and counts for the shoulder, so that the chest is adjacent to the
shoulder."""
FACE = tuple(BODY_25.index(name) for name in ("Nose", "REye", "LEye", "REar", "LEar"))
"""Joints of the face, which lie on the skin, not inside a limb."""

_RAYS = np.array(
    [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (0.7, 0.7), (-0.7, 0.7), (0.7, -0.7), (-0.7, -0.7)]
)
"""Directions of rays around a joint, in units of the probe's radius."""

FramePeople = tuple[Array, NDArray[np.float32]] | tuple[Array, NDArray[np.float32], Rig]
"""A frame: BODY_25 joints (P, 25, 3) and meshes (P, M, 3) of all people, metres; and the rig at
that time."""
AHEAD = 4
"""Number of frames per worker that are submitted ahead; each is little work."""
FRAMES_A_WORKER = 100
"""Minimum number of frames per worker; with fewer, starting it costs more than it saves."""


@dataclass(frozen=True)
class VisibilityConfig:
    """Settings of the depth buffer."""

    image_scale: float = 0.25
    """Resolution of the buffer, as a share of the image's."""
    cell_m: float = 0.04
    """Size of cells within which vertices of the surface are merged, m; 0 keeps all."""
    probe_m: float = 0.03
    """Radius around a joint in which rays are cast, m; 0 uses the ray to the joint only."""
    front_m: float = 0.02
    """Minimum distance, m, of a surface in front of a joint that occludes it; touching skin does
    not."""
    face_depth_m: float = 0.08
    """Depth behind the head's first surface, m, beyond which nose, eyes and ears are occluded,
    being on the other side."""


@dataclass(frozen=True)
class Visibility:
    """Visible share of each joint in each view, and the occluder."""

    seen: Array
    """(V, P, J) share of the rays that reach a joint, 0 to 1; 0 outside the image."""
    in_image: Mask
    """(V, P, J) whether the joint projects into the image."""
    hidden_by: Index
    """(V, P, J) NOBODY (-1) if at least half of the rays reach the joint; else the occluder of most
    others: a person's index, or ITSELF (-2) for its own body; BORDER (-3) outside the image."""


@dataclass(frozen=True)
class OccludingSurface:
    """The surface used for every person, and the joints that belong to each part of it."""

    vertices: Index
    """(M,) indices of the used vertices of the body's mesh."""
    faces: NDArray[np.int32]
    """(G, 3) triangles between the vertices of the surface."""
    shows: Mask
    """(M, J) whether at least half of a vertex's weight is on the joint's own or adjacent bones."""

    @classmethod
    def of(cls, body: "BodyModel", cell_m: float) -> "OccludingSurface":
        """The surface of `body`; vertices within a cube of `cell_m` in the mean T-pose
        are merged.
        """
        template = body.arrays.template
        vertices, faces, cell = thinned(template, body.faces, cell_m, template.min(axis=0))
        shown = body.arrays.weights @ _bones_near(body.parents).T
        mean = (
            np.stack([np.bincount(cell, share) for share in shown.T], axis=1)
            / np.bincount(cell)[:, None]
        )
        return cls(vertices, faces, mean >= 0.5)


def see(
    rig: Rig, joints: Array, surfaces: Real, skin: OccludingSurface, config: VisibilityConfig
) -> Visibility:
    """Visibility of BODY_25 `joints` (P, 25, 3) of people with `surfaces` (P, M, 3), the vertices
    of `skin`.

    A ray reaches a joint if the first surface on it is skinned to the joint's own or adjacent bones
    of the same person, or if no surface is nearer than the joint (a toe at the edge of its
    silhouette).
    """
    people, size = len(joints), surfaces.shape[1]
    xy, depth = rig.project(joints)
    in_image = np.all(
        (xy >= 0) & (xy <= rig.image_sizes[:, None, None] - 1), axis=-1
    )  # false for NaN
    rays = _RAYS if config.probe_m > 0 else _RAYS[:1]
    met_depth = np.full((*depth.shape, len(rays)), np.inf)
    met = np.full(met_depth.shape, -1, dtype=np.intp)
    faces = (skin.faces[None] + np.arange(people, dtype=np.int32)[:, None, None] * size).reshape(
        -1, 3
    )
    points = surfaces.reshape(-1, 3)
    for view in np.flatnonzero(in_image.any(axis=(1, 2))):
        camera = scaled(rig.cameras[view], config.image_scale)
        radius = config.probe_m * rig.focal_px[view] / depth[view]
        ratio = np.array(camera.image_size) / rig.image_sizes[view]
        pixels = (xy[view][..., None, :] + radius[..., None, None] * rays + 0.5) * ratio - 0.5
        last = np.array(camera.image_size) - 1
        column, row = (
            np.clip(np.rint(np.nan_to_num(pixels)), 0, last).astype(np.intp).transpose(3, 0, 1, 2)
        )
        met_depth[view], met[view] = first_surface_at(points, faces, camera, column, row)
    own = np.arange(people)[:, None, None]
    owner, place = np.divmod(met, max(size, 1))  # without a surface: owner -1
    shows = (owner == own) & skin.shows[place, np.arange(joints.shape[1])[:, None]]
    gap = depth[..., None] - met_depth  # -inf without a surface
    deep = np.full((joints.shape[1], 1), np.inf)
    deep[list(FACE)] = config.face_depth_m
    stopped = (gap > config.front_m) & (~shows | (gap > deep))
    seen = np.where(in_image, 1.0 - stopped.mean(axis=-1), 0.0)
    hidden_by = np.where(in_image, NOBODY, BORDER)
    hidden = in_image & (seen < 0.5)
    hidden_by[hidden] = _mode(np.where(owner == own, ITSELF, owner)[hidden], stopped[hidden])
    return Visibility(seen, in_image, hidden_by)


@dataclass(frozen=True)
class VisibilityWorker:
    """Computes visibility in many frames of a recording."""

    rig: Rig
    """The cameras."""
    skin: OccludingSurface
    """The surface of people."""
    config: VisibilityConfig
    """Settings of the depth buffer."""

    def one(self, people: FramePeople) -> Visibility:
        """Visibility in one frame."""
        joints, surfaces, *moved = people
        return see(
            moved[0] if len(moved) > 0 else self.rig, joints, surfaces, self.skin, self.config
        )

    def all(
        self, frames: Iterable[FramePeople], workers: int = 1
    ) -> Generator[Visibility, None, None]:
        """Yield the visibility of each frame; computed in `workers` processes, or here if that is
        1.

        Frames are taken from `frames` on demand. Close the iterator (`contextlib.closing`) to end
        the processes early. Raises RuntimeError if one of them dies.
        """
        with worker_processes(workers, self, AHEAD) as pool:
            yield from pool.map(VisibilityWorker.one, frames)


def facing(joints: Array, centres: Array) -> Array:
    """Cosine (V, P, 5) of face `joints` (P, 25, 3) between the outward direction of the head and
    that to cameras (V, 3).
    """
    face = joints[:, FACE]
    outward = face - joints[:, FACE[3:]].mean(axis=1, keepdims=True)
    to_camera = centres[:, None, None] - face
    length = np.linalg.norm(outward, axis=-1) * np.linalg.norm(to_camera, axis=-1)
    return (outward * to_camera).sum(axis=-1) / np.maximum(length, 1e-9)


def seen_from_the_front(seen: Array, joints: Array, centres: Array, ramp: Array) -> Array:
    """`seen` (V, P, 25) with the share of face joints reduced by their angle to the camera, in
    addition to the depth buffer.

    `ramp` (5, 2) are the cosines at which a face joint becomes invisible, and fully visible.
    """
    low, high = ramp.T
    result = seen.copy()
    result[..., FACE] *= np.clip((facing(joints, centres) - low) / (high - low), 0.0, 1.0)
    return result


def _mode(values: Index, counts: Mask) -> Index:
    """Mode (...,) of `values` (..., R) where `counts` is true; the first on a tie."""
    votes = ((values[..., :, None] == values[..., None, :]) & counts[..., None, :]).sum(axis=-1)
    best = np.where(counts, votes, 0).argmax(axis=-1)
    return np.take_along_axis(values, best[..., None], axis=-1)[..., 0]


def _bones_near(parents: tuple[int, ...]) -> Array:
    """(25, 24) 1 for a joint's own bones, and their parents and children."""
    adjacent = np.eye(len(parents))
    child, parent = np.arange(1, len(parents)), np.array(parents[1:])
    adjacent[child, parent] = adjacent[parent, child] = 1
    own = np.array(
        [[name in names.split("+") for name in SMPL_24] for names in _BONES], dtype=np.float64
    )
    return np.minimum(own @ adjacent, 1.0)
