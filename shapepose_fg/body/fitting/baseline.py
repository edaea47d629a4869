"""Bodies by plain optimisation: the SMPLify-style comparison, Levenberg-Marquardt over many rows at once."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import torch
from annotated_types import Interval
from numpy.typing import NDArray
from torch import Tensor

from shapepose_fg.body.fitting.body_sequence import SequenceConfig, SequenceFit, SequenceFitter, Shapes
from shapepose_fg.body.fitting.energy import BodyEnergy, Evaluated, Held, Linearisation, WhitenedTargets
from shapepose_fg.body.fitting.evidence import EvidenceConfig
from shapepose_fg.body.fitting.fit_rows import RowFitter
from shapepose_fg.body.fitting.fitter import BodyFit, JointTargets
from shapepose_fg.body.fitting.left_out import left_out_sets
from shapepose_fg.body.fitting.motion_prior import MotionPrior
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.model.rotation import log_so3
from shapepose_fg.body.model.target_skeletons import slots
from shapepose_fg.core.bounds import Factor, Settings

Array = NDArray[np.float64]

_SPREAD = {"RWrist": 2.0, "LWrist": 2.0}
"""Multiplies the variance of joints without their own target. Elbows bend farther from their mean than a Gaussian
says: without it, 85 % of the wrists of the validation subjects (training.split) lay in their 90 % ellipsoids."""
ANNEAL_STEPS = 2
"""From a cold start the kernel begins 2^ANNEAL_STEPS times as wide, and is halved every iteration."""
_DAMPING_START, _DAMPING_MIN, _DAMPING_MAX = 1e-3, 1e-7, 1e7


@dataclass(frozen=True)
class PlainFitterConfig(Settings):
    """Settings of `LevenbergMarquardtFitter`."""

    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    """How targets are judged and weighed."""
    sequence: SequenceConfig = field(default_factory=SequenceConfig)
    """How bodies are fitted over time."""
    kernel_scale: Factor = 6.0
    """Mahalanobis distance at which the Geman-McClure kernel has cut a joint's weight to a quarter."""
    max_iterations: Annotated[int, Interval(ge=1, le=1000)] = 40
    """Levenberg-Marquardt steps, refused ones included."""
    tolerance: Factor = 1e-2
    """A row is done when a step lowers its energy (in squared standard deviations) by less."""
    unfinished: Factor = 9.0
    """Rows whose energy a Newton step would still lower by more (3 sigma of the posterior) are NOT_CONVERGED."""


