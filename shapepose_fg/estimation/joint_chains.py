"""A window's joints as chains over time: each joint's state hangs on those of the frames before and after it.

All of a window's graph is so but factors of the user's own, which these chains leave out. GTSAM starts where they
end, and without such factors a step of it confirms that; linearised at its solution they give covariances.
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
from shapepose_fg.core.pieces import ROBUST
from shapepose_fg.estimation.in_time import spanned
from shapepose_fg.estimation.kernels import ready, solve_chains
from shapepose_fg.estimation.motion_model import Lasting

_SETTLED_M = 5e-4
"""Chains are solved until no joint moves by more, metres."""
_STEPS = 20
"""Maximum number of steps: under a robust kernel the last ones halve what is left."""
_HELD = 1e-6
"""Information that holds a joint of a frame by itself where it is, 1/m²: a kilometre."""
UNDETERMINED_M = 10.0
"""A variable that the problem leaves less certain than this in some direction, metres or m/s, is not
determined."""


@dataclass(frozen=True)
class Projections:
    """The observations of a window's joints."""

    views: Views
    """The cameras, T rows of them where they move."""
    xy: Array
    """(T, J, V, 2) undistorted pixels."""
    sigmas_px: Array
    """(T, J, V) standard deviation of the error that is new in every frame, pixels."""
    used: Mask
    """(T, J, V) which observations count."""
    lead_s: Array
    """(T, J, V) how long after the state each was exposed, seconds."""
    kernel: KernelName | None
    """The robust kernel."""
    scale: float
    """What all sigmas were multiplied with; the kernel is as wide as if they were not."""

    @property
    def width(self) -> float:
        """The kernel's width, standard deviations."""
        return 1.0 if self.kernel is None else DEFAULT_WIDTH_SIGMA[self.kernel] / self.scale

    @cached_property
    def weight(self) -> Array:
        """(T, J, V) 1 / sigma², 1/px²; 0 where an observation does not count."""
        return np.where(self.used, 1.0 / np.where(self.used, self.sigmas_px, 1.0) ** 2, 0.0)


@dataclass(frozen=True)
class Said:
    """A message about a window's joints whose error lasts."""

    message: JointTargets
    """What is said, T rows."""
    scale: float
    """Covariances are multiplied with this."""
    errors: Lasting
    """How its error lasts."""
    where: Mask
    """(T, J) where it counts, with an offset."""


@dataclass(frozen=True)
class Chains:
    """C joints whose states have the same d numbers: three of each of their parts."""

    joints: Index
    """(C,) which of the window's."""
    parts: tuple[int, ...]
    """Which columns of `WindowGraph.states` the parts are, position first."""
    diagonal: Array
    """(C, T, d, d) information of what is linear, of each state with itself."""
    below: Array
    """(C, T - 1, d, d) information of each state, rows, with the one before it, columns."""
    right: Array
    """(C, T, d) information times what is expected."""
    there: Mask
    """(T, C, p) which parts there are in which frames: offsets are not in all."""
    seen: Projections
    """What is not linear."""

    def solved(self, initial: Array) -> Array:
        """(C, T, d) states of least cost, from `initial` positions (T, J, 3); each chain by itself.

        One that leads a joint farther away than `UNDETERMINED_M` stays where it is, at rest.
        """
        states, start = self._solve(initial, _STEPS, np.empty((0, 1, 1, 1))), self._at(initial)
        lost = np.abs(states - start)[..., :3].max(axis=(1, 2)) > UNDETERMINED_M
        return np.where(lost[:, None, None], start, states)

    def covariances(self, points: Array) -> Array:
        """(2, T, C, 3, 3) marginal covariances of positions and velocities where joints are at `points` (T, J, 3).

        NaN in all of a chain that is singular, and where one is not determined.
        """
        found = np.empty(self.diagonal.shape)
        self._solve(points, 0, found)
        return determined(np.stack([found[..., :3, :3], found[..., 3:6, 3:6]]).swapaxes(1, 2))

    def _solve(self, initial: Array, steps: int, covariance: Array) -> Array:
        states, seen = self._at(initial), self.seen
        solve_chains(
            states, self.joints, self.diagonal, self.below, self.right, seen.views.projection, ready(seen.xy),
            seen.weight, seen.lead_s, ROBUST[seen.kernel], seen.width, steps, _SETTLED_M, covariance,
        )  # fmt: skip
        return states

    def _at(self, points: Array) -> Array:
        """(C, T, d) states at rest at `points` (T, J, 3)."""
        states = np.zeros(self.right.shape)
        states[..., :3] = points[:, self.joints].swapaxes(0, 1)
        return states

    def put(self, states: Array, into: Array) -> None:
        """Write `states` (C, T, d) `into` those of the window (T, J, S, 3), each part to its place."""
        parts = states.reshape(*states.shape[:2], -1, 3).swapaxes(0, 1)
        for n, part in enumerate(self.parts):
            into[:, self.joints, part] = np.where(self.there[..., n, None], parts[:, :, n], np.nan)


