"""How one body is fitted to one row of targets: by a network's steps and a polish, or by Levenberg-Marquardt.

Both have `arrive`, from which `again` is short, and `first`, the two in one; rows are independent.
"""

import numpy as np
import torch
from torch import Tensor

from shapepose_fg.body.fitting.descent import BodyState, DescentTargets, LearnedDescent
from shapepose_fg.body.fitting.energy import (
    BodyEnergy,
    Evaluated,
    Held,
    Linearisation,
    WhitenedTargets,
    robust_weight,
)
from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.fitting.weights import FitterWeights
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.model.rotation import log_so3
from shapepose_fg.body.model.target_skeletons import BODY_POINTS, slots
from shapepose_fg.core.arrays import Array, Mask

STALE = 0.3
"""Change of a joint's robust weight, in a step, from which on a row is linearised anew after it."""
WELL_SEEN_M = 0.05
"""Sigma of a joint, metres, from which on the network is not shown it."""
ANNEAL_STEPS = 2
"""From a cold start the kernel begins 2^ANNEAL_STEPS times as wide, and is halved every iteration."""
MAX_ITERATIONS = 40
"""Levenberg-Marquardt steps, refused ones included."""
TOLERANCE = 1e-2
"""A row is done when a step lowers its energy (in squared standard deviations) by less."""
_DAMPING_START, _DAMPING_MIN, _DAMPING_MAX = 1e-3, 1e-7, 1e7


class NetworkDescent:
    """Learned gradient descent (Eq. 5 of the paper) from a closed form, then a short polish; needs no start."""

    def __init__(self, energy: BodyEnergy, weights: FitterWeights, kernel_scale: float, polish_steps: int):
        model = energy.model
        self._energy, self._frame, self._polish_steps = energy, weights.frame, polish_steps
        self._scale, self._slots = torch.tensor(kernel_scale), slots(model.keypoint_names)
        # The body's own points where there are no targets; offsets are the detector's.
        rest = [place for place in range(len(BODY_POINTS)) if place not in self._slots]
        moved = model.keypoint_offsets.xyz_m.any()
        body = model.with_keypoint_offsets(KeypointOffsets.identity()) if moved else model
        self._descent = LearnedDescent(
            model.keypoint_points, self._slots, weights.network, kernel_scale,
            others=body.points.part(rest) if rest else None, offsets=model.offsets_of_keypoints,
        )  # fmt: skip

    def arrive(
        self, targets: WhitenedTargets, variance: Array, start: Tensor | None = None
    ) -> tuple[Tensor, Held]:
        """Parameters (B, P) where the network arrives from the closed form on, and that bodies are held there.

        `variance` (B, J) is that of each target, infinite where it is not known in all directions, m².
        """
        frame, count, sigma2 = self._frame, len(targets.xyz), torch.from_numpy(variance).float()
        rotation, origin = frame.place(targets.xyz, sigma2, self._slots)
        inside = (targets.xyz - origin[:, None]) @ rotation
        # What is hardly seen is left to the polish: the pull of a guess that had seen it would count it twice.
        well_seen = sigma2 < WELL_SEEN_M**2
        well_seen |= (well_seen.sum(1) < LEAST_JOINTS)[:, None]
        root = targets.root @ rotation[:, None] * well_seen[..., None, None]
        state = BodyState(
            torch.zeros(count, 10), frame.local.expand(count, 24, 3, 3), frame.transl.expand(count, 3)
        )
        *_, arrived = self._descent.unroll(state, DescentTargets(inside, root.mT @ root))
        # From the person's frame to that of the targets.
        orient = log_so3(rotation @ arrived.local[:, 0])
        angles = log_so3(arrived.local[:, 1:]).flatten(1)[:, self._energy.angles]
        # The root turns about the pelvis: R (v - p) + p + transl, with p where betas put it in the T-pose.
        pelvis = self._energy.model.rest_pelvis(arrived.betas)
        transl = (rotation @ (pelvis + arrived.transl)[..., None]).squeeze(-1) + origin - pelvis
        free = torch.cat((arrived.betas, orient, angles, transl), 1)
        return free, Held(arrived.betas, torch.ones(count, 1), angles)

    def first(
        self, targets: WhitenedTargets, variance: Array, start: Tensor | None = None
    ) -> tuple[Evaluated, Held]:
        """Bodies (B) after a short polish from where the network arrived, and what they were held by."""
        arrived, held = self.arrive(targets, variance, start)
        return self.again(arrived, targets, held), held

    def again(self, free: Tensor, targets: WhitenedTargets, held: Held) -> Evaluated:
        """Gauss-Newton steps from `free` (B, P); one that does not lower a row's energy is not taken.

        The energy is linearised before each step. After the last, only rows are in which the weight of some joint
        changed: covariances hardly change otherwise, and a linearisation is a quarter of the whole cost.
        """
        scale, energy = self._scale, self._energy
        body = energy.evaluate(free, targets, scale, held)
        for _ in range(self._polish_steps):
            before = robust_weight(body.here.squared, scale)
            there = energy.retract(body.free, body.step)
            slope = energy.slope(there, targets, scale, held)
            better = slope.energy(scale) < body.here.energy(scale)  # a step into NaN is not
            body = body.moved(better, there, slope)
            change = (robust_weight(body.here.squared, scale) - before).abs().amax(1)
            stale = torch.nonzero(change > STALE)[:, 0]
            if len(stale) > 0:
                body.put(stale, energy.evaluate(body.free[stale], targets.rows(stale), scale, held.rows(stale)))
        return body


