"""A window's joints as chains over time: each joint's state is linked to those in adjacent frames.

This is the whole graph of a window except for user factors, which these chains omit. GTSAM starts
at their solution, and without such factors a single step confirms it; the linearisation there gives
covariances.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factors import DEFAULT_WIDTH_SIGMA, KernelName, Motion, lasting_blocks
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.decompositions import symmetric_root
from shapepose_fg.core.kernel_geometry import ROBUST
from shapepose_fg.estimation.in_time import spanned
from shapepose_fg.estimation.kernels import ready, solve_chains
from shapepose_fg.estimation.motion_model import CorrelatedError

_SETTLED_M = 5e-4
"""Convergence: maximum motion of a joint in a step, metres."""
_STEPS = 20
"""Maximum number of steps; with a robust kernel the last ones halve the remaining error."""
_HELD = 1e-6
"""Information of the prior that keeps single-frame joints in place, 1/m²: one kilometre."""
UNDETERMINED_M = 10.0
"""Standard deviation, metres or m/s, above which a variable is undetermined, in its worst
direction."""


@dataclass(frozen=True)
class Projections:
    """Observations of a window's joints."""

    views: Views
    """The cameras, by row (T) if they move."""
    xy: Array
    """(T, J, V, 2) undistorted pixels."""
    sigmas_px: Array
    """(T, J, V) standard deviation of the white part of the error, pixels."""
    used: Mask
    """(T, J, V) mask of the used observations."""
    lead_s: Array
    """(T, J, V) exposure time of each observation relative to the state, seconds."""
    kernel: KernelName | None
    """The robust kernel."""
    scale: float
    """Factor applied to all sigmas; the kernel's width is not affected by it."""

    @property
    def width(self) -> float:
        """Width of the kernel, standard deviations."""
        return 1.0 if self.kernel is None else DEFAULT_WIDTH_SIGMA[self.kernel] / self.scale

    @cached_property
    def weight(self) -> Array:
        """(T, J, V) 1 / sigma², 1/px²; 0 for unused observations."""
        return np.where(self.used, 1.0 / np.where(self.used, self.sigmas_px, 1.0) ** 2, 0.0)


@dataclass(frozen=True)
class Said:
    """Estimates of a window's joints with correlated errors."""

    message: JointTargets
    """The estimates in information form, T rows."""
    scale: float
    """Factor on the covariances."""
    errors: CorrelatedError
    """Temporal correlation of the error."""
    where: Mask
    """(T, J) where the estimate is used, with an offset variable."""


@dataclass(frozen=True)
class Chains:
    """C joints with states of the same d numbers, three for each part."""

    joints: Index
    """(C,) indices of the window's joints."""
    parts: tuple[int, ...]
    """Columns of `WindowGraph.states` of the parts, position first."""
    diagonal: Array
    """(C, T, d, d) information of the linear terms, diagonal blocks."""
    below: Array
    """(C, T - 1, d, d) information of the linear terms, blocks between each state (rows) and the
    one before (columns)."""
    right: Array
    """(C, T, d) information vector."""
    there: Mask
    """(T, C, p) mask of parts present in each frame; offsets may be absent."""
    seen: Projections
    """The non-linear terms."""

    def solved(self, initial: Array) -> Array:
        """(C, T, d) states of minimum cost, from `initial` positions (T, J, 3), independently for
        each chain.

        A chain that moves a joint by more than `UNDETERMINED_M` keeps its initial state, at rest.
        """
        states, start = self._solve(initial, _STEPS, np.empty((0, 1, 1, 1))), self._at(initial)
        lost = np.abs(states - start)[..., :3].max(axis=(1, 2)) > UNDETERMINED_M
        return np.where(lost[:, None, None], start, states)

    def covariances(self, points: Array) -> Array:
        """(2, T, C, 3, 3) marginal covariances of positions and velocities with joints at `points`
        (T, J, 3).

        NaN for all of a singular chain, and for undetermined variables.
        """
        found = np.empty(self.diagonal.shape)
        self._solve(points, 0, found)
        return determined(np.stack([found[..., :3, :3], found[..., 3:6, 3:6]]).swapaxes(1, 2))

    def _solve(self, initial: Array, steps: int, covariance: Array) -> Array:
        states, seen = self._at(initial), self.seen
        solve_chains(
            states, self.joints, self.diagonal, self.below, self.right, seen.views.projection,
            ready(seen.xy), seen.weight, seen.lead_s, ROBUST[seen.kernel], seen.width, steps,
            _SETTLED_M, covariance,
        )  # fmt: skip
        return states

    def _at(self, points: Array) -> Array:
        """(C, T, d) states at rest at `points` (T, J, 3)."""
        states = np.zeros(self.right.shape)
        states[..., :3] = points[:, self.joints].swapaxes(0, 1)
        return states

    def put(self, states: Array, into: Array) -> None:
        """Write `states` (C, T, d) into those of the window, `into` (T, J, S, 3), each part to its
        column.
        """
        parts = states.reshape(*states.shape[:2], -1, 3).swapaxes(0, 1)
        for n, part in enumerate(self.parts):
            into[:, self.joints, part] = np.where(self.there[..., n, None], parts[:, :, n], np.nan)


