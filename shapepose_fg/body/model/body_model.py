"""A skinned body with SMPL's parameters: computes mesh, joints and keypoints from shape and pose.

The formulas are SMPL's (Loper et al. 2015): shape blend shapes, joints regressed from the shaped
template, pose blend shapes (if the file has any), linear blend skinning. The model's own frame:
metres, y up, facing +z, T-pose.
"""

from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.model.rotation import exp_so3
from shapepose_fg.body.model.skinned_points import SkinnedPoints, contract
from shapepose_fg.body.model.smpl_file import (
    DATA,
    NUM_BETAS,
    SMPL_PARENTS,
    SmplArrays,
    read_smpl_file,
)
from shapepose_fg.body.model.target_skeletons import slots
from shapepose_fg.core.arrays import Array, Index, Real
from shapepose_fg.core.skeleton import BODY_25, SMPL_24

_SHAPES = {"betas": (NUM_BETAS,), "global_orient": (3,), "body_pose": (23, 3), "transl": (3,)}


@dataclass(frozen=True)
class BodyParameters:
    """Shape and pose of B bodies, with SMPL's meaning."""

    betas: Array
    """(B, 10) shape, in standard deviations over adults."""
    global_orient: Array
    """(B, 3) axis-angle in radians of the pelvis, from the model's frame (y up, facing +z) to the
    world."""
    body_pose: Array
    """(B, 23, 3) axis-angle in radians of each further joint, relative to its parent, in SMPL's
    order."""
    transl: Array
    """(B, 3) metres, added to every vertex after posing; this is not the position of the pelvis."""

    def __post_init__(self) -> None:
        for name, shape in _SHAPES.items():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != (len(self.betas), *shape):
                expected = ", ".join(map(str, ("B", *shape)))
                raise ValueError(
                    f"{name} must be ({expected}) with the B of betas {self.betas.shape}, got "
                    f"{value.shape}"
                )
            object.__setattr__(self, name, value)

    @classmethod
    def zeros(cls, batch: int) -> "BodyParameters":
        """`batch` mean bodies in T-pose."""
        return cls(**{name: np.zeros((batch, *shape)) for name, shape in _SHAPES.items()})

    def __len__(self) -> int:
        return len(self.betas)

    @property
    def local(self) -> Array:
        """(B, 24, 3, 3) rotations relative to the parents, pelvis first."""
        return exp_so3(np.concatenate((self.global_orient[:, None], self.body_pose), 1))


