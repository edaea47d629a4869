"""Which joints a camera sees: the posed surfaces' depth buffer around each joint."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.camera import Rig
from shapepose_fg.rendering import render_depth, scaled

_OFFSETS = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (0.7, 0.7), (-0.7, 0.7), (0.7, -0.7), (-0.7, -0.7)])
"""Rays around a joint, in units of the probe's radius."""
_TRUNK = [1, 2, 5, 8, 9, 12]
"""Neck, shoulders and hips in BODY_25."""
_OTHERS_M = 0.02
"""Another person's surface hides a joint when it is nearer by more than this: skin on skin does not."""


@dataclass(frozen=True)
class VisibilityConfig:
    """How the depth buffer is read."""

    image_scale: float = 0.25
    """The buffer's resolution, as a share of the image's."""
    own_depth_m: float = 0.15
    """A joint lies at most this far under the skin that shows it; deeper, its own body hides it."""
    trunk_depth_m: float = 0.22
    """The same for hips, shoulders and neck: from the side they lie deeper in the body."""
    probe_m: float = 0.035
    """Radius around a joint in which rays are sent."""
    cell_m: float = 0.03
    """Vertices of the surface this near to each other are one; 0 keeps all."""


@dataclass(frozen=True)
class Visibility:
    """How much of each joint each view sees."""

    seen: NDArray[np.float64]
    """(V, P, J) share of the rays to a joint that arrive, 0 to 1; 0 outside the image."""
    in_image: NDArray[np.bool_]
    """(V, P, J) whether the joint projects into the image."""
    hidden_by: NDArray[np.intp]
    """(V, P, J) the other person in front of the joint; -1 where there is none, or its own body hides it."""


def see(
    rig: Rig,
    joints: NDArray[np.float64],
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    config: VisibilityConfig,
) -> Visibility:
    """See BODY_25 `joints` (P, 25, 3) of people whose surfaces are `vertices` (P, Nv, 3), `faces` (F, 3).

    A ray arrives when the first surface on it is the joint's own body within `own_depth_m`, or nothing
    nearer than the joint (a joint at the edge of its own silhouette).
    """
    people, count = joints.shape[:2]
    shape = (len(rig), people, count)
    seen, hidden_by = np.zeros(shape), np.full(shape, -1, dtype=np.intp)
    xy, depth = rig.project(joints)
    size = rig.image_sizes[:, None, None, :]
    in_image = np.all((xy >= 0) & (xy <= size - 1), axis=-1)  # NaN behind the camera compares false
    mesh = (faces[None] + np.arange(people)[:, None, None] * vertices.shape[1]).reshape(-1, 3)
    points = vertices.reshape(-1, 3)
    own = np.arange(people)[:, None, None]
    under_skin = np.full((count, 1), config.own_depth_m)
    under_skin[_TRUNK] = config.trunk_depth_m
    for view, camera in enumerate(rig.cameras):
        if not in_image[view].any():
            continue
        small = scaled(camera, config.image_scale)
        surface = render_depth(points, mesh, small, cull_back=True)
        ratio = np.array(small.image_size) / camera.image_size
        radius = config.probe_m * rig.focal_px[view] / depth[view]
        with np.errstate(invalid="ignore"):
            probes = (xy[view][:, :, None] + radius[..., None, None] * _OFFSETS + 0.5) * ratio - 0.5
            pixel = np.rint(probes)
        pixel = np.clip(np.nan_to_num(pixel), 0, np.array(small.image_size) - 1).astype(np.intp)
        face = surface.face[pixel[..., 1], pixel[..., 0]]
        person = np.where(face >= 0, face // len(faces), -1)
        gap = depth[view][..., None] - surface.depth[pixel[..., 1], pixel[..., 0]]  # -inf where nothing is
        hidden = gap > np.where(person == own, under_skin, _OTHERS_M)
        seen[view] = np.where(in_image[view], 1.0 - hidden.mean(axis=-1), 0.0)
        others = hidden & (person != own)
        # The nearest ray that another person stops names who is in front: rays are ordered from the centre.
        first = np.take_along_axis(person, others.argmax(axis=-1)[..., None], axis=-1)[..., 0]
        hidden_by[view] = np.where(others.any(axis=-1) & in_image[view], first, -1)
    return Visibility(seen, in_image, hidden_by)


def coarsen(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], cell_m: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Fewer triangles over some of the vertices (N, 3): one vertex per cube of `cell_m`.

    Returns the indices (M,) of the vertices that stay, and faces (G, 3) over those. A cube keeps the vertex
    nearest to its vertices' mean; triangles that collapse or come twice go.
    """
    if cell_m <= 0:
        return np.arange(len(vertices)), np.asarray(faces, dtype=np.intp)
    cells = np.floor((vertices - vertices.min(axis=0)) / cell_m).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    cell = cell.ravel()
    size = np.bincount(cell)
    mean = np.stack([np.bincount(cell, vertices[:, axis]) / size for axis in range(3)], axis=1)
    order = np.lexsort((np.linalg.norm(vertices - mean[cell], axis=1), cell))
    chosen = order[np.concatenate([[0], np.cumsum(size)[:-1]])]  # the first of each cell
    small = cell[faces]
    distinct = (small[:, 0] != small[:, 1]) & (small[:, 1] != small[:, 2]) & (small[:, 2] != small[:, 0])
    small = small[distinct]
    # Turn each triangle to begin with its smallest index, so that copies are equal and keep their winding.
    turn = (small.argmin(axis=1)[:, None] + np.arange(3)) % 3
    return chosen, np.unique(np.take_along_axis(small, turn, axis=1), axis=0)
