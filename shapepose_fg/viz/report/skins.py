"""Bodies for a page: one light mesh, bent by bones in the page itself."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.smpl_file import SMPL_PARENTS, SmplArrays
from shapepose_fg.core.drawing import thinned
from shapepose_fg.io.export.skinned import BONES, RestBody, motion_of
from shapepose_fg.io.export.take import Take

CELL_M = 0.05
"""A vertex per so many metres: 860 of the open body's 12,488, which a page can draw in every frame."""
ROW_BYTES = 8 * BONES + 6
"""A body in a frame: quaternions and the pelvis."""
_MOST_BONES = 4
"""Bones that bend a vertex, the strongest."""
TURN = 32767
"""A quaternion's entries are whole numbers of one part in so many."""


@dataclass(frozen=True)
class Skins:
    """The bodies of a take's people."""

    mesh: dict[str, NDArray[Any]]
    """What all share: `faces` (F, 3), and of each vertex the `bones` (M, 4) with their `weights` (M, 4) of 255."""
    rest: NDArray[np.float64]
    """(P, M, 3) each person's vertices in the T-pose, metres; NaN for somebody without a body."""
    joints: NDArray[np.float64]
    """(P, 24, 3) and joints."""
    turns: NDArray[np.float64]
    """(N, 24, 4) quaternions x y z w of the bones of each row against their parents; NaN without a body."""
    pelvis: NDArray[np.float64]
    """(N, 3) where it is, metres; NaN without a body."""


def skins_of(
    take: Take,
    arrays: SmplArrays,
    axes: NDArray[np.float64],
    frame: NDArray[np.intp],
    person: NDArray[np.intp],
) -> Skins:
    """The bodies of N rows, each a `person` (N,) of the take in a `frame` (N,), in the world turned by `axes`."""
    kept, faces = thinned(arrays.template, arrays.faces, CELL_M)
    order = np.argsort(-arrays.weights[kept], axis=1, kind="stable")[:, :_MOST_BONES]
    weights = np.take_along_axis(arrays.weights[kept], order, axis=1)
    weights = np.rint(255 * weights / weights.sum(axis=1, keepdims=True))
    P, N = len(take.persons), len(frame)
    rest, joints = np.full((P, len(kept), 3), np.nan), np.full((P, BONES, 3), np.nan)
    turns, pelvis = np.full((N, BONES, 4), np.nan), np.full((N, 3), np.nan)
    for each in range(P):
        motion = motion_of(take, each, arrays, axes)
        if motion is None:
            continue
        body: RestBody = motion.rest
        rest[each], joints[each] = body.vertices[kept], body.joints
        place = np.full(len(take.frames), -1)
        place[motion.index] = np.arange(len(motion.index))
        mine = np.flatnonzero((person == each) & (place[frame] >= 0))
        turns[mine], pelvis[mine] = motion.rotations[place[frame[mine]]], motion.pelvis[place[frame[mine]]]
    mesh = {"faces": faces, "bones": order, "weights": weights, "parents": np.array(SMPL_PARENTS)}
    return Skins(mesh, rest, joints, turns, pelvis)