class BodyModel:
    """A body model in SMPL's file format that poses batches of bodies.

    Keypoints are the 25 of BODY_25, where a detector places them on the posed body, or those chosen
    by `with_keypoints`.
    """

    joint_names: tuple[str, ...] = SMPL_24
    """Names of the 24 joints."""
    parents: tuple[int, ...] = SMPL_PARENTS
    """(24,) parent of each joint, -1 for the pelvis."""
    num_betas: int = NUM_BETAS
    """Number of shape components in use."""

    def __init__(
        self,
        arrays: SmplArrays,
        offsets: KeypointOffsets | None = None,
        keypoint_names: tuple[str, ...] = BODY_25.joints,
        same: "BodyModel | None" = None,
    ):
        """Build it from validated arrays; most callers want `default` or `load`.

        `same` is another model of the same arrays, with which the expensive results are shared.
        """
        self.arrays = arrays
        """Arrays of the file, in float64."""
        self.keypoint_offsets = KeypointOffsets.identity() if offsets is None else offsets
        """Offsets of the detector's joints from the body's; they apply to `keypoints`, not to
        `vertices` and `joints`."""
        self.keypoint_names = keypoint_names
        """(K,) names of the keypoints, some of `BODY_POINTS`."""
        self._same = same
        self._contracted = _contract(arrays) if same is None else same._contracted
        self.points = _moved(self._contracted, self.keypoint_offsets)
        """All `BODY_POINTS`: BODY_25's keypoints, the top of the head, the 24 joints."""
        self.keypoint_points = self.points.part(list(slots(keypoint_names)))
        """The keypoints (K)."""
        self._joints = self.points.part(list(slots(SMPL_24)))
        self._last_part: tuple[bytes, _Mesh] | None = None

    @staticmethod
    @cache
    def default() -> "BodyModel":
        """The open body of the package; read once."""
        return BodyModel.load(DATA / "open_body.npz")

    @classmethod
    def load(cls, path: str | Path, *, keypoint_regressor: Real | None = None) -> "BodyModel":
        """Read a model from SMPL's `.npz` or official `.pkl`; raises InputError if it is unusable.

        `keypoint_regressor` (25, Nv) maps vertices to BODY_25 keypoints. The default is the file's
        own `keypoint_regressor`, or, for SMPL's 6,890 vertices, a built-in one.
        """
        return cls(read_smpl_file(Path(path), keypoint_regressor))

    def with_keypoint_offsets(self, offsets: KeypointOffsets) -> "BodyModel":
        """Return this body with other keypoint offsets of a detector."""
        return self._with(offsets=offsets)

    def with_keypoints(self, names: tuple[str, ...]) -> "BodyModel":
        """Return this body with other keypoints: of a skeleton in `TARGET_SKELETONS`, or any of
        `BODY_POINTS`.
        """
        return self._with(keypoint_names=names)

    def _with(self, **changed: Any) -> "BodyModel":
        kept = {"offsets": self.keypoint_offsets, "keypoint_names": self.keypoint_names}
        return BodyModel(self.arrays, **(kept | changed), same=self._same or self)

    @property
    def faces(self) -> NDArray[np.int64]:
        """(F, 3) vertex indices of the triangles, counter-clockwise seen from outside."""
        return self.arrays.faces

    @property
    def num_vertices(self) -> int:
        """Number of vertices of the mesh, Nv."""
        return len(self.arrays.template)

    def vertices(self, parameters: BodyParameters, only: Index | None = None) -> Array:
        """(B, Nv, 3) the skinned mesh, metres; or (B, M, 3) for the vertices `only` (M,).

        This is the only method with a cost that grows with the mesh. Raises ValueError unless
        `only` is one-dimensional.
        """
        mesh = (
            self._mesh
            if only is None
            else self._part_of_mesh(np.ascontiguousarray(only, dtype=np.intp))
        )
        B, local, betas = len(parameters), parameters.local, parameters.betas
        rotations = accumulate(local)[:, mesh.bones]
        shaped = mesh.template + (betas @ mesh.shapes).reshape(B, *mesh.template.shape)
        if mesh.pose_blend is not None:
            bent = (local[:, 1:] - np.eye(3)).reshape(B, -1)
            shaped = shaped + (bent @ mesh.pose_blend).reshape(shaped.shape)
        rest = mesh.rest_joints + (betas @ mesh.rest_joint_shapes).reshape(
            B, *mesh.rest_joints.shape
        )
        shift = self.joints(parameters)[:, mesh.bones] - (rotations @ rest[..., None])[..., 0]
        posed = mesh.weights @ shift
        for axis in range(3):  # of the vertices at rest
            posed += (mesh.weights @ rotations[..., axis]) * shaped[..., axis, None]
        return np.asarray(posed)

    def joints(self, parameters: BodyParameters) -> Array:
        """(B, 24, 3) SMPL's joints, metres, without the mesh."""
        return self._joints.positions(parameters.local, parameters.betas, parameters.transl)

    def keypoints(self, parameters: BodyParameters) -> Array:
        """(B, K, 3) keypoints, metres: keypoint regressor times vertices, computed without the
        mesh.
        """
        return self.keypoint_points.positions(parameters.local, parameters.betas, parameters.transl)

    def keypoints_with_jacobian(self, parameters: BodyParameters) -> tuple[Array, Array]:
        """Keypoints (B, K, 3) and their analytic Jacobian (B, K, 3, 85).

        Columns: betas 10, global_orient 3, body_pose 23 x 3, transl 3. A rotation's columns are its
        right tangent `R <- R exp(delta)`, the rotation being the joint's own, relative to its
        parent.
        """
        points = self.keypoint_points
        return points.positions_with_jacobian(parameters.local, parameters.betas, parameters.transl)

    @property
    def offsets_of_keypoints(self) -> tuple[Array, Index] | None:
        """Keypoint offsets of each keypoint (K, 3), metres, and their bones (K,); None if all are
        zero.
        """
        if not self.keypoint_offsets.xyz_m.any():
            return None
        xyz, bones = (
            np.zeros((len(self.points.root), 3)),
            np.zeros(len(self.points.root), dtype=np.intp),
        )
        xyz[: len(BODY_25)], bones[: len(BODY_25)] = (
            self.keypoint_offsets.xyz_m,
            self.keypoint_offsets.bones,
        )
        chosen = list(slots(self.keypoint_names))
        return xyz[chosen], bones[chosen]

    def rest_pelvis(self, betas: Array) -> Array:
        """(B, 3) pelvis in T-pose for betas (B, 10), metres: the centre of the rotation
        `global_orient`.
        """
        return np.asarray(self._joints.root[0] + betas @ self._joints.root_shape[:, 0])

    def bone_rotations(self, parameters: BodyParameters) -> Array:
        """(B, 24, 3, 3) world from bone; in T-pose every bone's frame is the model's own."""
        return accumulate(parameters.local)

    def _part_of_mesh(self, only: Index) -> "_Mesh":
        """Arrays for some of the vertices; the last result is cached, because it is used frame
        after frame.
        """
        if only.ndim != 1:
            raise ValueError(f"`only` must be (M,) indices of vertices, got {only.shape}")
        key = only.tobytes()
        if self._last_part is None or self._last_part[0] != key:
            self._last_part = (key, self._mesh.part(only))
        return self._last_part[1]

    @cached_property
    def _mesh(self) -> "_Mesh":
        """The large arrays, computed at the first use of vertices."""
        if self._same is not None:
            return self._same._mesh
        arrays = self.arrays
        shapes = arrays.shapes.transpose(2, 0, 1)  # (10, Nv, 3)
        rest, rest_shapes = (
            arrays.joint_regressor @ arrays.template,
            arrays.joint_regressor @ shapes,
        )
        blend = arrays.pose_blend
        return _Mesh(
            template=arrays.template,
            shapes=shapes.reshape(NUM_BETAS, -1),
            pose_blend=None if blend is None else blend.reshape(-1, 207).T.copy(),
            rest_joints=rest,
            rest_joint_shapes=rest_shapes.reshape(NUM_BETAS, -1),
            weights=arrays.weights,
            bones=np.arange(len(SMPL_PARENTS)),
        )


