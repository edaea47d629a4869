"""Joint angles of SMPL's bodies by the definitions of the ISB, with covariances.

Axes of a segment, after the recommendations of the International Society of Biomechanics (Wu et al.
2002 for the legs, 2005 for the arms; the knee is that of Grood and Suntay 1983): x forward, y up
along the bone (from its distal to its proximal end), z to the right. They are fixed in the body's
T-pose: the long axis of thigh, shank, upper arm and forearm joins the centres of two joints, the
axes of pelvis, thorax and foot are those of the model. Left sides are mirrored, so that equal
movements have equal angles.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.energy import BATCH
from shapepose_fg.body.fitting.priors import NUM_ANGLES, PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.result_body import model_of
from shapepose_fg.body.model.rotation import exp_so3, right_jacobian_inverse
from shapepose_fg.body.model.smpl_file import NUM_BETAS
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError, optional
from shapepose_fg.core.reconstruction import BODY, Known, Reconstruction, with_body
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.core.world_axes import opensim_axes

_ISB = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
"""Axes forward, up and right (columns) in the frame of the body model."""
_MIRROR = np.diag([1.0, 1, -1])


@dataclass(frozen=True)
class AngleDefinition:
    """Three angles of the rotation of a distal segment relative to a proximal one."""

    name: str
    """Name of the joint or segment, without its side."""
    angles: tuple[str, str, str]
    """Names of the angles, in the order of the sequence."""
    sequence: str
    """Axes of the intrinsic rotations, from proximal to distal."""
    signs: tuple[int, int, int]
    """Sign of each angle relative to the rotation about the axis, on the right side."""
    chain: tuple[str, ...]
    """SMPL's joints that rotate between the segments, without their side."""
    ends: tuple[str, str]
    """Proximal and distal bone, by the joint at which each begins, without side."""
    sided: bool = True
    """Whether the joint exists on each side."""


DEFINITIONS = (
    AngleDefinition("pelvis", ("rotation", "obliquity", "tilt"), "YXZ", (1, -1, -1), ("pelvis",),
                    ("world", "pelvis"), False),
    AngleDefinition("trunk", ("flexion", "bending", "rotation"), "ZXY", (-1, 1, 1),
                    ("spine1", "spine2", "spine3"), ("pelvis", "spine3"), False),
    AngleDefinition("hip", ("flexion", "adduction", "rotation"), "ZXY", (1, 1, 1), ("hip",),
                    ("pelvis", "hip")),
    AngleDefinition("knee", ("flexion", "adduction", "rotation"), "ZXY", (-1, 1, 1), ("knee",),
                    ("hip", "knee")),
    AngleDefinition("ankle", ("flexion", "inversion", "rotation"), "ZXY", (1, 1, 1), ("ankle",),
                    ("knee", "ankle")),
    AngleDefinition("shoulder", ("plane", "elevation", "rotation"), "YXY", (1, -1, 1),
                    ("collar", "shoulder"), ("spine3", "shoulder")),
    AngleDefinition("elbow", ("flexion", "carrying", "pronation"), "ZXY", (1, 1, 1), ("elbow",),
                    ("shoulder", "elbow")),
)  # fmt: skip
"""The angles; docs/joint_angles.md describes them."""
_BONES_ALONG = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}
"""Bones with a long axis: the joint at its proximal end, and the one at its distal end."""
_SHARED = 2.0
"""Number of a person's joints whose errors count as one, since they are marginals of one graph with
one body (coverage of `scripts/measure_angles.py`)."""
_WEIGHT = 2.0
"""Factor of the information of joints in the angles: with 1 the prior bends knees (errors of
`scripts/measure_angles.py`)."""
_STEP = 1e-4
"""Step of the central differences, rad."""
OPENSIM = (
    AngleDefinition("pelvis", ("tilt", "list", "rotation"), "ZXY", (1, 1, 1), ("pelvis",),
                    ("world", "pelvis"), False),
    AngleDefinition("lumbar", ("extension", "bending", "rotation"), "ZXY", (1, 1, 1),
                    ("spine1", "spine2", "spine3"), ("pelvis", "spine3"), False),
    *DEFINITIONS[2:5],
    AngleDefinition("arm", ("flex", "add", "rot"), "ZXY", (1, 1, 1), ("collar", "shoulder"),
                    ("spine3", "shoulder")),
    DEFINITIONS[6],
)  # fmt: skip
"""The coordinates of OpenSim's models for the whole body, which differ for pelvis and arms."""


