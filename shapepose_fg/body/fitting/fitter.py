"""From 3D joints to bodies: what a fitter is given, what it gives back, and what it may be replaced by."""

from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class FitStatus(StrEnum):
    """How the fit of one row ended."""

    OK = "ok"
    INVALID_TARGETS = "invalid_targets"
    """NaN or infinity in a target that has information, or information that is not positive semi-definite."""
    TOO_FEW_JOINTS = "too_few_joints"
    """Too few joints with full information, or all of them on one line: the body could be turned freely."""
    NOT_CONVERGED = "not_converged"
    """The energy was still falling when the iterations ran out, or it left the finite numbers."""


STATUS_TYPE = np.dtype(f"U{max(map(len, FitStatus))}")
"""Of arrays that hold any `FitStatus`: one made of a shorter text would cut off the others."""


@dataclass(frozen=True)
class JointTargets:
    """Where the joints of B people (rows: people, frames or both) should be, and how surely."""

    xyz: NDArray[np.float64]
    """(B, J, 3) target of each joint in the world, metres; ignored where the information is zero."""
    information: NDArray[np.float64]
    """(B, J, 3, 3) inverse covariance of each target, 1/m², symmetric and positive *semi*-definite.

    Zero for a joint never seen, rank 2 for one that a single view saw (a ray), full otherwise."""

    def __post_init__(self) -> None:
        xyz = np.asarray(self.xyz, dtype=np.float64)
        information = np.asarray(self.information, dtype=np.float64)
        if xyz.ndim != 3 or xyz.shape[-1] != 3:
            raise ValueError(f"xyz must be (B, J, 3), got {xyz.shape}")
        if information.shape != (*xyz.shape, 3):
            raise ValueError(f"information must be {(*xyz.shape, 3)} like xyz, got {information.shape}")
        object.__setattr__(self, "xyz", xyz)
        object.__setattr__(self, "information", information)

    def __len__(self) -> int:
        return len(self.xyz)

    def rows(self, index: NDArray[np.intp]) -> "JointTargets":
        """The rows `index` (R,)."""
        return JointTargets(self.xyz[index], self.information[index])

    def with_rows(self, index: NDArray[np.intp], other: "JointTargets") -> "JointTargets":
        """The same, with the rows `index` (R,) from `other`."""
        xyz, information = self.xyz.copy(), self.information.copy()
        xyz[index], information[index] = other.xyz, other.information
        return JointTargets(xyz, information)


@dataclass(frozen=True)
class BodyFit:
    """The bodies of B rows.

    A row whose status is not OK has NaN joints and covariances and zero parameters: parameters are never NaN.
    """

    betas: NDArray[np.float64]
    """(B, 10) shape, in standard deviations."""
    global_orient: NDArray[np.float64]
    """(B, 3) rotation of the root, axis-angle, rad."""
    body_pose: NDArray[np.float64]
    """(B, 23, 3) rotations of the other joints relative to their parents, axis-angle, rad."""
    transl: NDArray[np.float64]
    """(B, 3) translation, metres."""
    joints: NDArray[np.float64]
    """(B, J, 3) the body's own joints in the detector's skeleton, world, metres."""
    covariance: NDArray[np.float64]
    """(B, J, 3, 3) covariance of `joints` given all targets, m² (Laplace)."""
    prior_xyz: NDArray[np.float64]
    """(B, J, 3) where the body puts each joint *without* that joint's own target, metres."""
    prior_covariance: NDArray[np.float64]
    """(B, J, 3, 3) its covariance as a prediction of the detector's joint: model error included, m²."""
    residual_m: NDArray[np.float64]
    """(B,) weighted root mean square distance of the joints to their targets, metres; NaN where not OK."""
    status: NDArray[np.str_]
    """(B,) a `FitStatus` each."""

    def __len__(self) -> int:
        return len(self.betas)

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(B,) which rows hold a body."""
        return self.status == FitStatus.OK

    def rows(self, index: NDArray[np.intp]) -> "BodyFit":
        """The rows `index` (R,)."""
        return BodyFit(**{field.name: getattr(self, field.name)[index] for field in fields(self)})

    def with_rows(self, index: NDArray[np.intp], other: "BodyFit") -> "BodyFit":
        """The same, with the rows `index` (R,) from `other`."""
        changed = {}
        for field in fields(self):
            values = getattr(self, field.name).copy()
            values[index] = getattr(other, field.name)
            changed[field.name] = values
        return BodyFit(**changed)

    @classmethod
    def failed(cls, status: NDArray[np.str_], num_joints: int) -> "BodyFit":
        """Rows without a body: zero parameters, NaN joints, a copy of the given `status` (B,)."""
        B, J = len(status), num_joints
        return cls(
            betas=np.zeros((B, 10)),
            global_orient=np.zeros((B, 3)),
            body_pose=np.zeros((B, 23, 3)),
            transl=np.zeros((B, 3)),
            joints=np.full((B, J, 3), np.nan),
            covariance=np.full((B, J, 3, 3), np.nan),
            prior_xyz=np.full((B, J, 3), np.nan),
            prior_covariance=np.full((B, J, 3, 3), np.nan),
            residual_m=np.full(B, np.nan),
            status=np.asarray(status).astype(STATUS_TYPE),
        )


class BodyFitter(Protocol):
    """Anything that turns joints into bodies: plain optimisation here, a learned fitter elsewhere."""

    def fit(
        self, targets: JointTargets, initial: BodyFit | None = None, groups: NDArray[np.intp] | None = None
    ) -> BodyFit:
        """Fit a body to every row of `targets`.

        `initial` has one row per target; its OK rows are where the fit may start. `groups` (B,) are whole numbers:
        rows with the same number are one person and get one shape. Otherwise rows do not influence each other.
        """
        ...
