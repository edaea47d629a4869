"""A skinned body with SMPL's parameters: shape and pose in, mesh, joints and keypoints out.

The formulas are SMPL's (Loper et al. 2015): shape blend shapes, joints regressed from the shaped template, pose
blend shapes (where the file has any), linear blend skinning.
The model's own frame: metres, y up, facing +z, T-pose.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.model.rotation import exp_so3
from shapepose_fg.body.model.skinned_points import SkinnedPoints, contract
from shapepose_fg.body.model.smpl_file import NUM_BETAS, SMPL_PARENTS, SmplArrays, read_smpl_file
from shapepose_fg.body.model.target_skeletons import slots
from shapepose_fg.core.arrays import Array, Index, Real
from shapepose_fg.core.skeleton import BODY_25, SMPL_24

_DEFAULT_FILE = Path(__file__).parents[1] / "data" / "open_body.npz"
_SHAPES = {"betas": (NUM_BETAS,), "global_orient": (3,), "body_pose": (23, 3), "transl": (3,)}


@dataclass(frozen=True)
class BodyParameters:
    """Shape and pose of B bodies, with SMPL's meaning; all four of one floating point type."""

    betas: Tensor
    """(B, 10) shape, in standard deviations over adults."""
    global_orient: Tensor
    """(B, 3) axis-angle in radians of the pelvis, from the model's frame (y up, facing +z) to the world."""
    body_pose: Tensor
    """(B, 23, 3) axis-angle in radians of each further joint, relative to its parent, in SMPL's order."""
    transl: Tensor
    """(B, 3) metres, added to every vertex after posing; not the place of the pelvis."""

    def __post_init__(self) -> None:
        for name, shape in _SHAPES.items():
            value = getattr(self, name)
            if value.shape != (len(self.betas), *shape) or value.dtype != self.betas.dtype:
                expected = ", ".join(map(str, ("B", *shape)))
                raise ValueError(
                    f"{name} must be ({expected}) with the B and dtype of betas {tuple(self.betas.shape)} "
                    f"{self.betas.dtype}, got {tuple(value.shape)} {value.dtype}"
                )

    @classmethod
    def zeros(cls, batch: int, dtype: torch.dtype = torch.float32) -> "BodyParameters":
        """`batch` mean bodies in T-pose."""
        return cls(**{name: torch.zeros(batch, *shape, dtype=dtype) for name, shape in _SHAPES.items()})

    def __len__(self) -> int:
        return len(self.betas)

    def to(self, dtype: torch.dtype) -> "BodyParameters":
        """The same parameters in another floating point type."""
        return BodyParameters(**{field.name: getattr(self, field.name).to(dtype) for field in fields(self)})


