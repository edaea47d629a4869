"""From 3D joints to bodies: what a fitter is given, its settings, what it gives back, what may replace it."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, get_args

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.bounds import Factor, Metres, RepeatsOrNone, Seconds, Settings
from shapepose_fg.core.rows import Rows

if TYPE_CHECKING:
    from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
    from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets


Method = Literal["auto", "learned", "plain"]
_ONE_TABLE = (
    "is one with [body] now, which has model_sigma_m, kernel_scale, polish_steps, unfinished, gap_s and"
    " correlation_s (lasting_s before); its other settings are constants"
)


@dataclass(frozen=True)
class BodyConfig(Settings):
    """How bodies are fitted."""

    method: str = "auto"
    """"learned": learned gradient descent; "plain": Levenberg-Marquardt; "auto": learned where there are weights
    for the body at hand, plain on any other body."""
    weights: str = ""
    """File of the network's weights; empty: those that come with the package, or that `shapepose-fg train-fitter`
    made for another body."""
    model_sigma_m: Metres = 0.02
    """How far the detector's joints lie from the body's, metres: added to every target's covariance."""
    kernel_scale: Factor = 6.0
    """Mahalanobis distance at which the Geman-McClure kernel has cut a joint's weight to a quarter."""
    polish_steps: RepeatsOrNone = 1
    """Gauss-Newton steps after the network's, held by the pose prior around where the network arrived. On
    validation subjects the first takes clean joints from 5.2 to 2.6 mm; a second changes nothing."""
    unfinished: Factor = 30.0
    """Rows that the network leaves so that another step would lower their energy by more are fitted by the plain
    optimiser: some in a hundred whose joints contradict each other, such as those of two people."""
    gap_s: Seconds = 1.0
    """Bodies over time: rows of a person that are farther apart are not linked."""
    correlation_s: Annotated[float, Interval(gt=0, le=3600)] = 1.5
    """Bodies over time: how long errors of targets stay correlated, seconds; rows within that time tell of the
    shape as one. On real detections of a static camera the correlation is 0.83 after 0.04 s, 0.63 after 0.2 s and
    0.40 after 1 s."""

    replaced: ClassVar[dict[str, str]] = {"learned": _ONE_TABLE, "plain": _ONE_TABLE}
    """Settings of before, and what took their place."""

    @classmethod
    def paper(cls) -> "BodyConfig":
        """As written in Eq. 6: the network's steps, and nothing after them."""
        return cls(polish_steps=0, unfinished=1e6)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method not in get_args(Method):
            raise ValueError(f"method must be one of {' '.join(get_args(Method))}, got {self.method!r}")


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
"""Type of arrays that hold any `FitStatus`; NumPy would cut longer texts off in a type inferred from one."""


@dataclass(frozen=True)
class JointTargets(Rows):
    """Where the joints of B people (rows: people, frames or both) should be, and how surely."""

    xyz: Array
    """(B, J, 3) target of each joint in the world, metres; ignored where the information is zero."""
    information: Array
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

    @classmethod
    def solved(cls, joints: Array, covariance: Array) -> "JointTargets":
        """Targets at `joints` (B, J, 3), metres, known to `covariance` (B, J, 3, 3); none where either is NaN."""
        known = np.asarray(np.isfinite(joints).all(axis=-1) & np.isfinite(covariance).all(axis=(-2, -1)))
        information = np.zeros(covariance.shape)
        information[known] = np.linalg.inv(covariance[known])
        return cls(np.where(known[..., None], joints, 0.0), (information + information.mT) / 2)

    @property
    def known(self) -> Mask:
        """(B, J) joints that have a target."""
        return np.asarray(self.information.any(axis=(2, 3)))

    def where(self, chosen: Mask, times: float = 1.0) -> "JointTargets":
        """The targets of the `chosen` (B, J) joints, their information `times` this number; none for others."""
        chosen = chosen & self.known
        information = np.where(chosen[..., None, None], self.information * times, 0.0)
        return JointTargets(np.where(chosen[..., None], self.xyz, 0.0), information)

    def larger(self, size: Array) -> "JointTargets":
        """Return the targets with people and world scaled by `size` (B,)."""
        size = size[:, None, None]
        return JointTargets(self.xyz * size, self.information / size[..., None] ** 2)


