"""Optimisers of single rows: network steps with a polish, or Levenberg-Marquardt.

Both have `arrive`, which computes a solution, and `evaluated`, which completes it. Rows are
independent.
"""

import numpy as np

from shapepose_fg.body.fitting.descent import DescentState, LearnedDescent
from shapepose_fg.body.fitting.energy import (
    BodyEnergy,
    EnergyTargets,
    Evaluated,
    Held,
    nothing,
    robust_weight,
)
from shapepose_fg.body.fitting.evidence import LEAST_JOINTS, WELL_SEEN_M
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.fitting.weights import FitterWeights
from shapepose_fg.body.kernels.solving import solved
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.model.rotation import log_so3
from shapepose_fg.body.model.target_skeletons import BODY_POINTS, slots
from shapepose_fg.core.arrays import Array, Mask

STALE = 0.3
"""Change of a joint's robust weight in a step above which the row is linearised again."""
ANNEAL_STEPS = 2
"""Cold starts begin with a kernel 2^ANNEAL_STEPS times as wide, halved in every iteration."""
MAX_ITERATIONS = 40
"""Maximum number of Levenberg-Marquardt steps, rejected ones included."""
TOLERANCE = 1e-2
"""Convergence: decrease of a row's energy in a step, in squared standard deviations."""
_DAMPING_START, _DAMPING_MIN, _DAMPING_MAX = 1e-3, 1e-7, 1e7


class NetworkDescent:
    """Learned gradient descent (Eq. 5 of the paper) from a closed form, then a short polish;
    ignores initial bodies.
    """

    def __init__(
        self, energy: BodyEnergy, weights: FitterWeights, kernel_scale: float, polish_steps: int
    ):
        model = energy.model
        self._energy, self._frame, self._polish_steps = energy, weights.frame, polish_steps
        self._scale, self._slots = kernel_scale, slots(model.keypoint_names)
        # Points without targets are the body's own; offsets apply to the detector's points only.
        rest = [place for place in range(len(BODY_POINTS)) if place not in self._slots]
        moved = model.keypoint_offsets.xyz_m.any()
        body = model.with_keypoint_offsets(KeypointOffsets.identity()) if moved else model
        self._descent = LearnedDescent(
            model.keypoint_points, self._slots, weights.network, kernel_scale,
            others=body.points.part(rest) if rest else None, offsets=model.offsets_of_keypoints,
        )  # fmt: skip

    def arrive(
        self, targets: EnergyTargets, variance: Array, start: Array | None = None
    ) -> tuple[Array, Held]:
        """Parameters (B, P) after the network's steps, which begin at the closed-form solution, and
        priors centred at them.

        `variance` (B, J) of each target, m², is infinite unless it is known in all directions.
        """
        frame, count = self._frame, len(targets.xyz)
        rotation, origin = frame.place(targets.xyz, variance, self._slots)
        inside = (targets.xyz - origin[:, None]) @ rotation
        # Weakly observed joints are left to the polish: a prior centre that used them would count
        # them twice.
        well_seen = variance < WELL_SEEN_M**2
        well_seen |= (well_seen.sum(1) < LEAST_JOINTS)[:, None]
        information = rotation[:, None].swapaxes(-1, -2) @ targets.information @ rotation[:, None]
        local = np.broadcast_to(frame.local, (count, 24, 3, 3))
        state = DescentState(
            np.zeros((count, 10)), local, np.broadcast_to(frame.transl, (count, 3))
        )
        with np.errstate(all="ignore"):  # divergence gives NaN
            *_, arrived = self._descent.unroll(
                state, inside, information * well_seen[..., None, None]
            )
        # Transform from the person's frame to that of the targets.
        orient = log_so3(rotation @ arrived.local[:, 0])
        angles = log_so3(arrived.local[:, 1:]).reshape(count, -1)[:, self._energy.angles]
        # The root rotates about the pelvis: R (v - p) + p + transl, with p from the betas in
        # T-pose.
        pelvis = self._energy.model.rest_pelvis(arrived.betas)
        transl = (rotation @ (pelvis + arrived.transl)[..., None])[..., 0] + origin - pelvis
        free = np.concatenate((arrived.betas, orient, angles, transl), 1)
        # Size of a beta above which the network has diverged; such rows are fitted by the plain
        # optimiser.
        free[~(np.abs(arrived.betas).max(axis=1) < 50.0)] = np.nan
        return free, Held(arrived.betas, np.ones(count), angles)

    def evaluated(self, free: Array, targets: EnergyTargets, held: Held) -> Evaluated:
        """The bodies of `arrive` (B, P), polished by Gauss-Newton steps, with the energy; a step
        that does not lower a row's energy is rejected.

        The energy is linearised before each step. After the last, it is linearised only for rows in
        which the weight of some joint changed: covariances hardly change otherwise, and a
        linearisation is a third of the total cost.
        """
        scale, energy = self._scale, self._energy
        body = energy.evaluate(free, targets, scale, held)
        for _ in range(self._polish_steps):
            before = robust_weight(body.squared, scale)
            moved = energy.retract(body.free, body.step)
            slope = energy.linearise(moved, targets, scale, held, slope_only=True)
            body.move(slope.energy < body.energy, moved, slope)  # false for NaN
            stale = np.flatnonzero(
                np.abs(robust_weight(body.squared, scale) - before).max(axis=1) > STALE
            )
            if len(stale) > 0:
                given = targets.rows(stale), scale, held.rows(stale)
                body.put(stale, energy.evaluate(body.free[stale], *given))
        return body


