"""Bodies by learned gradient descent (Eq. 5 of the paper): a few steps of a network, then a short polish."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter, PlainFitterConfig
from shapepose_fg.body.fitting.body_sequence import SequenceConfig, SequenceFit, SequenceFitter, Shapes
from shapepose_fg.body.fitting.descent import BodyState, DescentTargets, LearnedDescent
from shapepose_fg.body.fitting.energy import BodyEnergy, Evaluated, Held, WhitenedTargets, robust_weight
from shapepose_fg.body.fitting.evidence import LEAST_JOINTS, EvidenceConfig
from shapepose_fg.body.fitting.fit_rows import RowFitter
from shapepose_fg.body.fitting.fitter import BodyFit, JointTargets
from shapepose_fg.body.fitting.left_out import left_out_sets
from shapepose_fg.body.fitting.motion_prior import MotionPrior
from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.fitting.weights import FitterWeights
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.model.rotation import log_so3
from shapepose_fg.body.model.skinned_points import SkinnedPoints
from shapepose_fg.body.model.target_skeletons import BODY_POINTS, slots
from shapepose_fg.core.bounds import Factor, RepeatsOrNone, Settings

Array = NDArray[np.float64]

_STALE = 0.3
"""Change of a joint's robust weight, in a step, from which on a row is linearised anew after it."""
_WELL_SEEN_M = 0.05
"""Sigma of a joint, metres, from which on the network is not shown it."""


@dataclass(frozen=True)
class LearnedFitterConfig(Settings):
    """Settings of `LearnedFitter`."""

    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    """How targets are judged and weighed."""
    sequence: SequenceConfig = field(default_factory=SequenceConfig)
    """How bodies are fitted over time."""
    kernel_scale: Factor = 6.0
    """Mahalanobis distance at which the Geman-McClure kernel has cut a joint's weight to a quarter."""
    polish_steps: RepeatsOrNone = 1
    """Gauss-Newton steps after the network's, held by the pose prior around where the network arrived. On
    validation subjects the first takes clean joints from 5.2 to 2.6 mm; a second changes nothing."""
    unfinished: Factor = 30.0
    """Rows whose energy another step would still lower by more are left to the plain optimiser: some in a hundred
    whose joints contradict each other, such as those of two people."""