def sides(definitions: Sequence[AngleDefinition]) -> list[tuple[AngleDefinition, str]]:
    """Each definition with its sides ("right_", "left_" or ""), in the order of the result."""
    pairs = ("right_", "left_")
    return [(each, side) for each in definitions for side in (pairs if each.sided else ("",))]


def _names(definitions: Sequence[AngleDefinition]) -> tuple[str, ...]:
    return tuple(
        f"{side}{each.name}_{angle}" for each, side in sides(definitions) for angle in each.angles
    )


NAMES = _names(DEFINITIONS)
"""(36,) names of the angles, such as `right_knee_flexion`."""


@dataclass(frozen=True)
class JointAngles:
    """A angles of N rows, NaN in rows without a body."""

    people: Reconstruction
    """The rows."""
    names: tuple[str, ...]
    """(A,) names of the angles, such as `right_knee_flexion`; `NAMES` by default."""
    degrees: Array
    """(N, A) angles, degrees, -180 to 180."""
    covariance: Array
    """(N, A, A) covariance of the angles, square degrees; NaN if the result has no covariances."""

    @property
    def sigma(self) -> Array:
        """(N, A) standard deviations, degrees."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0))

    def columns(self) -> dict[str, NDArray[Any]]:
        """Frame, time and person of each row, then `right_knee_flexion_deg`,
        `right_knee_flexion_sigma_deg` and so on.
        """
        columns: dict[str, NDArray[Any]] = {
            name: getattr(self.people, name) for name in ("frame", "time_s", "person")
        }
        for name, degrees, sigma in zip(self.names, self.degrees.T, self.sigma.T, strict=True):
            columns |= {f"{name}_deg": degrees, f"{name}_sigma_deg": sigma}
        return columns

    def to_frame(self, library: str = "pandas") -> Any:
        """`columns` as a DataFrame of pandas or Polars."""
        return optional(library, "frames").DataFrame(self.columns())


def joint_angles(
    people: Reconstruction,
    up: Axis | None = None,
    model: BodyModel | None = None,
    definitions: Sequence[AngleDefinition] = DEFINITIONS,
) -> JointAngles:
    """Angles of the bodies of `people`, by `definitions`.

    `up` is the axis of the world that points up, by default that of `people.rig`; `model` is the
    body with which they were fitted, by default the one that `people.run` names. InputError if they
    are unknown. The joints that a view saw are measurements of the body's rotations, with their
    covariances; the priors of pose and shape are added. An angle that they do not determine, such
    as the axial rotation of a straight limb, has the variance of the prior.
    """
    axis: Any = people.rig.up if up is None and people.rig is not None else up
    if axis not in get_args(Axis):
        raise InputError(f"up={axis}: must be the axis of the world that points up, such as 'z'")
    world = opensim_axes(axis)
    model = model_of(people.run) if model is None else model
    with_angles = np.flatnonzero(with_body(*(getattr(people, name) for name in BODY)))
    names = _names(definitions)
    degrees = np.full((len(people), len(names)), np.nan)
    covariance = np.full((*degrees.shape, len(names)), np.nan)
    model = model.with_keypoints(tuple(people.joint_names.tolist()))
    for start in range(0, len(with_angles), BATCH):
        rows = with_angles[start : start + BATCH]
        part = people.rows(rows)
        posed = BodyParameters(*(getattr(part, name) for name in BODY))
        betas, local, rotations = _rotations(part, model, posed)
        axes = segment_axes(model, betas)
        degrees[rows], slope = angles_and_slopes(local, axes, world, definitions)
        covariance[rows] = slope @ rotations @ slope.swapaxes(1, 2)
    return JointAngles(people, names, degrees, covariance)


def segment_axes(model: BodyModel, betas: Array) -> dict[str, Array]:
    """Axes x, y, z (columns) of each bone (B, 3, 3) in the T-pose, in the frame of the model."""
    rest = model.joints(BodyParameters(betas, *(np.zeros((len(betas), *shape))
                                                for shape in ((3,), (23, 3), (3,)))))  # fmt: skip
    axes = {name: np.broadcast_to(_ISB, (len(betas), 3, 3)) for name in SMPL_24}
    for side in ("left_", "right_"):
        for proximal, distal in _BONES_ALONG.items():
            ends = (SMPL_24.index(f"{side}{name}") for name in (proximal, distal))
            begin, end = (rest[:, joint] for joint in ends)
            y = _unit(begin - end)
            if proximal in ("hip", "knee"):
                x = _unit(np.cross(y, _ISB[:, 2]))
                z = np.cross(x, y)
            else:
                z = _unit(np.cross(_ISB[:, 0], y))
                x = np.cross(y, z)
            axes[f"{side}{proximal}"] = np.stack([x, y, z], axis=-1)
    return axes


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _sided(name: str, side: str) -> str:
    """SMPL's name of a joint: with the side, if it has one."""
    return f"{side}{name}" if f"{side}{name}" in SMPL_24 else name


