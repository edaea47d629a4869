"""A person over a window as one model: a body in every frame, one shape, and joints that lie near
the body's.

    E(X, Theta) = sum rho(|Pi_v X_tj - x_tjv|² / sigma²) + sum |X_tj - J_j(theta_t, beta)|² / s²
                + |beta|² - 2 (dt / 1 s) log p(theta_t) + motion(theta_t, theta_t+1, theta_t+2)

The first sum is Eq. 1 with the gates of Eq. 2, the second Eq. 3 with a measured `s` and without a
threshold. Joints X are eliminated from every step in closed form: each has three unknowns, and is
connected to its body only.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from factors import DEFAULT_WIDTH_SIGMA, Motion
from shapepose_fg.body.fitting.chains import MotionChain, linked
from shapepose_fg.body.fitting.energy import BodyEnergy, EnergyTargets, Held, nothing
from shapepose_fg.body.fitting.evidence import WELL_SEEN_M
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.kernels.solving import eliminated, put_back
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.rotation import exp_so3, log_so3
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.rows import Rows
from shapepose_fg.estimation.asynchronous_views import carried_to_frames, leads, velocities_of
from shapepose_fg.estimation.contact import (
    FREE_M2_S,
    held_in_place,
    standing_density,
)
from shapepose_fg.estimation.gated_views import (
    ObservationConfig,
    ViewEvidence,
    inverses,
    linearise,
)
from shapepose_fg.estimation.in_time import moments, velocities
from shapepose_fg.estimation.motion_densities import MotionModel

DEVIATION_M = 0.007
"""Standard deviation of a detector's joint from the body's, metres per axis."""
POSE_LASTS_S = 1.0
"""Time after which a pose is practically independent of an earlier one, s: the pose prior counts
once in it."""
_AVERAGED = 0.15
"""Ratio of the covariance of a seen foot's velocity to that from the views of its two frames alone,
because a window averages over frames and joints: 0.11 to 0.25 in the median of each person in
simulated recordings of three to six cameras, against `Marginals.velocities`. With the marginals
themselves, errors and speeds of standing feet are the same, and a run takes a twentieth longer."""
_STRAYS_M = 0.07
"""Standard deviation, m, of an unseen joint of the body at which its own deviation is as large:
errors of unseen poses have heavier tails than a Gaussian."""
STEPS, SETTLED_M = 8, 2e-3
"""Maximum number of steps of the solver, and mean motion of joints below which it ends, metres. The
last step, by GTSAM, then moves them by a tenth of that."""
HELD = 1e-6
"""Information added to every unknown, so that undetermined ones keep their values."""
DAMPING = 1e-3


@dataclass(frozen=True)
class BodyState(Rows):
    """The variables of a window, or of single frames."""

    betas: Array
    """(10,) shape; of single frames (T, 10)."""
    root: Array
    """(T, 3, 3) rotation of the root."""
    others: Array
    """(T, N - 3) visible angles, rad, and position, metres from the window's origin."""
    deviation: Array
    """(T, J, 3) X - J(theta, beta), metres."""

    def moved(self, shape: Array, pose: Array) -> "BodyState":
        """The state after a step of the betas and of the poses (T, N); rotations of the root are
        tangent vectors in world axes.
        """
        return replace(
            self,
            betas=self.betas + shape,
            root=exp_so3(pose[:, :3]) @ self.root,
            others=self.others + pose[:, 3:],
        )

    @property
    def free(self) -> Array:
        """(T, P) parameters of `BodyEnergy`."""
        betas = np.broadcast_to(self.betas, (len(self.root), 10))
        return np.concatenate((betas, log_so3(self.root), self.others), 1)


@dataclass(frozen=True)
class Around(Rows):
    """The model linearised at a state."""

    cost: float | Array
    """E, in squared standard deviations; of single frames (T,)."""
    system: Array
    """(T, M, P) normal equations of each row, joints eliminated (`body/kernels/solving.py`); (T, 0,
    0) when covariances are known, since they are most of a window's memory."""
    pull: Array
    """(T, N) half the gradient of the motion."""
    bodies: Array
    """(T, J, 3) joints of the body, metres from the origin."""
    evidence: ViewEvidence
    """Measurements of the views, linearised at the joints X."""
    gain: Array
    """(T, J, 3, 3) gain (1 + s² L)^-1 s² L, by which X lies between the body's joint (0) and the
    estimate of the views (1)."""
    target: Array
    """(T, J, 3) joints as estimated from the views only, metres from the origin; undefined where
    these give no information."""