class LevenbergMarquardt:
    """The optimum of the energy from a closed form: no training, any body."""

    def __init__(self, energy: BodyEnergy, prior: PosePrior, kernel_scale: float):
        self._energy, self._kernel_scale = energy, kernel_scale
        self._slots = slots(energy.model.keypoint_names)
        self._frame = PersonFrame.of_angles(energy.model, prior.mean, prior.covariance)
        self._mean_angles = torch.from_numpy(prior.mean[energy.angles])

    def arrive(
        self, targets: WhitenedTargets, variance: Array, start: Tensor | None = None
    ) -> tuple[Tensor, Held]:
        """The optimum (B, P), each with its own shape, held by the priors; from `start` where that is no NaN."""
        rotation, pelvis = self._frame.place(targets.xyz.double(), torch.from_numpy(variance), self._slots)
        angles = self._mean_angles.expand(len(variance), -1)
        parts = (angles.new_zeros(len(variance), 10), log_so3(rotation), angles, pelvis + self._frame.transl)
        free, warm = torch.cat(parts, 1).float(), np.zeros(len(variance), dtype=bool)
        if start is not None:
            warm = ~start.isnan().any(1).numpy()
            free = torch.where(start.isnan(), free, start)
        held = Held.by_priors(len(free))
        return self.solve(free, targets, warm, held), held

    def first(
        self, targets: WhitenedTargets, variance: Array, start: Tensor | None = None
    ) -> tuple[Evaluated, Held]:
        """The bodies of `arrive`, evaluated."""
        free, held = self.arrive(targets, variance, start)
        return self._energy.evaluate(free, targets, torch.tensor(self._kernel_scale), held), held

    def again(self, free: Tensor, targets: WhitenedTargets, held: Held) -> Evaluated:
        """The optimum from `free` (B, P) on, held by something else."""
        free = self.solve(free, targets, np.ones(len(free), dtype=bool), held)
        return self._energy.evaluate(free, targets, torch.tensor(self._kernel_scale), held)

    def solve(self, free: Tensor, targets: WhitenedTargets, warm: Mask, held: Held) -> Tensor:
        """Minimise from `free` (B, P); rows leave the batch as they finish. Returns (B, P)."""
        energy, kernel_scale = self._energy, self._kernel_scale
        result, rows = free.clone(), torch.arange(len(free))
        widening = torch.where(torch.from_numpy(warm), 0, ANNEAL_STEPS)[:, None]
        damping = torch.full((len(free),), _DAMPING_START)
        here = energy.linearise(free, targets, kernel_scale * 2.0**widening, held)
        for _ in range(MAX_ITERATIONS):
            step, promised = _damped_step(here, damping)
            trial = energy.retract(free, step)
            scale, annealed = kernel_scale * 2.0**widening, widening[:, 0] == 0
            widening = (widening - 1).clamp_min(0)
            there = energy.linearise(trial, targets, kernel_scale * 2.0**widening, held)
            gain = here.energy(scale) - there.energy(scale)
            better = gain > 0  # a step into NaN is not
            here, free = here.replaced(better, there), torch.where(better[:, None], trial, free)
            damping = _next_damping(damping, better, gain / promised)
            settled = torch.where(better, gain, promised) < TOLERANCE
            going = ~(annealed & settled) & (damping < _DAMPING_MAX)
            if bool(going.all()):
                continue
            result[rows[~going]] = free[~going]
            rows, free, damping, widening = rows[going], free[going], damping[going], widening[going]
            here, targets, held = here.rows(going), targets.rows(going), held.rows(going)
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