def _angles_of(R: Array, sequence: str) -> Array:
    """(B, 3) angles, rad, of the intrinsic rotations `sequence` of R (B, 3, 3)."""
    if sequence == "ZXY":
        tilt = np.hypot(R[:, 0, 1], R[:, 1, 1])
        three = (
            np.arctan2(-R[:, 0, 1], R[:, 1, 1]),
            np.arctan2(R[:, 2, 1], tilt),
            np.arctan2(-R[:, 2, 0], R[:, 2, 2]),
        )
    elif sequence == "YXZ":
        tilt = np.hypot(R[:, 0, 2], R[:, 2, 2])
        three = (
            np.arctan2(R[:, 0, 2], R[:, 2, 2]),
            np.arctan2(-R[:, 1, 2], tilt),
            np.arctan2(R[:, 1, 0], R[:, 1, 1]),
        )
    else:  # YXY with the second angle negative
        tilt = np.hypot(R[:, 0, 1], R[:, 2, 1])
        three = (
            np.arctan2(-R[:, 0, 1], -R[:, 2, 1]),
            -np.arctan2(tilt, R[:, 1, 1]),
            np.arctan2(-R[:, 1, 0], R[:, 1, 2]),
        )
    return np.stack(three, axis=1)


def angles_and_slopes(
    local: Array,
    axes: dict[str, Array],
    world: Array,
    definitions: Sequence[AngleDefinition] = DEFINITIONS,
) -> tuple[Array, Array]:
    """A angles (B, A), degrees, of bodies with rotations `local` (B, 24, 3, 3), and their
    derivatives (B, A, 72) by the right tangents of the rotations, degrees per rad.

    `axes` are those of `segment_axes`; `world` (3, 3) is the rotation from the world to y up.
    """
    every = sides(definitions)
    degrees = np.zeros((len(local), 3 * len(every)))
    slopes = np.zeros((*degrees.shape, 24, 3))
    for n, (each, side) in enumerate(every):
        first, last = (_sided(name, side) for name in each.ends)
        mirror = -_MIRROR if side == "left_" else np.eye(3)  # of axial vectors
        # T exp(w) is the relative rotation, with w = (R_i+1 ... R_n D)^T d_i for tangents d_i.
        after, joints = axes[last], [SMPL_24.index(_sided(name, side)) for name in each.chain]
        towards = dict[int, Array]()
        for joint in reversed(joints):
            towards[joint] = mirror @ after.swapaxes(1, 2)
            after = local[:, joint] @ after
        turn = mirror @ (world if first == "world" else axes[first].swapaxes(1, 2)) @ after @ mirror
        signs, rows = np.array(each.signs), slice(3 * n, 3 * n + 3)
        degrees[:, rows] = np.degrees(signs * _angles_of(turn, each.sequence))
        ends = [
            _angles_of(turn @ exp_so3(step * axis), each.sequence)
            for axis in np.eye(3)
            for step in (_STEP, -_STEP)
        ]
        differences = [a - b for a, b in zip(ends[::2], ends[1::2], strict=True)]
        change = (np.stack(differences, axis=2) + np.pi) % (2 * np.pi) - np.pi
        slope = np.degrees(signs[:, None] * change / (2 * _STEP))
        for joint, through in towards.items():
            slopes[:, rows, joint] = slope @ through
    return degrees, slopes.reshape(*degrees.shape, 72)


