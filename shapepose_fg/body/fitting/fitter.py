"""Interface of body fitters: targets, settings, results, and the base class."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.bounds import Factor, Metres, RepeatsOrNone, Settings
from shapepose_fg.core.rows import Rows

if TYPE_CHECKING:
    from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
    from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets


Method = Literal["auto", "learned", "plain"]
_ONE_TABLE = (
    "is part of [body] now, with model_sigma_m, kernel_scale, polish_steps and unfinished; "
    "its other settings are constants"
)
_IN_WINDOWS = "was removed: bodies over time are those of the windows"


@dataclass(frozen=True)
class BodyConfig(Settings):
    """Settings of body fitting."""

    method: str = "auto"
    """"learned": learned gradient descent; "plain": Levenberg-Marquardt; "auto": learned if there
    are weights for the given body, else plain."""
    weights: str = ""
    """File with the network's weights; empty: those of the package, or those that `shapepose-fg
    train-fitter` made for another body."""
    model_sigma_m: Metres = 0.02
    """Standard deviation between the detector's and the body's joints, metres; added to every
    target's covariance."""
    kernel_scale: Factor = 6.0
    """Mahalanobis distance at which the Geman-McClure kernel reduces a joint's weight
    to a quarter."""
    polish_steps: RepeatsOrNone = 1
    """Gauss-Newton steps after the network's, with the pose prior centred at the network's result.
    On validation subjects the first reduces the error on clean joints from 5.2 to 2.6 mm; a second
    changes nothing."""
    unfinished: Factor = 30.0
    """Maximum decrease of the energy that a further step predicts; rows above it are fitted by the
    plain optimiser: a few in a hundred with contradictory joints, e.g. of two people."""

    replaced: ClassVar[dict[str, str]] = {
        "learned": _ONE_TABLE,
        "plain": _ONE_TABLE,
        "gap_s": _IN_WINDOWS,
        "correlation_s": _IN_WINDOWS,
    }
    """Obsolete settings, and what replaces them."""

    @classmethod
    def paper(cls) -> "BodyConfig":
        """The settings of Eq. 6: the network's steps only."""
        return cls(polish_steps=0, unfinished=1e6)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method not in get_args(Method):
            raise ValueError(
                f"method must be one of {' '.join(get_args(Method))}, got {self.method!r}"
            )


class FitStatus(StrEnum):
    """Outcome of the fit of a row."""

    OK = "ok"
    INVALID_TARGETS = "invalid_targets"
    """A target with information is not finite, or information is not positive semi-definite."""
    TOO_FEW_JOINTS = "too_few_joints"
    """Too few joints with full information, or all on one line: the rotation about it is
    undetermined."""
    NOT_CONVERGED = "not_converged"
    """The energy was still decreasing at the last iteration, or became non-finite."""


STATUS_TYPE = np.dtype(f"U{max(map(len, FitStatus))}")
"""NumPy type for any `FitStatus`; a type inferred from one text would truncate longer ones."""


@dataclass(frozen=True)
class JointTargets(Rows):
    """Target positions with information for the joints of B rows (people, frames or both)."""

    xyz: Array
    """(B, J, 3) target of each joint in the world, metres; ignored where the information is
    zero."""
    information: Array
    """(B, J, 3, 3) inverse covariance of each target, 1/m², symmetric and positive *semi*-definite.
    Zero for an unseen joint, rank 2 for one seen by a single view (a ray), full otherwise."""

    def __post_init__(self) -> None:
        xyz = np.asarray(self.xyz, dtype=np.float64)
        information = np.asarray(self.information, dtype=np.float64)
        if xyz.ndim != 3 or xyz.shape[-1] != 3:
            raise ValueError(f"xyz must be (B, J, 3), got {xyz.shape}")
        if information.shape != (*xyz.shape, 3):
            raise ValueError(
                f"information must be {(*xyz.shape, 3)} like xyz, got {information.shape}"
            )
        object.__setattr__(self, "xyz", xyz)
        object.__setattr__(self, "information", information)

    @classmethod
    def solved(cls, joints: Array, covariance: Array) -> "JointTargets":
        """Targets at `joints` (B, J, 3), metres, with covariance (B, J, 3, 3); none where either is
        NaN.
        """
        known = np.asarray(
            np.isfinite(joints).all(axis=-1) & np.isfinite(covariance).all(axis=(-2, -1))
        )
        information = np.zeros(covariance.shape)
        information[known] = np.linalg.inv(covariance[known])
        return cls(np.where(known[..., None], joints, 0.0), (information + information.mT) / 2)

    @property
    def known(self) -> Mask:
        """(B, J) joints that have a target."""
        return np.asarray(self.information.any(axis=(2, 3)))

    def where(self, chosen: Mask, times: float = 1.0) -> "JointTargets":
        """The targets of the `chosen` (B, J) joints, with information multiplied by `times`; none
        for others.
        """
        chosen = chosen & self.known
        information = np.where(chosen[..., None, None], self.information * times, 0.0)
        return JointTargets(np.where(chosen[..., None], self.xyz, 0.0), information)

    def larger(self, size: Array) -> "JointTargets":
        """Return the targets with all lengths scaled by `size` (B,)."""
        size = size[:, None, None]
        return JointTargets(self.xyz * size, self.information / size[..., None] ** 2)


@dataclass(frozen=True)
class BodyFit(Rows):
    """Bodies fitted to B rows.

    A row with a status other than OK has NaN joints and covariances and zero parameters: parameters
    are never NaN.
    """

    betas: Array
    """(B, 10) shape, in standard deviations."""
    global_orient: Array
    """(B, 3) rotation of the root, axis-angle, rad."""
    body_pose: Array
    """(B, 23, 3) rotations of the other joints relative to their parents, axis-angle, rad."""
    transl: Array
    """(B, 3) translation, metres."""
    joints: Array
    """(B, J, 3) the body's own joints in the detector's skeleton, world, metres."""
    covariance: Array
    """(B, J, 3, 3) covariance of `joints` given all targets, m² (Laplace)."""
    residual_m: Array
    """(B,) weighted root mean square distance of the joints to their targets, metres; NaN where not
    OK."""
    status: NDArray[np.str_]
    """(B,) `FitStatus` of each row."""

    @property
    def ok(self) -> Mask:
        """(B,) mask of the rows with a body."""
        return self.status == FitStatus.OK

    @classmethod
    def failed(cls, status: NDArray[np.str_], num_joints: int) -> "BodyFit":
        """Rows without a body: zero parameters, NaN joints, a copy of the given `status` (B,)."""
        B, J = len(status), num_joints
        zeros, unknown = ((10,), (3,), (23, 3), (3,)), ((J, 3), (J, 3, 3), ())
        columns = [np.zeros((B, *shape)) for shape in zeros] + [
            np.full((B, *shape), np.nan) for shape in unknown
        ]
        return cls(*columns, status=np.asarray(status).astype(STATUS_TYPE))

    def put_bodies(self, index: Index, body: "BodyParameters", origin: Array) -> None:
        """Write bodies (R), fitted relative to `origin` (R, 3), metres, to the rows
        `index` (R,).
        """
        for name in ("betas", "global_orient", "body_pose"):
            getattr(self, name)[index] = getattr(body, name)
        self.transl[index] = body.transl + origin


class BodyFitter(ABC):
    """Base class of body fitters. Your own must define `fit`; the rest is optional."""

    model: "BodyModel | None" = None
    """The body model. A fitter with one must define `with_keypoint_offsets`, too; without one,
    bodies are not in the factor graph, the detector's offsets are not estimated, and people have no
    common shape over time."""

    @abstractmethod
    def fit(self, targets: JointTargets, initial: BodyFit | None = None) -> BodyFit:
        """Fit a body to every row of `targets`; rows must not influence each other.

        `initial` has one row per target; the fit may start at its OK rows.
        """

    def with_keypoint_offsets(self, offsets: "KeypointOffsets") -> "BodyFitter":
        """Return a fitter for a detector whose joints have these offsets from the body's."""
        raise NotImplementedError(f"{type(self).__name__} has a model and no with_keypoint_offsets")


def check_fitter(fitter: object) -> None:
    """Raise TypeError unless `fitter` is a `BodyFitter`."""
    if not isinstance(fitter, BodyFitter):
        raise TypeError(
            f"{type(fitter).__name__} must inherit from "
            "shapepose_fg.body.fitting.fitter.BodyFitter, which makes the other methods of a "
            "fitter from `fit`"
        )