@dataclass(frozen=True)
class _Mesh:
    """Arrays that only the vertices need."""

    template: Array
    """(Nv, 3) vertices at rest, metres."""
    shapes: Array
    """(10, Nv * 3) derivatives of the vertices by each beta, metres."""
    pose_blend: Array | None
    """(207, Nv * 3) derivatives of the vertices by each entry of R - I, metres."""
    rest_joints: Array
    """(N, 3) joints at rest, metres."""
    rest_joint_shapes: Array
    """(10, N * 3) derivatives of the joints by each beta, metres."""
    weights: Array
    """(Nv, N) skinning weights."""
    bones: Index
    """(N,) SMPL's bones with a non-zero weight."""

    def part(self, vertices: Index) -> "_Mesh":
        """Arrays for some of the vertices."""
        columns, bones = (
            (3 * vertices[:, None] + np.arange(3)).ravel(),
            np.flatnonzero(self.weights[vertices].any(0)),
        )
        return replace(
            self,
            template=self.template[vertices],
            shapes=self.shapes[:, columns],
            pose_blend=None if self.pose_blend is None else self.pose_blend[:, columns],
            rest_joints=self.rest_joints[bones],
            rest_joint_shapes=self.rest_joint_shapes[
                :, (3 * bones[:, None] + np.arange(3)).ravel()
            ],
            weights=self.weights[vertices][:, bones],
            bones=bones,
        )


def accumulate(local: Array) -> Array:
    """World rotations of SMPL's bones (B, 24, 3, 3) from those relative to their parents, of equal
    shape.
    """
    world = local.copy()
    for bone in range(1, len(SMPL_PARENTS)):  # parents first
        world[:, bone] = world[:, SMPL_PARENTS[bone]] @ local[:, bone]
    return world


def _contract(arrays: SmplArrays) -> SkinnedPoints:
    """All `BODY_POINTS` of a body, without detector offsets, contracted from the mesh, float64."""
    components = np.concatenate((arrays.template[..., None], arrays.shapes), -1)
    joints = np.einsum(
        "jv,vxn->jxn", arrays.joint_regressor, components, optimize=True
    )  # at rest, (24, 3, 11)
    top = np.zeros((1, len(arrays.template)))  # of the head: the highest vertex of the T-pose
    top[0, np.argmax(arrays.template[:, 1])] = 1
    keypoints, head = (
        _regressed(arrays, each, joints) for each in (arrays.keypoint_regressor, top)
    )
    # Joint j moves with bone j, at the joint's own rest position.
    eye = np.eye(len(SMPL_PARENTS))
    moments = eye[:, :, None, None] * joints[:, None]
    own = contract(moments, eye, joints, SMPL_PARENTS, np.ones(len(eye)), has_pose_blend=False)
    return keypoints.joined(head).joined(own)


def _regressed(arrays: SmplArrays, regressor: Array, joints: Array) -> SkinnedPoints:
    """Contract the points of a regressor (K, Nv)."""
    touched = np.flatnonzero(np.any(regressor != 0, axis=0))
    regressor, weights = regressor[:, touched], arrays.weights[touched]
    components = [arrays.template[touched, :, None], arrays.shapes[touched]]
    components += [] if arrays.pose_blend is None else [arrays.pose_blend[touched]]
    moments = np.einsum(
        "kv,vj,vxn->kjxn", regressor, weights, np.concatenate(components, -1), optimize=True
    )
    shares, total = regressor @ weights, regressor.sum(1)
    return contract(moments, shares, joints, SMPL_PARENTS, total, arrays.pose_blend is not None)


def _moved(points: SkinnedPoints, offsets: KeypointOffsets) -> SkinnedPoints:
    """`BODY_POINTS` with a constant offset of each BODY_25 point on its bone: x_k + R_b o_k, so
    d_kb + o_k.
    """
    moved = points.offsets.copy()
    moved[np.arange(len(offsets.bones)), :, offsets.bones] += offsets.xyz_m
    return replace(points, offsets=moved)