def solved_apart(seen: Projections, pulls: JointTargets, initial: Array, steps: int, settled_m: float) -> Array:
    """(R, J, 3) joints of least cost, metres, in R frames that have nothing to do with each other; NaN where
    `initial` (R, J, 3) is. One that is led farther away than `UNDETERMINED_M` stays there. There are at the most
    so many `steps`, until one is shorter than `settled_m`.
    """
    R, J = initial.shape[:2]
    known = np.isfinite(initial).all(axis=-1, keepdims=True)
    start = np.where(known, initial, 0.0)
    # Held where it is by next to nothing: with one view its depth would be nowhere.
    information = pulls.information + _HELD * np.eye(3)
    right = (pulls.information @ pulls.xyz[..., None])[..., 0] + _HELD * start
    found = start.copy()
    together = [slice(None)] if len(seen.views.projection) == 1 else [slice(n, n + 1) for n in range(R)]
    for n, rows in enumerate(together):  # one state a chain
        states, xy, weight, own, to = (
            ready(each[rows].reshape(-1, *each.shape[2:]))
            for each in (found, seen.xy, seen.weight, information, right)
        )
        states = states[:, None]
        solve_chains(
            states, np.arange(len(states)), own[:, None], np.empty((len(states), 0, 3, 3)), to[:, None],
            seen.views.projection[n : n + 1], xy[None], weight[None], np.zeros((1, *weight.shape)),
            ROBUST[seen.kernel], seen.width, steps, settled_m, np.empty((0, 1, 1, 1)),
        )  # fmt: skip
        found[rows] = states.reshape(-1, J, 3)
    far = np.abs(found - start).max(axis=-1, keepdims=True) > UNDETERMINED_M
    return np.where(known, np.where(far, start, found), np.nan)


def motion_information(law: Motion, dt_s: Array, density: Array) -> tuple[Array, Array]:
    """What a law of motion says of C chains of T states, along one axis: information of each with itself
    (C, T, n, n), and with the one before it (C, T - 1, n, n).

    Steps `dt_s` (T - 1,), densities (T - 1, C). The start says how wide derivatives are, and nothing of positions.
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
    """All that is known of a window's joints, each by itself."""

    times_s: Array
    """(T,) times of the frames, rising, seconds."""
    law: Motion
    """How joints move."""
    density: Array
    """(T - 1, J) density of the noise in the motion."""
    seen: Projections
    """Observations that count."""
    pulls: JointTargets
    """What pulls joints and is new in every frame, T rows."""
    said: tuple[Said, Said]
    """What views and body say with errors that last: an offset each."""
    standing: Array
    """(T - 1, J) how little joints walk in each step, m²/s; infinite where they do not stand."""

    def chains(self, joints: Iterable[int]) -> list[Chains]:
        """The chains of some `joints`, those with the same parts together."""
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
        xyz, information = (each[:, joints].swapaxes(0, 1) for each in (self.pulls.xyz, self.pulls.information))
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
        matrices = diagonal.reshape(C, T, d, d), below.reshape(C, T - 1, d, d), right.reshape(C, T, d)
        return Chains(joints, parts, *matrices, there, self.seen)

    def _add_offsets(self, joints: Index, said: Said, at: int, to: tuple[Array, Array, Array]) -> None:
        """Add what is said with offsets, which are the states' part `at`; and these fade (`factors.lasting`)."""
        diagonal, below, right = to
        message, span = said.message, spanned(said.where)[:, joints].T
        there = (said.where & message.known)[:, joints].T
        xyz, information = (each[:, joints].swapaxes(0, 1)[there] for each in (message.xyz, message.information))
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
            own += begins | ~span  # one that is not there is 0
            own[:, 1:] += link
            own[:, :-1] += link * np.exp(-2.0 * passed)
            below[:, :, at, axis, at, axis] -= link * np.exp(-passed)


def determined(covariance: Array) -> Array:
    """Return covariances (..., 3, 3), NaN where one is more than `UNDETERMINED_M` in some direction."""
    largest = np.trace(covariance, axis1=-2, axis2=-1)  # at the most
    doubtful = np.isfinite(largest) & (largest >= UNDETERMINED_M**2)
    largest[doubtful] = np.linalg.eigvalsh(covariance[doubtful])[..., -1]
    return np.where((largest < UNDETERMINED_M**2)[..., None, None], covariance, np.nan)
