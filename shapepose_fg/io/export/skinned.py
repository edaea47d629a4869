"""The bodies of a take as bones and skinned surface, in NumPy; used by the exports to BVH, glTF,
AMASS and marker files.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from shapepose_fg.body.model.body_model import accumulate
from shapepose_fg.body.model.rotation import exp_so3, hat, quaternion
from shapepose_fg.body.model.smpl_file import SMPL_PARENTS, SmplArrays
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.reconstruction import BODY, with_body
from shapepose_fg.io.export.registry import Job, Written
from shapepose_fg.io.export.take import Take

BONES = len(SMPL_PARENTS)


@dataclass(frozen=True)
class RestBody:
    """A person's body in the T-pose: y up, facing +z, metres."""

    arrays: SmplArrays
    """The body model."""
    betas: Array
    """(10,) the person's shape."""

    @cached_property
    def joints(self) -> Array:
        """(24, 3) joint positions."""
        return rest_joints(self.arrays, self.betas[None])[0]

    @cached_property
    def vertices(self) -> Array:
        """(Nv, 3) vertex positions."""
        return self.arrays.template + self.arrays.shapes @ self.betas

    @property
    def offsets(self) -> Array:
        """(24, 3) offset of each joint from its parent; for the pelvis, from the origin."""
        return _offsets(self.joints[None])[0]

    def tips(self) -> dict[int, Array]:
        """Vectors (3,) from each joint without children to the end of its bone, which is the
        farthest vertex of the bone's surface.
        """
        leaves = set(range(BONES)) - set(SMPL_PARENTS)
        bone_of = self.arrays.weights.argmax(axis=1)
        tips = {}
        for leaf in leaves:
            along = self.joints[leaf] - self.joints[SMPL_PARENTS[leaf]]
            along /= np.linalg.norm(along)
            # In some meshes a bone has no vertices of its own; it then gets 1 cm, because a bone
            # needs a length.
            reach = (self.vertices[bone_of == leaf] - self.joints[leaf]) @ along
            tips[leaf] = along * max(float(reach.max(initial=0.0)), 0.01)
        return tips


@dataclass(frozen=True)
class SkinnedMotion:
    """The motion of one person's body in F frames, in the axes of a format."""

    rest: RestBody
    """The body in the T-pose, with one shape for all frames."""
    index: Index
    """(F,) frames of the take that have a body."""
    rotations: Array
    """(F, 24, 4) rotation of each bone relative to its parent (pelvis: relative to the world);
    quaternions x y z w."""
    pelvis: Array
    """(F, 3) position of the pelvis in the world, metres."""
    spread_m: float = 0.0
    """Largest difference of a joint's position, m, between the common shape and the shape of a
    frame; 0 if all frames have the same shape."""
    filled: Mask | None = None
    """(F,) mask of interpolated frames; None if no gap was filled."""

    def joints(self) -> Array:
        """(F, 24, 3) joint positions in the world, metres."""
        return pose_joints(self.rest.offsets[None], self.rotations, self.pelvis)

    def turns(self) -> Array:
        """(F, 24, 3, 3) rotation of each bone, world from bone."""
        return _accumulated(self.rotations)

    def segments(self, longest_hole: int) -> Iterator["SkinnedMotion"]:
        """Split the motion at gaps; gaps of up to `longest_hole` frames are interpolated.

        Rotations are interpolated spherically (slerp) between the frames before and after the gap,
        the pelvis linearly.
        """
        cuts = np.flatnonzero(np.diff(self.index) > longest_hole + 1) + 1
        for part in np.split(np.arange(len(self.index)), cuts):
            given, rotations, pelvis = self.index[part], self.rotations[part], self.pelvis[part]
            index = np.arange(given[0], given[-1] + 1)
            if len(index) > len(given):
                from scipy.spatial.transform import Rotation, Slerp  # slow to import; only for gaps

                turns = [
                    Slerp(given, Rotation.from_quat(bone)) for bone in rotations.swapaxes(0, 1)
                ]
                rotations = np.stack([turn(index).as_quat() for turn in turns], axis=1)
                pelvis = np.stack([np.interp(index, given, axis) for axis in pelvis.T], axis=1)
            yield SkinnedMotion(self.rest, index, rotations, pelvis, filled=~np.isin(index, given))