class LearnedFitter:
    """Fits a body to 3D joints by learned gradient descent; implements `BodyFitter`.

    Rows are independent, but for the shape of rows in one group; one that a short polish does not settle is fitted
    by the plain optimiser instead, with a shape of its own. Computed in single precision around each row's
    centre, covariances in double.
    """

    def __init__(
        self,
        model: BodyModel | None = None,
        pose_prior: PosePrior | None = None,
        config: LearnedFitterConfig | None = None,
        weights: FitterWeights | Path | None = None,
    ):
        model = BodyModel.default() if model is None else model
        prior = PosePrior.default() if pose_prior is None else pose_prior
        self.config = LearnedFitterConfig() if config is None else config
        self.weights = FitterWeights.default() if weights is None else FitterWeights.of(weights)
        self.weights.check(model)
        self.model = model
        """The body."""
        self._prior = prior
        self._model = model.to(torch.float32)
        self._energy = BodyEnergy(self._model, prior)
        plain = PlainFitterConfig(evidence=self.config.evidence, kernel_scale=self.config.kernel_scale)
        self._plain = LevenbergMarquardtFitter(model, prior, plain)
        self._slots = slots(model.keypoint_names)
        sets = left_out_sets(self._energy, prior)
        spread = self.weights.spread[list(self._slots)].double().numpy()
        self._rows = RowFitter(
            self._energy, self, sets, self.config.evidence, self.config.unfinished, spread, fallback=self._plain
        )
        self._descent = LearnedDescent(
            self._model.keypoint_points, self._slots, self.weights.network, self.config.kernel_scale,
            others=_other_points(self._model, self._slots), offsets=self._model.offsets_of_keypoints,
        )  # fmt: skip

    def with_keypoint_offsets(self, offsets: KeypointOffsets) -> "LearnedFitter":
        """The same fitter for a detector that puts its joints so far from the body's."""
        return LearnedFitter(self.model.with_keypoint_offsets(offsets), self._prior, self.config, self.weights)

    @torch.inference_mode()
    def fit(
        self, targets: JointTargets, initial: BodyFit | None = None, groups: NDArray[np.intp] | None = None
    ) -> BodyFit:
        """Fit a body to every row of `targets`; see `BodyFit` for what comes back.

        `initial` is not needed: a few steps from the closed form arrive where a warm start would, and two fits to
        the same targets are the same fit.
        """
        return self._rows.fit(targets, None, groups)

    @torch.inference_mode()
    def fit_whole(self, targets: JointTargets, initial: BodyFit | None = None) -> BodyFit:
        """The same bodies in a fraction of the time, without `prior_xyz` and `prior_covariance`, which are NaN."""
        return self._rows.fit(targets, None, None, leave_out=False)

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
        """One shape per group and poses that move as people do, over time.

        Parameters
        ----------
        targets: of B rows: where a person's joints are, and how surely, in one frame each.
        groups: (B,) whole numbers: who.
        time_s: (B,) when, seconds. Rows of a group more than `sequence.gap_s` apart are not linked.
        shapes: what is known of the shape of each group, in the order of `np.unique(groups)`; None: nothing.
        fixed_shapes: keep the means of `shapes`.

        Rows with too few joints follow those before and after; ValueError where a group has two rows at one time.
        """
        motion, config = MotionPrior.default(), self.config.sequence
        sequence = SequenceFitter(self._rows, motion, self.config.kernel_scale, config)
        return sequence.fit(targets, groups, time_s, shapes, fixed_shapes=fixed_shapes)

    def arrive(
        self, targets: WhitenedTargets, variance: Array, start: Tensor | None = None
    ) -> tuple[Tensor, Held]:
        """See `Optimiser`: where the network arrives, and held there."""
        arrived = self._descend(targets, torch.from_numpy(variance).float())
        return arrived, Held(arrived[:, :10], torch.ones(len(arrived), 1), arrived[:, 13:-3].clone())

    def first(
        self, targets: WhitenedTargets, variance: Array, start: Tensor | None = None
    ) -> tuple[Evaluated, Held]:
        """See `Optimiser`: a short polish from where the network arrived."""
        arrived, held = self.arrive(targets, variance, start)
        return self.again(arrived, targets, held), held

    def again(self, free: Tensor, targets: WhitenedTargets, held: Held) -> Evaluated:
        """Gauss-Newton steps from `free` (B, P); one that does not lower a row's energy is not taken.

        The energy is linearised before each step. After the last, only rows are in which the weight of some joint
        changed: covariances hardly change otherwise, and a linearisation is a quarter of the whole cost.
        """
        scale = torch.tensor(self.config.kernel_scale)
        body = self._energy.evaluate(free, targets, scale, held)
        for _ in range(self.config.polish_steps):
            before = robust_weight(body.here.squared, scale)
            there = self._energy.retract(body.free, body.step)
            slope = self._energy.slope(there, targets, scale, held)
            better = slope.energy(scale) < body.here.energy(scale)  # a step into NaN is not
            body = body.moved(better, there, slope)
            change = (robust_weight(body.here.squared, scale) - before).abs().amax(1)
            stale = torch.nonzero(change > _STALE)[:, 0]
            if len(stale) > 0:
                body.put(stale, self._energy.evaluate(body.free[stale], targets[stale], scale, held[stale]))
        return body

    def _descend(self, targets: WhitenedTargets, variance: Tensor) -> Tensor:
        """Free parameters (M, P) of `BodyEnergy` where the network arrives, from the closed form on."""
        frame, count = self.weights.frame, len(targets.xyz)
        rotation, origin = frame.place(targets.xyz, variance, self._slots)
        inside = (targets.xyz - origin[:, None]) @ rotation
        # What is hardly seen is left to the polish: the pull of a guess that had seen it would count it twice.
        well_seen = variance < _WELL_SEEN_M**2
        well_seen |= (well_seen.sum(1) < LEAST_JOINTS)[:, None]
        root = targets.root @ rotation[:, None] * well_seen[..., None, None]
        state = BodyState(
            torch.zeros(count, 10), frame.local.expand(count, 24, 3, 3), frame.transl.expand(count, 3)
        )
        *_, arrived = self._descent.unroll(state, DescentTargets(inside, root.mT @ root))
        return self._free(arrived, rotation, origin)

    def _free(self, state: BodyState, rotation: Tensor, origin: Tensor) -> Tensor:
        """A state in the person's frame as free parameters of the energy, in the frame of the targets."""
        orient = log_so3(rotation @ state.local[:, 0])
        angles = log_so3(state.local[:, 1:]).flatten(1)[:, self._energy.angles]
        # The root turns about the pelvis: R (v - p) + p + transl, with p where betas put it in the T-pose.
        pelvis = self._model.rest_pelvis(state.betas)
        transl = (rotation @ (pelvis + state.transl)[..., None]).squeeze(-1) + origin - pelvis
        return torch.cat((state.betas, orient, angles, transl), 1)


def _other_points(model: BodyModel, targets: tuple[int, ...]) -> SkinnedPoints | None:
    """The body's own points at the places (K,) where there are no `targets`; None where there are no such."""
    rest = [place for place in range(len(BODY_POINTS)) if place not in targets]
    body = model.with_keypoint_offsets(KeypointOffsets.identity()) if model.keypoint_offsets.xyz_m.any() else model
    return body.points.part(rest) if rest else None