def solved_apart(
    seen: Projections, pulls: JointTargets, initial: Array, steps: int, settled_m: float
) -> Array:
    """(R, J, 3) joints of minimum cost, metres, in R independent frames; NaN where `initial` (R, J,
    3) is.

    A joint that moves by more than `UNDETERMINED_M` keeps its initial position. There are at most
    `steps`, until one is shorter than `settled_m`.
    """
    R, J = initial.shape[:2]
    known = np.isfinite(initial).all(axis=-1, keepdims=True)
    start = np.where(known, initial, 0.0)
    # A very weak prior: with one view the depth would be undetermined.
    information = pulls.information + _HELD * np.eye(3)
    right = (pulls.information @ pulls.xyz[..., None])[..., 0] + _HELD * start
    found = start.copy()
    together = (
        [slice(None)] if len(seen.views.projection) == 1 else [slice(n, n + 1) for n in range(R)]
    )
    for n, rows in enumerate(together):  # one state per chain
        states, xy, weight, own, to = (
            ready(each[rows].reshape(-1, *each.shape[2:]))
            for each in (found, seen.xy, seen.weight, information, right)
        )
        states = states[:, None]
        solve_chains(
            states, np.arange(len(states)), own[:, None], np.empty((len(states), 0, 3, 3)),
            to[:, None], seen.views.projection[n : n + 1], xy[None], weight[None],
            np.zeros((1, *weight.shape)), ROBUST[seen.kernel], seen.width, steps, settled_m,
            np.empty((0, 1, 1, 1)),
        )  # fmt: skip
        found[rows] = states.reshape(-1, J, 3)
    far = np.abs(found - start).max(axis=-1, keepdims=True) > UNDETERMINED_M
    return np.where(known, np.where(far, start, found), np.nan)


def motion_information(law: Motion, dt_s: Array, density: Array) -> tuple[Array, Array]:
    """Information of a motion model about C chains of T states, along one axis: diagonal blocks (C,
    T, n, n), and blocks with the state before (C, T - 1, n, n).

    Steps `dt_s` (T - 1,), densities (T - 1, C). There is a prior on initial derivatives, none on
    positions.
    """
    F = law.transition(dt_s)
    noise = np.linalg.inv(law.noise(dt_s)) / density.T[..., None, None]
    own = np.zeros((noise.shape[0], len(dt_s) + 1, *F.shape[1:]))
    own[:, 0] = np.diag([0.0, *np.power(law.start, -2.0)])
    own[:, 1:] += noise
    own[:, :-1] += F.mT @ noise @ F
    return own, -noise @ F