class LevenbergMarquardtFitter:
    """Fits a body to 3D joints by minimising `BodyEnergy`; implements `BodyFitter`.

    Rows are independent: a row comes out the same alone and in a batch, up to rounding. The body and its
    derivatives are computed in single precision around each row's centre, covariances in double precision
    from them: within 1e-4 of all-double ones, at half the cost.
    """

    def __init__(
        self,
        model: BodyModel | None = None,
        pose_prior: PosePrior | None = None,
        config: PlainFitterConfig | None = None,
    ):
        model = BodyModel.default() if model is None else model
        prior = PosePrior.default() if pose_prior is None else pose_prior
        self.config = PlainFitterConfig() if config is None else config
        self.model, self._prior = model, prior
        self._frame = PersonFrame.of_angles(model, prior.mean, prior.covariance)
        self._slots = slots(model.keypoint_names)
        self._energy = BodyEnergy(model.to(torch.float32), prior)
        self._mean_angles = prior.mean[self._energy.angles]
        sets = left_out_sets(self._energy, prior)
        spread = np.array([_SPREAD.get(name, 1.0) for name in model.keypoint_names])
        self._rows = RowFitter(self._energy, self, sets, self.config.evidence, self.config.unfinished, spread)

    def with_keypoint_offsets(self, offsets: KeypointOffsets) -> "LevenbergMarquardtFitter":
        """The same fitter for a detector that puts its joints `offsets` away from the body's."""
        return LevenbergMarquardtFitter(self.model.with_keypoint_offsets(offsets), self._prior, self.config)

    @torch.inference_mode()
    def fit(
        self, targets: JointTargets, initial: BodyFit | None = None, groups: NDArray[np.intp] | None = None
    ) -> BodyFit:
        """Fit a body to every row of `targets`; see `BodyFit` for what comes back.

        OK rows of `initial` (as many rows as targets) are warm starts: no closed form, no annealing. Passes that
        leave targets out start cold.
        """
        return self._rows.fit(targets, initial, groups)

    @torch.inference_mode()
    def fit_whole(self, targets: JointTargets, initial: BodyFit | None = None) -> BodyFit:
        """The same bodies in a fraction of the time, without `prior_xyz` and `prior_covariance`, which are NaN."""
        return self._rows.fit(targets, initial, None, leave_out=False)

    @torch.inference_mode()
    def fit_sequence(
        self,
        targets: JointTargets,
        groups: NDArray[np.intp],
        time_s: Array,
        shapes: Shapes | None = None,
        *,
        fixed_shapes: bool = False,
    ) -> SequenceFit:
        """See `LearnedFitter.fit_sequence`."""
        motion, config = MotionPrior.default(), self.config.sequence
        sequence = SequenceFitter(self._rows, motion, self.config.kernel_scale, config)
        return sequence.fit(targets, groups, time_s, shapes, fixed_shapes=fixed_shapes)

    def arrive(
        self, targets: WhitenedTargets, variance: Array, start: Tensor | None = None
    ) -> tuple[Tensor, Held]:
        """See `Optimiser`: the optimum, with each row's own shape."""
        body, held = self.first(targets, variance, start)
        return body.free, held

    def first(
        self, targets: WhitenedTargets, variance: Array, start: Tensor | None = None
    ) -> tuple[Evaluated, Held]:
        """See `Optimiser`: held by the priors."""
        free, warm = self._start(targets.xyz, variance), np.zeros(len(variance), dtype=bool)
        if start is not None:
            warm = ~start.isnan().any(1).numpy()
            free = torch.where(start.isnan(), free, start)
        held = Held.by_priors()
        return self._evaluated(self._solve(free, targets, warm), targets, held), held

    def again(self, free: Tensor, targets: WhitenedTargets, held: Held) -> Evaluated:
        """See `Optimiser`."""
        return self._evaluated(self._solve(free, targets, np.ones(len(free), dtype=bool), held), targets, held)

    def _evaluated(self, free: Tensor, targets: WhitenedTargets, held: Held) -> Evaluated:
        return self._energy.evaluate(free, targets, torch.tensor(self.config.kernel_scale), held)

    def _start(self, xyz: Tensor, variance: Array) -> Tensor:
        """Free parameters (B, P) from the closed form, for targets (B, J, 3) of these variances (B, J)."""
        rotation, pelvis = self._frame.place(xyz.double(), torch.from_numpy(variance), self._slots)
        angles = torch.from_numpy(self._mean_angles).expand(len(xyz), -1)
        parts = (angles.new_zeros(len(xyz), 10), log_so3(rotation), angles, pelvis + self._frame.transl)
        return torch.cat(parts, 1).float()

    def _solve(
        self, free: Tensor, targets: WhitenedTargets, warm: NDArray[np.bool_], held: Held | None = None
    ) -> Tensor:
        """Minimise from `free` (B, P); rows leave the batch as they finish. Returns (B, P)."""
        config, energy = self.config, self._energy
        result, rows = free.clone(), torch.arange(len(free))
        widening = torch.where(torch.from_numpy(warm), 0, ANNEAL_STEPS)[:, None]
        damping = torch.full((len(free),), _DAMPING_START)
        here = energy.linearise(free, targets, config.kernel_scale * 2.0**widening, held)
        for _ in range(config.max_iterations):
            step, promised = _damped_step(here, damping)
            trial = energy.retract(free, step)
            scale, annealed = config.kernel_scale * 2.0**widening, widening[:, 0] == 0
            widening = (widening - 1).clamp_min(0)
            there = energy.linearise(trial, targets, config.kernel_scale * 2.0**widening, held)
            gain = here.energy(scale) - there.energy(scale)
            better = gain > 0  # a step into NaN is not
            here, free = here.replaced(better, there), torch.where(better[:, None], trial, free)
            damping = _next_damping(damping, better, gain / promised)
            settled = torch.where(better, gain, promised) < config.tolerance
            going = ~(annealed & settled) & (damping < _DAMPING_MAX)
            if bool(going.all()):
                continue
            result[rows[~going]] = free[~going]
            rows, free, damping, widening = rows[going], free[going], damping[going], widening[going]
            here, targets = here[going], targets[going]
            held = None if held is None else held[going]
            if len(rows) == 0:
                break
        result[rows] = free
        return result


def _damped_step(here: Linearisation, damping: Tensor) -> tuple[Tensor, Tensor]:
    """The Levenberg-Marquardt step (B, P), and the fall in energy (B,) that the linearisation promises."""
    added = damping[:, None] * torch.diagonal(here.hessian, dim1=-2, dim2=-1)
    factor, _ = torch.linalg.cholesky_ex(here.hessian + torch.diag_embed(added))
    step = -torch.cholesky_solve(here.gradient[..., None], factor).squeeze(-1)
    return step, (step * (added * step - here.gradient)).sum(-1)


def _next_damping(damping: Tensor, better: Tensor, ratio: Tensor) -> Tensor:
    """Nielsen's rule for steps that gained `ratio` of what they promised; eightfold after a refusal."""
    factor = torch.where(better, (1 - (2 * ratio - 1) ** 3).clamp(0.1, 2.0), 8.0)
    return (damping * factor).clamp(_DAMPING_MIN, _DAMPING_MAX)