class BodyWindow:
    """The model of one person in T frames."""

    over_time = True
    """Whether the rows are successive frames of one person."""
    deviation_m = DEVIATION_M

    def __init__(
        self,
        observations: Observations,
        sigmas_px: Array,
        views: Views,
        model: BodyModel,
        config: ObservationConfig,
        motion: MotionModel,
        law: Motion,
    ):
        """Make the model of T rows of one person, in order of time; `sigmas_px` (T, J, V) as
        `observation_sigmas`.
        """
        self.observations, self.sigmas_px, self.views, self.config = (
            observations,
            sigmas_px,
            views,
            config,
        )
        self.times_s = observations.time_s.mean(axis=1)
        steps = np.diff(self.times_s) if self.over_time else np.empty(0)
        share = min(1.0, float(np.median(steps)) / POSE_LASTS_S) if len(steps) > 0 else 1.0
        self.energy = BodyEnergy(model, PosePrior.default().widened(share**-0.5))
        self.variance = np.full(self.sigmas_px.shape[:2], self.deviation_m**2)
        self.origin = np.zeros(3)
        self._motion, self._law, self._kernel = motion, law, config.robust_kernel
        self._held = self.energy.held_by_priors(len(self.times_s))
        # The betas have their prior once, not in every row.
        self._held = Held(self._held.betas, np.zeros(len(self.times_s)), self._held.angles)
        self.standing = JointTargets(
            np.zeros(shape := (*self.variance.shape, 3)), np.zeros((*shape, 3))
        )
        """Constraint on the joints of standing feet by other frames, metres in the world."""
        self.walk = np.full((len(steps), self.sigmas_px.shape[1]), np.inf)
        """(T - 1, J) density of the random walk of standing feet in each step, m²/s; infinite for
        others."""
        self.links: MotionChain | None = None
        self._asynchronous = bool(leads(observations, views).any())

    def __len__(self) -> int:
        return len(self.times_s)

    def solve(self, start: Array) -> BodyState:
        """The state of least cost; the solver starts at bodies `start` (T, P) in the world,
        parameters of `BodyEnergy`.
        """
        self.origin = start[:, -3:].mean(axis=0)
        free = start.copy()
        free[:, -3:] -= self.origin
        J = self.sigmas_px.shape[1]
        zero = np.zeros((len(free), J, 3))
        state = BodyState(
            np.median(free[:, :10], axis=0), exp_so3(free[:, 10:13]), free[:, 13:], zero
        )
        bodies = self._bodies(state)
        if len(self) > 1:
            self.links = linked(self._law, self.energy, self.times_s, self._faster(bodies))
        self.last = self.around(state, bodies)
        return self._descended(state)

    def _descended(self, state: BodyState) -> BodyState:
        """The state of least cost; the solver starts at `state`, at which `last` was linearised."""
        around, damping, done = self.last, DAMPING, False
        for _ in range(STEPS):
            if done:
                break
            moved_state, new = self._after(state, around, *self._step(state, around, damping))
            if not new.cost <= around.cost + 1e-3 * abs(around.cost):
                damping = max(10 * damping, 1e-2)
                if damping > 1e3:
                    break
                continue
            off = new.bodies + moved_state.deviation - around.bodies - state.deviation
            moved = np.linalg.norm(off, axis=-1).mean()
            state, around, damping, done = (
                moved_state,
                new,
                max(damping / 5, 1e-6),
                bool(moved < SETTLED_M),
            )
        self.last = around
        return state

    def hold(self, state: BodyState, feet: Index) -> None:
        """Hold the joints `feet` (F,) in place between frames where they stand, in the next steps
        (`take`).
        """
        velocity = velocities(self.joints(state), self.times_s)[:, feet]
        seen = np.asarray(self.last.evidence.sigma_m[:, feet] < WELL_SEEN_M)
        of_views = inverses(self.last.evidence.information[:, feet] + HELD * np.eye(3))
        first, last, lasts = moments(self.times_s)
        covariance = _AVERAGED * (of_views[first] + of_views[last])
        covariance = covariance / lasts[:, None, None, None] ** 2
        velocity = np.where(seen[..., None], velocity, np.nan)
        density = standing_density(velocity, covariance, self.times_s)
        density = np.where(density > FREE_M2_S, np.inf, density)
        if not np.isfinite(density).any():
            return
        evidence = self.last.evidence
        information = np.where(seen[..., None, None], evidence.information[:, feet], 0.0)
        targets = JointTargets(evidence.target[:, feet], information)
        information, pull = held_in_place(targets, density, self.times_s)
        information[~seen], pull[~seen] = 0.0, 0.0
        scale = np.trace(information, axis1=-2, axis2=-1)
        known = information + 1e-9 * scale[..., None, None] * np.eye(3)
        known = np.where(scale[..., None, None] > 0, known, np.eye(3))
        self.standing.xyz[:, feet] = (inverses(known) @ pull[..., None])[..., 0]
        self.walk[:, feet] = np.where(seen[1:] & seen[:-1], density, np.inf)
        # Detectors' errors last: all frames of a stance together say as much as one.
        own = np.trace(targets.information, axis1=-2, axis2=-1)
        share = np.where(scale > 0, own / np.maximum(own + scale, 1e-9), 1.0)
        self.standing.information[:, feet] = share[..., None, None] * information
        self.sigmas_px[:, feet] /= np.sqrt(share)[..., None]
        self.last = self.around(state, self.last.bodies)

    def take(self, state: BodyState, shape: Array, pose: Array) -> BodyState:
        """The state after another step of betas (10,) and poses (T, N) from the solution; the
        solution itself if the step makes it worse.
        """
        moved, new = self._after(state, self.last, shape, pose)
        if not new.cost <= self.last.cost + 1e-3 * abs(self.last.cost):
            return state
        self.last = new
        return moved

    def _after(
        self, state: BodyState, around: Around, shape: Array, pose: Array
    ) -> tuple[BodyState, Around]:
        """State after a step, with the best deviations, and the model around it."""
        moved = state.moved(shape, pose)
        bodies = self._bodies(moved)
        moved = replace(moved, deviation=self._deviation(around, bodies))
        return moved, self.around(moved, bodies)

    def joints(self, state: BodyState) -> Array:
        """(T, J, 3) X, metres in the world."""
        return self._bodies(state) + state.deviation + self.origin

    def parameters(self, state: BodyState) -> BodyParameters:
        """The bodies in the world."""
        body = self.energy.complete(state.free)
        return replace(body, transl=body.transl + self.origin.reshape(-1, 3))

    def widen_unseen(self, of_bodies: Array, elsewhere: Array) -> None:
        """Widen the deviation of joints without a used detection. No solution changes, and no other
        joint.

        `of_bodies` (T, J, 3, 3) are the covariances of the bodies' joints, and `elsewhere` (T, J)
        the variance along an axis of joints that cameras should see but do not, m².
        """
        variance = np.trace(of_bodies, axis1=-2, axis2=-1) / 3
        unseen = ~self.last.evidence.inlier.any(axis=-1)
        wider = self.variance + variance * np.sqrt(variance) / _STRAYS_M + elsewhere
        self.variance = np.where(unseen, wider, self.variance)

    def of_joints(self, of_body: Array) -> Array:
        """(T, J, 3, 3) covariances of X for those of the body's joints, m², around the last
        solution.
        """
        kept = np.eye(3) - self.last.gain
        found = kept @ of_body @ kept.mT + self.variance[..., None, None] * kept
        return (found + found.mT) / 2

    def carried(self, X: Array) -> Observations:
        """The detections as if all cameras exposed at the frames' times, for joints X (T, J, 3)."""
        observed = self.observations
        if self._asynchronous:
            observed = carried_to_frames(observed, X, velocities_of(observed, X), self.views)
        return observed

    def around(self, state: BodyState, bodies: Array) -> Around:
        """Cost and normal equations, joints eliminated, around a state with these `bodies` (T, J,
        3).
        """
        X = bodies + state.deviation + self.origin
        observed = self.carried(X)
        evidence = linearise(observed, self.sigmas_px, X, self.views, self.config)
        held = self.standing
        information = evidence.information + held.information
        off = (X - held.xyz)[..., None]
        gradient = evidence.gradient + (held.information @ off)[..., 0]
        both = replace(evidence, information=information, gradient=gradient)
        target = both.target - self.origin
        variance = self.variance[..., None, None]
        share = inverses(np.eye(3) + variance * information)
        weighed = information @ share  # (L^-1 + s²)^-1, of information that may be singular
        weighed = (weighed + weighed.mT) / 2
        targets = EnergyTargets(target, weighed)
        linear = self.energy.linearise(state.free, targets, 1e9, self._held, nothing(len(self)))
        cost = self._seen_cost(evidence)
        cost += (off.mT @ held.information @ off).sum(axis=(1, 2, 3))
        cost += (np.square(state.deviation).sum(axis=-1) / self.variance).sum(axis=-1)
        angles = state.others[:, :-3] - self._held.angles
        cost += np.einsum(
            "ti,ij,tj->t", angles, self.energy.priors.precision, angles, optimize=True
        )
        total, pull = self._total(state, cost)
        return Around(total, linear.system, pull, bodies, evidence, variance * weighed, target)

    def _total(self, state: BodyState, cost: Array) -> tuple[float | Array, Array]:
        """The cost of detections and joints in each frame, `cost` (T,), summed, plus that of shape
        and motion; and half the gradient of motion.
        """
        total = float(cost.sum() + np.square(state.betas).sum())
        if self.links is None:
            return total, np.zeros((len(self), self.energy.num_free - 10))
        moved, pull = self._moved(state)
        return total + moved, pull

    def _seen_cost(self, evidence: ViewEvidence) -> Array:
        """(T,) robust cost of the detections; a rejected one costs as much as at its gate."""
        seen = np.asarray(self.observations.seen & (self.sigmas_px > 0))
        sigma = np.where(seen, self.sigmas_px, 1.0)
        ratio = (np.nan_to_num(evidence.residual_px) ** 2).sum(axis=-1) / sigma**2
        ahead = self.views.cTw[..., 2, :]
        depth = evidence.points @ ahead[..., :3].mT + ahead[..., None, :, 3]
        focal = self.views.focal[:, None]
        gate = (self.config.rho_2d_m * focal / np.maximum(depth, 0.2) / sigma) ** 2
        squared = np.where(evidence.inlier, np.minimum(ratio, gate), gate)
        if self._kernel == "cauchy":
            c2 = DEFAULT_WIDTH_SIGMA["cauchy"] ** 2
            squared = c2 * np.log1p(squared / c2)
        elif self._kernel == "geman_mcclure":
            c2 = DEFAULT_WIDTH_SIGMA["geman_mcclure"] ** 2
            squared = c2 * squared / (c2 + squared)
        return np.where(seen, squared, 0.0).sum(axis=(1, 2))

    def _bodies(self, state: BodyState) -> Array:
        return self.energy.model.keypoints(self.energy.complete(state.free))

    def information_from(self, state: BodyState, joints: Mask) -> Array:
        """(T, M, P) normal equations of each frame's body from some `joints` (J,) only, without
        priors, around the last solution.
        """
        weighed = self.last.gain / self.variance[..., None, None] * joints[:, None, None]
        targets, T = EnergyTargets(self.last.target, weighed), len(self)
        whole = self.energy.linearise(state.free, targets, 1e9, self._held, nothing(T)).system
        no_targets = EnergyTargets(self.last.target, np.zeros_like(weighed))
        prior = self.energy.linearise(state.free, no_targets, 1e9, self._held, nothing(T)).system
        return np.asarray(whole - prior)

    def deviation(self, bodies: Array) -> Array:
        """Most probable deviations (T, J, 3) of the joints from the joints of given `bodies`
        (T, J, 3), metres, with gates and weights as at the last solution.
        """
        return self._deviation(self.last, bodies)

    def _deviation(self, around: Around, bodies: Array) -> Array:
        """X - J that is best for bodies that have moved."""
        seen = np.asarray(around.gain.any(axis=(-1, -2)))
        deviation = np.where(seen[..., None], around.target - bodies, 0.0)
        return (around.gain @ deviation[..., None])[..., 0]

    def _faster(self, bodies: Array) -> Array:
        """(T - 1, J) ratio of each joint's density of acceleration to its mean over all speeds, at
        least 1.
        """
        X = bodies + self.origin
        evidence = linearise(self.observations, self.sigmas_px, X, self.views, self.config)
        points = np.where(np.isfinite(evidence.target).all(-1, keepdims=True), evidence.target, X)
        variance = np.minimum(evidence.sigma_m, 1e3) ** 2
        return self._motion.faster(points, variance, self.times_s)

    def _moved(self, state: BodyState) -> tuple[float, Array]:
        assert self.links is not None
        T, ends = len(self), max(len(self.links.diagonal) - len(self), 0)
        root, others = (
            np.concatenate((each, each[-1:].repeat(ends, axis=0)))
            for each in (state.root, state.others)
        )
        energy, pull = self.links.at(root, others)
        return energy, pull[:T]

    def _eliminated(self, root: Array, around: Around, damping: float) -> tuple[Array, Array]:
        """The factor of the poses, and the system of the betas after the poses are eliminated
        (`body/kernels/solving.eliminated`).
        """
        T, N = around.pull.shape
        if self.links is None:
            diagonal, beyond = np.zeros((T, N)), np.zeros((T, N, 1))
        else:
            diagonal, beyond = (
                np.ascontiguousarray(each[:T]) for each in (self.links.diagonal, self.links.beyond)
            )
        M = (beyond.shape[-1] + 1) * N + 11
        kept, front = np.zeros((T, M, -(-N // 16) * 16)), np.zeros((M, M))
        eliminated(around.system, root, diagonal + HELD, beyond, around.pull, damping, kept, front)
        return kept, front

    def _step(self, state: BodyState, around: Around, damping: float) -> tuple[Array, Array]:
        """Steps of betas (10,) and poses (T, N)."""
        kept, front = self._eliminated(state.root, around, damping)
        whole = _symmetric(front[-10:, -10:]) + np.eye(10)
        whole += damping * np.diag(np.diag(whole))
        coefficients = np.append(1.0, -np.linalg.solve(whole, front[-10:, -11] + state.betas))
        pose = np.empty(around.pull.shape)
        put_back(kept, coefficients, pose)
        return coefficients[1:], pose

    def split(self, marginals: "Marginals") -> "list[tuple[Index, Marginals]]":
        """The rows of each person, and their marginals."""
        return [(np.arange(len(self)), marginals)]

    def covariances(self, state: BodyState) -> "Marginals":
        """Marginal covariances of every frame's variables, around the last solution. LinAlgError if
        they are not determined.
        """
        # Imported here: the first kernels load it anyway, commands without a window do not.
        from scipy.linalg import get_lapack_funcs

        kept, front = self._eliminated(state.root, self.last, 0.0)
        T, N = self.last.pull.shape
        self.last = replace(self.last, system=np.empty((T, 0, 0)))
        n = (kept.shape[1] - 11 - N) // N
        shape = np.asarray(
            np.linalg.inv(_symmetric(front[-10:, -10:]) + np.eye(10)), dtype=np.float64
        )
        poses, arrow, steps = np.empty((T, N, N)), np.empty((T, N, 10)), np.zeros((T, N, N))
        after, arrows = np.zeros((n * N, n * N)), np.zeros((n * N, 10))
        (invert,) = get_lapack_funcs(("trtri",))  # of triangles, three times as fast as inv
        for t in range(T - 1, -1, -1):
            L, ahead = kept[t, :N, :N], kept[t, N : N + n * N, :N]
            inverse, singular = invert(L, lower=1)
            if singular:
                raise np.linalg.LinAlgError("the body in a frame of the window is not determined")
            inverse = np.tril(inverse)
            W = ahead @ inverse
            across = -after @ W  # of those after it with this one
            own = inverse.T @ inverse - W.T @ across
            own = (own + own.T) / 2
            arrow[t] = inverse.T @ kept[t, -10:, :N].T - W.T @ arrows
            poses[t], steps[t] = own, across[:N]
            after[N:, N:] = after[:-N, :-N].copy() if n > 1 else 0
            after[:N, N:], after[N:, :N] = (
                across[:-N].T if n > 1 else 0,
                across[:-N] if n > 1 else 0,
            )
            after[:N, :N] = own
            arrows = np.concatenate((arrow[t], arrows[:-N])) if n > 1 else arrow[t]
        del kept, L, ahead  # twice as much memory as the covariances
        with_shape = arrow @ shape
        poses += with_shape @ arrow.mT
        steps[:-1] += with_shape[1:] @ arrow[:-1].mT
        return Marginals(self, state, poses, steps, shape, -with_shape)


@dataclass(frozen=True)
class Marginals:
    """Marginal covariances of a solved window, or of single frames."""

    window: BodyWindow
    state: BodyState
    poses: Array
    """(T, N, N) covariances of each frame's root (tangents of the world), angles and place."""
    steps: Array
    """(T, N, N) cross-covariances of the next frame's pose (rows) with that of each frame
    (columns); zero in the last frame."""
    shape: Array
    """(10, 10) covariance of the betas; of single frames (T, 10, 10)."""
    across: Array
    """(T, N, 10) covariances of poses with the betas."""

    @cached_property
    def slopes(self) -> Array:
        """(T, J, 3, 10 + N) derivatives of the body's joints by betas and pose."""
        window, state = self.window, self.state
        T, J = window.sigmas_px.shape[:2]
        none = EnergyTargets(np.zeros((T, J, 3)), np.zeros((T, J, 3, 3)))
        linear = window.energy.linearise(state.free, none, 1.0, window._held)
        slopes = linear.jacobian.reshape(T, J, 3, -1).copy()
        slopes[..., 10:13] = slopes[..., 10:13] @ state.root.mT[:, None]
        return slopes

    def joints(self) -> Array:
        """(T, J, 3, 3) covariances of X, m²."""
        return self.window.of_joints(self.of_bodies)

    @cached_property
    def of_bodies(self) -> Array:
        """(T, J, 3, 3) covariances of the bodies' joints, m²."""
        slope = self.slopes
        T, J = slope.shape[:2]
        whole = np.empty((T, slope.shape[-1], slope.shape[-1]))
        whole[:, :10, :10], whole[:, 10:, 10:] = self.shape, self.poses
        whole[:, 10:, :10], whole[:, :10, 10:] = self.across, self.across.mT
        flat = slope.reshape(T, 3 * J, -1)
        return (flat @ whole).reshape(slope.shape) @ slope.mT

    def velocities(self) -> Array:
        """(T, J, 3, 3) covariances of the velocities of the joints as in `in_time.velocities`,
        m²/s²; NaN for a single frame.

        The errors of each joint are assumed to be a Markov chain over the frames; true errors are
        more correlated over distant frames.
        """
        slope = self.slopes[..., 10:]
        T, J = slope.shape[:2]
        flat = slope.reshape(T, 3 * J, -1)
        own = (flat @ self.poses).reshape(slope.shape) @ slope.mT
        both = (flat[1:] @ self.steps[:-1]).reshape(slope[1:].shape) @ slope[:-1].mT
        goes = both @ inverses(own[:-1] + HELD * np.eye(3))
        first, last, lasts = moments(self.window.times_s)
        across = own[first]
        for k in range(int((last - first).max(initial=0))):
            step = np.minimum(first + k, T - 2)
            across = np.where((first + k < last)[:, None, None, None], goes[step] @ across, across)
        found = (own[first] + own[last] - across - across.mT) / lasts[:, None, None, None] ** 2
        # Standing feet move no farther than their random walk.
        walk = np.minimum(self.window.walk, 1.0) * np.diff(self.window.times_s)[:, None]
        moved = np.concatenate((np.zeros((1, J)), walk.cumsum(axis=0)))
        density = (moved[last] - moved[first]) / lasts[:, None] ** 2
        return found @ inverses(np.eye(3) + found / density[..., None, None])


def _symmetric(lower: Array) -> Array:
    whole = np.tril(lower)
    return whole + np.tril(whole, -1).T