class LevenbergMarquardt:
    """Minimises the energy from a closed form, without training and for any body."""

    def __init__(self, energy: BodyEnergy, prior: PosePrior, kernel_scale: float):
        self._energy, self._scale = energy, kernel_scale
        self._slots = slots(energy.model.keypoint_names)
        self._frame = PersonFrame.of_angles(energy.model, prior.mean, prior.covariance)
        self._mean_angles = prior.mean[energy.angles]

    def arrive(
        self, targets: EnergyTargets, variance: Array, start: Array | None = None
    ) -> tuple[Array, Held]:
        """The optimum (B, P), each row with its own shape, under the priors; from `start` where it
        is not NaN.
        """
        rotation, pelvis = self._frame.place(targets.xyz, variance, self._slots)
        count = len(variance)
        angles = np.broadcast_to(self._mean_angles, (count, len(self._mean_angles)))
        parts = (np.zeros((count, 10)), log_so3(rotation), angles, pelvis + self._frame.transl)
        free, warm = np.concatenate(parts, 1), np.zeros(count, dtype=bool)
        if start is not None:
            warm = np.asarray(~np.isnan(start).any(axis=1))
            free = np.where(np.isnan(start), free, start)
        held = self._energy.held_by_priors(count)
        return self.solve(free, targets, warm, held), held

    def evaluated(self, free: Array, targets: EnergyTargets, held: Held) -> Evaluated:
        """The bodies of `arrive` (B, P), with the energy."""
        return self._energy.evaluate(free, targets, self._scale, held)

    def solve(self, free: Array, targets: EnergyTargets, warm: Mask, held: Held) -> Array:
        """Minimise from `free` (B, P); converged rows leave the batch. Returns (B, P)."""
        energy, rows = self._energy, np.arange(len(free))
        result, free, damping = free.copy(), free.copy(), np.full(len(free), _DAMPING_START)
        widening = np.where(warm, 0, ANNEAL_STEPS)
        current = energy.linearise(
            free, targets, self._scale * 2.0**widening, held, nothing(len(free))
        )
        for _ in range(MAX_ITERATIONS):
            step, promised = np.empty(free.shape), np.empty(len(free))
            solved(current.system.copy(), damping, step, promised)
            promised += damping * (np.diagonal(current.system, axis1=1, axis2=2) * step**2).sum(
                axis=1
            )
            trial = energy.retract(free, step)
            scale, annealed = self._scale * 2.0**widening, widening == 0
            tried = energy.linearise(trial, targets, scale, held, nothing(len(trial)))
            gain = current.energy - tried.energy
            better = gain > 0  # false for NaN
            if not better.all():
                for old, new in zip((free, *current), (trial, *tried), strict=True):
                    new[~better] = old[~better]
            free, current = trial, tried
            damping = _next_damping(damping, better, gain / promised)
            settled = np.where(better, gain, promised) < TOLERANCE
            going = ~(annealed & settled) & (damping < _DAMPING_MAX)
            narrower = np.flatnonzero(going & (widening > 0))
            if len(narrower) > 0:
                widening[narrower] -= 1
                some = (
                    targets.rows(narrower),
                    self._scale * 2.0 ** widening[narrower],
                    held.rows(narrower),
                )
                narrowed = energy.linearise(free[narrower], *some, nothing(len(narrower)))
                for old, new in zip(current, narrowed, strict=True):
                    old[narrower] = new
            if going.all():
                continue
            result[rows[~going]] = free[~going]
            rows, free, damping, widening = (
                rows[going],
                free[going],
                damping[going],
                widening[going],
            )
            current, targets, held = (
                type(current)(*(each[going] for each in current)),
                targets.rows(going),
                held.rows(going),
            )
            if len(rows) == 0:
                break
        result[rows] = free
        return result


def _next_damping(damping: Array, better: Mask, ratio: Array) -> Array:
    """Nielsen's rule by the `ratio` of actual to predicted decrease; eightfold after a rejected
    step.
    """
    factor = np.where(better, np.clip(1 - (2 * ratio - 1) ** 3, 0.1, 2.0), 8.0)
    return np.clip(damping * factor, _DAMPING_MIN, _DAMPING_MAX)