@dataclass(frozen=True)
class BodyFit(Rows):
    """The bodies of B rows.

    A row whose status is not OK has NaN joints and covariances and zero parameters: parameters are never NaN.
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
    prior_xyz: Array
    """(B, J, 3) where the body puts each joint *without* that joint's own target, metres."""
    prior_covariance: Array
    """(B, J, 3, 3) its covariance as a prediction of the detector's joint: model error included, m²."""
    residual_m: Array
    """(B,) weighted root mean square distance of the joints to their targets, metres; NaN where not OK."""
    status: NDArray[np.str_]
    """(B,) a `FitStatus` each."""

    @property
    def ok(self) -> Mask:
        """(B,) which rows hold a body."""
        return self.status == FitStatus.OK

    @classmethod
    def failed(cls, status: NDArray[np.str_], num_joints: int) -> "BodyFit":
        """Rows without a body: zero parameters, NaN joints, a copy of the given `status` (B,)."""
        B, J = len(status), num_joints
        zeros, unknown = ((10,), (3,), (23, 3), (3,)), ((J, 3), (J, 3, 3), (J, 3), (J, 3, 3), ())
        columns = [np.zeros((B, *shape)) for shape in zeros] + [np.full((B, *shape), np.nan) for shape in unknown]
        return cls(*columns, status=np.asarray(status).astype(STATUS_TYPE))

    def put_bodies(self, index: Index, body: "BodyParameters", origin: Array) -> None:
        """Write bodies (R) that were found around `origin` (R, 3), metres, over the rows `index` (R,)."""
        for name in ("betas", "global_orient", "body_pose"):
            getattr(self, name)[index] = getattr(body, name)
        self.transl[index] = body.transl + origin


@dataclass(frozen=True)
class Shapes:
    """What is known of the shapes of G people: a Gaussian over the betas of each."""

    mean: Array
    """(G, 10) in standard deviations over adults."""
    information: Array
    """(G, 10, 10) inverse covariances. Those of an unknown person are the identity around 0."""

    def __post_init__(self) -> None:
        if self.mean.ndim != 2 or self.mean.shape[1] != 10 or self.information.shape != (*self.mean.shape, 10):
            shapes = f"{self.mean.shape} and {self.information.shape}"
            raise ValueError(f"mean and information must be (G, 10) and (G, 10, 10), got {shapes}")

    @classmethod
    def unknown(cls, count: int) -> "Shapes":
        """Shapes of `count` people who were never seen: adults."""
        return cls(np.zeros((count, 10)), np.tile(np.eye(10), (count, 1, 1)))


@dataclass(frozen=True)
class SequenceFit:
    """Bodies of B rows, and what is known of their shapes."""

    fit: BodyFit
    """The bodies. `covariance` is what a row's own targets say at the shape of its group: correlated errors are
    not averaged out. `prior_xyz` and `prior_covariance` are NaN: they are `fit`'s."""
    groups: Index
    """(G,) the groups, in order."""
    shapes: Shapes
    """(G) their shapes given everything, what was known before included: the prior of their next recording."""


class BodyFitter(ABC):
    """Anything that turns joints into bodies. Your own inherits from this and has `fit`, the rest is optional."""

    model: "BodyModel | None" = None
    """The body that it fits. A fitter that has one has `with_keypoint_offsets` and `fit_sequence`, too; without,
    the detector's offsets are not learnt, and there is no one body for each person over time."""

    @abstractmethod
    def fit(self, targets: JointTargets, initial: BodyFit | None = None, groups: Index | None = None) -> BodyFit:
        """Fit a body to every row of `targets`.

        `initial` has one row per target; its OK rows are where the fit may start. `groups` (B,) are whole numbers:
        rows with the same number are one person and get one shape. Otherwise rows do not influence each other.
        """

    def fit_whole(self, targets: JointTargets, initial: BodyFit | None = None) -> BodyFit:
        """Fit as `fit` does, but faster: `prior_xyz` and `prior_covariance` may be NaN."""
        return self.fit(targets, initial)

    def with_keypoint_offsets(self, offsets: "KeypointOffsets") -> "BodyFitter":
        """Return a fitter for a detector whose joints have these offsets from the body's."""
        raise NotImplementedError(f"{type(self).__name__} has a model and no with_keypoint_offsets")

    def fit_sequence(
        self,
        targets: JointTargets,
        groups: Index,
        time_s: Array,
        shapes: Shapes | None = None,
        *,
        fixed_shapes: bool = False,
    ) -> SequenceFit:
        """One shape per group and poses that move as people do, over time.

        Parameters
        ----------
        targets: of B rows: where a person's joints are, and how surely, in one frame each.
        groups: (B,) whole numbers: who.
        time_s: (B,) when, seconds. Rows of a group more than `gap_s` apart are not linked.
        shapes: what is known of the shape of each group, in the order of `np.unique(groups)`; None: nothing.
        fixed_shapes: keep the means of `shapes`.

        Rows with too few joints follow those before and after; ValueError where a group has two rows at one time.
        """
        raise NotImplementedError(f"{type(self).__name__} has a model and no fit_sequence")


def check_fitter(fitter: object) -> None:
    """TypeError where `fitter` is no `BodyFitter`."""
    if not isinstance(fitter, BodyFitter):
        raise TypeError(
            f"{type(fitter).__name__} must inherit from shapepose_fg.body.fitting.fitter.BodyFitter, which makes"
            " the other methods of a fitter from `fit`"
        )


def check_groups(groups: Index, rows: int) -> Index:
    """`groups` if it is one whole number a row; ValueError otherwise."""
    groups = np.asarray(groups)
    if groups.shape != (rows,) or groups.dtype.kind not in "iu":
        raise ValueError(f"groups must be {rows} whole numbers, one a row, got {groups.dtype} {groups.shape}")
    return groups