class BodyModel:
    """A body model in SMPL's file format, ready to pose batches of bodies.

    Keypoints are the 25 of BODY_25, as a detector would place them on the posed body, or those that
    `with_keypoints` chose.
    """

    joint_names: tuple[str, ...] = SMPL_24
    """Names of the 24 joints."""
    parents: tuple[int, ...] = SMPL_PARENTS
    """(24,) parent of each joint, -1 for the pelvis."""
    num_betas: int = NUM_BETAS
    """Shape components in use."""

    def __init__(
        self,
        arrays: SmplArrays,
        dtype: torch.dtype = torch.float32,
        offsets: KeypointOffsets | None = None,
        keypoint_names: tuple[str, ...] = BODY_25.joints,
        contracted: SkinnedPoints | None = None,
    ):
        """From checked arrays; most callers want `default` or `load`.

        `contracted` is what another model made of the same arrays (`_contract`): it costs more than all else here.
        """
        self.arrays = arrays
        """What the file held, in float64."""
        self.dtype = dtype
        """Floating point type of parameters and results."""
        self.keypoint_offsets = KeypointOffsets.identity() if offsets is None else offsets
        """Where the detector's joints lie against the body's; in `keypoints`, not in `vertices` and `joints`."""
        self.keypoint_names = keypoint_names
        """(K,) names of the keypoints, some of `BODY_POINTS`."""
        self._contracted = _contract(arrays) if contracted is None else contracted
        self.points = _moved(self._contracted, self.keypoint_offsets).to(dtype)
        """All `BODY_POINTS`: BODY_25's keypoints, the top of the head, the 24 joints."""
        self.keypoint_points = self.points.part(list(slots(keypoint_names)))
        """The keypoints (K)."""
        self._joints = self.points.part(list(slots(SMPL_24)))
        self._last_part: tuple[bytes, _Mesh] | None = None

    @staticmethod
    @cache
    def default() -> "BodyModel":
        """The open body that ships with the package, float32; read once."""
        return BodyModel.load(_DEFAULT_FILE)

    @classmethod
    def load(cls, path: str | Path, *, keypoint_regressor: Real | None = None) -> "BodyModel":
        """A model from SMPL's `.npz` or official `.pkl`; InputError where it cannot be used.

        `keypoint_regressor` (25, Nv) makes the BODY_25 keypoints from vertices. Without it the file's own
        `keypoint_regressor` serves, or, for SMPL's 6,890 vertices, one that is known for that mesh.
        """
        return cls(read_smpl_file(Path(path), keypoint_regressor))

    def to(self, dtype: torch.dtype) -> "BodyModel":
        """The same model computing in another floating point type."""
        return self if dtype == self.dtype else self._with(dtype=dtype)

    def with_keypoint_offsets(self, offsets: KeypointOffsets) -> "BodyModel":
        """The same body with its keypoints where a detector puts them; takes the place of offsets it has."""
        return self._with(offsets=offsets)

    def with_keypoints(self, names: tuple[str, ...]) -> "BodyModel":
        """The same body with other keypoints: a skeleton of `TARGET_SKELETONS`, or any of `BODY_POINTS`."""
        return self._with(keypoint_names=names)

    def _with(self, **changed: Any) -> "BodyModel":
        kept = {"dtype": self.dtype, "offsets": self.keypoint_offsets, "keypoint_names": self.keypoint_names}
        return BodyModel(self.arrays, **(kept | changed), contracted=self._contracted)

    @property
    def faces(self) -> NDArray[np.int64]:
        """(F, 3) vertex indices of the triangles, counter-clockwise seen from outside."""
        return self.arrays.faces

    @property
    def num_vertices(self) -> int:
        """Vertices of the mesh, Nv."""
        return len(self.arrays.template)

    def vertices(self, parameters: BodyParameters, only: Index | None = None) -> Tensor:
        """(B, Nv, 3) the skinned mesh, metres; or (B, M, 3), the vertices `only` (M,) of it.

        The only thing here whose cost grows with the mesh. ValueError where `only` has other than one axis.
        """
        mesh = self._mesh if only is None else self._part_of_mesh(np.ascontiguousarray(only, dtype=np.intp))
        local, rotations = self._rotations(parameters)
        shaped = mesh.template + (parameters.betas @ mesh.shapes).unflatten(-1, (-1, 3))
        if mesh.pose_blend is not None:
            bent = (local[:, 1:] - torch.eye(3, dtype=self.dtype)).flatten(1)
            shaped = shaped + (bent @ mesh.pose_blend).unflatten(-1, (-1, 3))
        rest = mesh.rest_joints + (parameters.betas @ mesh.rest_joint_shapes).unflatten(-1, (-1, 3))
        posed = self._joints.positions(rotations, parameters.betas, parameters.transl, None)
        shift = posed - (rotations @ rest[..., None]).squeeze(-1)
        transforms = torch.cat((rotations, shift[..., None]), -1).flatten(2)  # (B, 24, 12)
        blended = (mesh.weights @ transforms).unflatten(-1, (3, 4))
        return (blended[..., :3] @ shaped[..., None]).squeeze(-1) + blended[..., 3]

    def joints(self, parameters: BodyParameters) -> Tensor:
        """(B, 24, 3) SMPL's joints, metres, without the mesh."""
        _, rotations = self._rotations(parameters)
        return self._joints.positions(rotations, parameters.betas, parameters.transl, None)

    def keypoints(self, parameters: BodyParameters) -> Tensor:
        """(B, K, 3) keypoints, metres: keypoint regressor x vertices, without the mesh."""
        local, rotations = self._rotations(parameters)
        points = self.keypoint_points
        return points.positions(rotations, parameters.betas, parameters.transl, points.feature(local))

    @torch.no_grad()
    def keypoints_with_jacobian(
        self, parameters: BodyParameters, tangents: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Keypoints (B, K, 3) and their analytic Jacobian (B, K, 3, 85); carries no autograd graph.

        Columns: betas 10, global_orient 3, body_pose 23 x 3, transl 3. A rotation's columns are its right tangent
        `R <- R exp(delta)`, the rotation being the joint's own, relative to its parent; with `tangents` T
        (B, 24, 3, 3) it is `R <- R exp(T delta)`: with T its right Jacobian the columns are those of axis-angles.
        """
        local, rotations = self._rotations(parameters)
        return self.keypoint_points.positions_with_jacobian(
            rotations, parameters.betas, parameters.transl, local, self.keypoint_points.feature(local), tangents
        )

    @property
    def offsets_of_keypoints(self) -> tuple[Tensor, Tensor] | None:
        """What the keypoint offsets add to each keypoint (K, 3) and on which bone (K,); None where nothing."""
        if not self.keypoint_offsets.xyz_m.any():
            return None
        xyz = torch.zeros(len(self.points.root), 3, dtype=self.dtype)
        bones = torch.zeros(len(xyz), dtype=torch.long)
        xyz[: len(BODY_25)] = torch.from_numpy(self.keypoint_offsets.xyz_m).to(self.dtype)
        bones[: len(BODY_25)] = torch.from_numpy(self.keypoint_offsets.bones)
        chosen = list(slots(self.keypoint_names))
        return xyz[chosen], bones[chosen]

    def rest_pelvis(self, betas: Tensor) -> Tensor:
        """(B, 3) the pelvis of bodies (B, 10) in the T-pose, metres: what `global_orient` turns about."""
        return self._joints.root[0] + betas @ self._joints.root_shape[:, 0]

    def bone_rotations(self, parameters: BodyParameters) -> Tensor:
        """(B, 24, 3, 3) world from bone: in the T-pose every bone's frame is the model's own."""
        return self._rotations(parameters)[1]

    def _rotations(self, parameters: BodyParameters) -> tuple[Tensor, Tensor]:
        """Local and world rotations of the joints, (B, 24, 3, 3) each."""
        if parameters.betas.dtype != self.dtype:
            raise ValueError(
                f"parameters are {parameters.betas.dtype}, the model computes in {self.dtype}: "
                "convert one of them with .to(dtype)"
            )
        local = exp_so3(torch.cat((parameters.global_orient[:, None], parameters.body_pose), 1))
        return local, accumulate(local)

    def _part_of_mesh(self, only: Index) -> "_Mesh":
        """What some of the vertices need; the last part is kept, for it is asked for frame after frame."""
        if only.ndim != 1:
            raise ValueError(f"only must be (M,) numbers of vertices, got {only.shape}")
        key = only.tobytes()
        if self._last_part is None or self._last_part[0] != key:
            self._last_part = (key, self._mesh.part(only))
        return self._last_part[1]

    @cached_property
    def _mesh(self) -> "_Mesh":
        """The big arrays, made when vertices are first asked for."""
        arrays = self.arrays
        shapes = arrays.shapes.transpose(2, 0, 1)  # (10, Nv, 3)
        rest, rest_shapes = arrays.joint_regressor @ arrays.template, arrays.joint_regressor @ shapes
        blend = arrays.pose_blend
        return _Mesh(
            template=torch.from_numpy(arrays.template).to(self.dtype),
            shapes=torch.from_numpy(shapes.reshape(NUM_BETAS, -1)).to(self.dtype),
            pose_blend=None if blend is None else torch.from_numpy(blend.reshape(-1, 207).T.copy()).to(self.dtype),
            rest_joints=torch.from_numpy(rest).to(self.dtype),
            rest_joint_shapes=torch.from_numpy(rest_shapes.reshape(NUM_BETAS, -1)).to(self.dtype),
            weights=torch.from_numpy(arrays.weights).to(self.dtype),
        )


@dataclass(frozen=True)
class _Mesh:
    """What only the vertices need."""

    template: Tensor
    """(Nv, 3) metres."""
    shapes: Tensor
    """(10, Nv * 3) metres per unit of each beta."""
    pose_blend: Tensor | None
    """(207, Nv * 3) metres per unit of each entry of R - I."""
    rest_joints: Tensor
    """(24, 3) metres."""
    rest_joint_shapes: Tensor
    """(10, 24 * 3) metres per unit of each beta."""
    weights: Tensor
    """(Nv, 24) skinning weights."""

    def part(self, vertices: Index) -> "_Mesh":
        """What some of the vertices need."""
        rows = torch.from_numpy(vertices)
        blend = self.pose_blend
        return replace(
            self,
            template=self.template[rows],
            shapes=self.shapes.unflatten(1, (-1, 3))[:, rows].flatten(1),
            pose_blend=None if blend is None else blend.unflatten(1, (-1, 3))[:, rows].flatten(1),
            weights=self.weights[rows],
        )


def _tree_levels() -> Iterator[tuple[Tensor, Tensor]]:
    """Joints level by level below the root, and their parents' places in the level above."""
    level = [0]
    while children := [j for j in range(1, len(SMPL_PARENTS)) if SMPL_PARENTS[j] in level]:
        yield torch.tensor(children), torch.tensor([level.index(SMPL_PARENTS[j]) for j in children])
        level = children


_LEVELS = list(_tree_levels())
_FROM_LEVEL_ORDER = torch.cat((torch.zeros(1, dtype=torch.long), *(joints for joints, _ in _LEVELS))).argsort()


def accumulate(local: Tensor) -> Tensor:
    """World rotations of SMPL's bones from those relative to their parents; (B, 24, 3, 3) both."""
    levels = [local[:, :1]]
    for joints, parents_in_level in _LEVELS:  # tensors: lists would be converted each time
        levels.append(levels[-1].index_select(1, parents_in_level) @ local.index_select(1, joints))
    return torch.cat(levels, 1).index_select(1, _FROM_LEVEL_ORDER)


def _contract(arrays: SmplArrays) -> SkinnedPoints:
    """All `BODY_POINTS` of a mesh, float64, where the body itself has them."""
    components = np.concatenate((arrays.template[..., None], arrays.shapes), -1)
    joints = np.einsum("jv,vxn->jxn", arrays.joint_regressor, components, optimize=True)  # at rest, (24, 3, 11)
    top = np.zeros((1, len(arrays.template)))  # of the head: the highest vertex of the T-pose
    top[0, np.argmax(arrays.template[:, 1])] = 1
    keypoints, head = (_regressed(arrays, each, joints) for each in (arrays.keypoint_regressor, top))
    # Joint j rides on bone j at the joint's own rest position.
    eye = np.eye(len(SMPL_PARENTS))
    moments = eye[:, :, None, None] * joints[:, None]
    own = contract(moments, eye, joints, SMPL_PARENTS, np.ones(len(eye)), has_pose_blend=False)
    return keypoints.joined(head).joined(own)


def _regressed(arrays: SmplArrays, regressor: Array, joints: Array) -> SkinnedPoints:
    """The contraction of a regressor (K, Nv)."""
    touched = np.flatnonzero(np.any(regressor != 0, axis=0))
    regressor, weights = regressor[:, touched], arrays.weights[touched]
    components = [arrays.template[touched, :, None], arrays.shapes[touched]]
    components += [] if arrays.pose_blend is None else [arrays.pose_blend[touched]]
    moments = np.einsum("kv,vj,vxn->kjxn", regressor, weights, np.concatenate(components, -1), optimize=True)
    shares, total = regressor @ weights, regressor.sum(1)
    return contract(moments, shares, joints, SMPL_PARENTS, total, arrays.pose_blend is not None)


def _moved(points: SkinnedPoints, offsets: KeypointOffsets) -> SkinnedPoints:
    """`BODY_POINTS`, BODY_25's a constant offset away on one bone each: x_k + R_b o_k, so d_kb + o_k."""
    moved = points.offsets.clone()
    moved[torch.arange(len(offsets.bones)), :, torch.from_numpy(offsets.bones)] += torch.from_numpy(offsets.xyz_m)
    return replace(points, offsets=moved)