@dataclass(frozen=True)
class Problem:
    """Measurements and priors of a window's joints, independent for each joint."""

    times_s: Array
    """(T,) times of the frames, ascending, seconds."""
    law: Motion
    """Motion model of the joints."""
    density: Array
    """(T - 1, J) density of the noise in the motion."""
    seen: Projections
    """The used observations."""
    pulls: JointTargets
    """Constraints on joints with independent errors in every frame, T rows."""
    said: tuple[Said, Said]
    """Estimates from views and from the body with correlated errors: one offset variable each."""
    standing: Array
    """(T - 1, J) density of the random walk of standing joints in each step, m²/s; infinite if not
    standing."""

    def chains(self, joints: Iterable[int]) -> list[Chains]:
        """The chains of some `joints`, grouped by equal parts."""
        alike: dict[tuple[int, ...], list[int]] = {}
        offsets = [np.asarray(each.where.any(axis=0)) for each in self.said]
        for joint in joints:
            there = (self.law.order + n for n, has in enumerate(offsets) if has[joint])
            alike.setdefault((*range(self.law.order), *there), []).append(joint)
        return [self._alike(np.array(each, dtype=np.intp), parts) for parts, each in alike.items()]

    def _alike(self, joints: Index, parts: tuple[int, ...]) -> Chains:
        C, T, p, n = len(joints), len(self.times_s), len(parts), self.law.order
        diagonal, below = np.zeros((C, T, p, 3, p, 3)), np.zeros((C, T - 1, p, 3, p, 3))
        right, dt = np.zeros((C, T, p, 3)), np.diff(self.times_s)
        moving, linked = motion_information(self.law, dt, self.density[:, joints])
        for axis in range(3):
            diagonal[:, :, :n, axis, :n, axis] += moving
            below[:, :, :n, axis, :n, axis] += linked
        xyz, information = (
            each[:, joints].swapaxes(0, 1) for each in (self.pulls.xyz, self.pulls.information)
        )
        diagonal[:, :, 0, :, 0] += information
        right[:, :, 0] += (information @ xyz[..., None])[..., 0]
        holds = 1.0 / (self.standing[:, joints].T * dt)
        for axis in range(3):
            diagonal[:, 1:, 0, axis, 0, axis] += holds
            diagonal[:, :-1, 0, axis, 0, axis] += holds
            below[:, :, 0, axis, 0, axis] -= holds
        there = np.ones((T, C, p), dtype=bool)
        for at in range(n, p):
            there[..., at] = spanned(self.said[parts[at] - n].where)[:, joints]
            self._add_offsets(joints, self.said[parts[at] - n], at, (diagonal, below, right))
        d = 3 * p
        matrices = (
            diagonal.reshape(C, T, d, d),
            below.reshape(C, T - 1, d, d),
            right.reshape(C, T, d),
        )
        return Chains(joints, parts, *matrices, there, self.seen)

    def _add_offsets(
        self, joints: Index, said: Said, at: int, to: tuple[Array, Array, Array]
    ) -> None:
        """Add estimates with offset variables, the states' part `at`; offsets decay
        (`factors.lasting`).
        """
        diagonal, below, right = to
        message, span = said.message, spanned(said.where)[:, joints].T
        there = (said.where & message.known)[:, joints].T
        xyz, information = (
            each[:, joints].swapaxes(0, 1)[there] for each in (message.xyz, message.information)
        )
        roots = symmetric_root(information / said.scale)
        of_joint, of_offset, expected = lasting_blocks(xyz, roots, said.errors.white_share)
        for one, first in ((0, of_joint), (at, of_offset)):
            right[there, one] += (first.mT @ expected[..., None])[..., 0]
            for other, second in ((0, of_joint), (at, of_offset)):
                diagonal[:, :, one, :, other][there] += first.mT @ second
        passed = np.diff(self.times_s) / said.errors.correlation_s
        link = (span[:, 1:] & span[:, :-1]) / -np.expm1(-2.0 * passed)
        begins = span & (np.cumsum(span, axis=1) == 1)
        for axis in range(3):
            own = diagonal[:, :, at, axis, at, axis]
            own += begins | ~span  # an absent offset is 0
            own[:, 1:] += link
            own[:, :-1] += link * np.exp(-2.0 * passed)
            below[:, :, at, axis, at, axis] -= link * np.exp(-passed)


def determined(covariance: Array) -> Array:
    """Return covariances (..., 3, 3), with NaN for those above `UNDETERMINED_M` in some
    direction.
    """
    largest = np.trace(covariance, axis1=-2, axis2=-1)  # upper bound
    doubtful = np.isfinite(largest) & (largest >= UNDETERMINED_M**2)
    largest[doubtful] = np.linalg.eigvalsh(covariance[doubtful])[..., -1]
    return np.where((largest < UNDETERMINED_M**2)[..., None, None], covariance, np.nan)