def _rotations(
    people: Reconstruction, model: BodyModel, posed: BodyParameters
) -> tuple[Array, Array, Array]:
    """Shapes (B, 10) and rotations (B, 24, 3, 3) of the bodies, and the covariance (B, 72, 72) of
    the right tangents of the rotations, rad².

    The joints x that a view saw, with covariances C, measure the keypoints of the body, which have
    the Jacobian J. With the precision P of the prior of shape and pose, the covariance is
    (J^T C^-1 J / `_SHARED` + P)^-1. The bodies are moved by a Gauss-Newton step to the joints and
    the mean of the prior of poses, on which the flexion of pelvis and trunk depends.
    """
    points, jacobian = model.keypoints_with_jacobian(posed)
    count, columns = len(points), jacobian.shape[-1]
    volume = np.linalg.det(np.nan_to_num(people.covariance))  # 0 if it is unknown or singular
    placed = volume > 0
    seen, known = placed & Known.observed(people.known), placed[..., None, None]
    weight = np.linalg.inv(np.where(known, people.covariance, np.eye(3))) * known
    flat = jacobian.reshape(count, -1, columns)
    weighted = (weight @ jacobian).reshape(flat.shape)
    information = flat.swapaxes(1, 2) @ weighted
    by_views = flat.swapaxes(1, 2) @ (weighted * np.repeat(seen, 3, axis=1)[..., None])
    poses, prior = PosePrior.default(), np.zeros_like(information)
    blocks = np.zeros((count, 23, 3, 23, 3))
    blocks[:, np.arange(23), :, np.arange(23)] = right_jacobian_inverse(posed.body_pose).swapaxes(
        0, 1
    )
    blocks = blocks.reshape(count, NUM_ANGLES, NUM_ANGLES)
    pulls = blocks.swapaxes(1, 2) @ poses.marginal_precision(np.arange(NUM_ANGLES))
    prior[:, 13:82, 13:82] = pulls @ blocks
    prior[:, range(NUM_BETAS), range(NUM_BETAS)] = 1
    # So that a row with few joints has an inverse.
    prior[:, range(columns), range(columns)] += 1e-6
    covariance = np.linalg.inv(by_views / _SHARED + prior)[:, 10:82, 10:82]
    residual = np.where(placed[..., None], people.joints - points, 0).reshape(count, -1, 1)
    pull = _WEIGHT * weighted.swapaxes(1, 2) @ residual
    pull[:, 13:82] += pulls @ (poses.mean - posed.body_pose.reshape(count, -1))[..., None]
    pull *= placed.any(axis=1)[:, None, None]  # bodies without covariances stay
    step = np.linalg.solve(_WEIGHT * information + prior, pull)[..., 0]
    local = posed.local @ exp_so3(step[:, 10:82].reshape(-1, 24, 3))
    return (
        posed.betas + step[:, :10],
        local,
        np.where(seen.any(axis=1).reshape(-1, 1, 1), covariance, np.nan),
    )