def motion_of(take: Take, person: int, arrays: SmplArrays, axes: Array) -> SkinnedMotion | None:
    """The body of one person in the world rotated by `axes` (3, 3); None for a person without a
    body.
    """
    parts = [take.column(name, person) for name in BODY]
    index = np.flatnonzero(with_body(*parts))
    if len(index) == 0:
        return None
    betas, orient, pose, transl = (part[index] for part in parts)
    own = rest_joints(arrays, betas)
    turned = exp_so3(np.concatenate([orient[:, None], pose], axis=1))
    turned[:, 0] = axes @ turned[:, 0]
    quaternions = np.roll(quaternion(turned), -1, axis=-1)
    pelvis = (own[:, 0] + transl) @ axes.T
    motion = SkinnedMotion(RestBody(arrays, betas.mean(axis=0)), index, quaternions, pelvis)
    if (betas == betas[0]).all():
        return motion
    change_m = np.linalg.norm(
        pose_joints(_offsets(own), quaternions, pelvis) - motion.joints(), axis=-1
    )
    return replace(motion, spread_m=float(change_m.max()))


def everybody(
    job: Job, take: Take, kind: str, axes: Array, written: Written
) -> Iterator[tuple[int, SkinnedMotion]]:
    """All people with a body, with their motions in the world rotated by `axes` (3, 3).

    People without a body, or with several shapes, are noted in `written`.
    """
    for person, identity in enumerate(take.persons.tolist()):
        motion = motion_of(take, person, job.arrays, axes)
        if motion is None:
            written.notes.append(f"{kind}: person {identity} has no body in any frame")
            continue
        # Maximum difference between the shapes of one person, m, without a note.
        if motion.spread_m > 1e-3:
            written.notes.append(
                f"{kind}: person {identity} has several body shapes; the file has their mean, "
                f"which moves joints by up to {1e3 * motion.spread_m:.0f} mm"
            )
        yield identity, motion


def all_segments(
    job: Job, kind: str, axes: Array, written: Written
) -> Iterator[tuple[Path, SkinnedMotion, Take]]:
    """All motions at a constant rate, split at long gaps: path without suffix, motion, and take of
    its frames.
    """
    take = written.at_one_rate(job.take)
    for identity, motion in everybody(job, take, kind, axes, written):
        for segment in motion.segments(int(job.fill_gaps_s * take.fps + 1e-6)):
            first, last = take.frames[segment.index[[0, -1]]].tolist()
            yield job.folder / f"person_{identity}_frames_{first}-{last}", segment, take


def rest_joints(arrays: SmplArrays, betas: Array) -> Array:
    """(B, 24, 3) joints of shapes (B, 10) in the T-pose, metres."""
    mean = arrays.joint_regressor @ arrays.template
    shapes = np.einsum("jv,vxn->jxn", arrays.joint_regressor, arrays.shapes, optimize=True)
    return mean + np.einsum("jxn,bn->bjx", shapes, betas)


def skin(arrays: SmplArrays, betas: Array, rotations: Array, pelvis: Array, only: Index) -> Array:
    """(F, M, 3) positions of the vertices `only` (M,), metres, for `betas` (F, 10), `rotations` (F,
    24, 4) and `pelvis` (F, 3).

    Pose-dependent corrections of the surface are not applied; the open body has none.
    """
    rest = rest_joints(arrays, betas)
    turn = _accumulated(rotations)
    place = pose_joints(_offsets(rest), rotations, pelvis)
    shift = place - (turn @ rest[..., None])[..., 0]
    transforms = np.concatenate([turn, shift[..., None]], axis=-1).reshape(len(turn), BONES, 12)
    blended = (arrays.weights[only] @ transforms).reshape(len(turn), -1, 3, 4)
    shaped = arrays.template[only] + np.einsum("vxn,fn->fvx", arrays.shapes[only], betas)
    return (blended[..., :3] @ shaped[..., None])[..., 0] + blended[..., 3]


def pose_joints(offsets: Array, rotations: Array, pelvis: Array) -> Array:
    """(F, 24, 3) joint positions, metres, for bones with `offsets` (F or 1, 24, 3) from their
    parents, `rotations` (F, 24, 4) and `pelvis` (F, 3).
    """
    turn = _accumulated(rotations)
    places = [pelvis]
    for joint, parent in enumerate(SMPL_PARENTS[1:], start=1):
        places.append(places[parent] + (turn[:, parent] @ offsets[:, joint, :, None])[..., 0])
    return np.stack(places, axis=1)


def _offsets(rest: Array) -> Array:
    """(B, 24, 3) offset of each joint in the T-pose from its parent; for the pelvis, from the
    origin.
    """
    return np.concatenate([rest[:, :1], rest[:, 1:] - rest[:, np.array(SMPL_PARENTS[1:])]], axis=1)


def _accumulated(rotations: Array) -> Array:
    """(F, 24, 3, 3) rotations world from bone, from quaternions (F, 24, 4) relative to the
    parent.
    """
    cross = hat(rotations[..., :3])
    return accumulate(np.eye(3) + 2 * (rotations[..., 3:, None] * cross + cross @ cross))
