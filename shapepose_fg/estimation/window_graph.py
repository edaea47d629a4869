"""A person over a window of frames as one factor graph: a position of every joint in every frame.

Stage II of the paper, the X step: E(X) = w_2D E_2D(X) + w_shape E_shape(X, Theta) with Theta fixed; with
more than one frame, joints have velocities too, and motion factors between their states.
"""

import re
from collections import deque
from collections.abc import Callable, Iterable, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import (
    KernelName,
    body_prior_factors,
    diagonal,
    lasting_prior_factors,
    make_camera,
    moving_projection_factors,
    offset_factors,
    offset_keys,
    projection_factors,
    robust_kernel,
    split_key,
    standing_factors,
    state_keys,
)
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.contact import walking
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.in_time import motion_of, near_in_time, spanned
from shapepose_fg.estimation.joint_chains import Chains, Problem, Projections, Said
from shapepose_fg.estimation.linearisation import Message, symmetric_roots
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.estimation.out_of_step import leads

_OF_VIEWS, _OF_BODY = 0, 1
"""Sources of messages about joints, for the keys of their offsets."""


class WindowGraph:
    """The graph of one person in T frames; T = 1 is a frame by itself, without velocities.

    Joints are not tied to each other but by factors of your own, which keeps marginal covariances cheap.

    **Correlated errors.** A detector that is 2 cm off is so in the next frame too, and so is the body's guess. In
    a window of several frames therefore

    - projections and body priors count with the share of their variance that is new in every frame, so that motion
      smooths that only; `state_covariances` have nothing of the rest (`outcome.with_lasting` adds it);
    - where a joint is lost from sight (`lost` of `solve`) the body's prior gets an offset that decays slowly
      (`factors.motion`): the difference between joint and body when it was seen; and so does what its views say,
      which, where they hardly cross, would else be averaged over time as if it were new in every frame;
    - joints with factors of your own are solved with offsets of views and body both, and what the views say is one
      Gaussian each: your factor is weighed against all of the error, and the covariances hold it.
    """

    def __init__(
        self,
        observations: Observations,
        sigmas_px: Array,
        views: Views,
        config: EstimatorConfig,
        motion: MotionModel,
        rows: Index | None = None,
    ) -> None:
        """Make the factors of all observations: T rows of one person, frames rising.

        `sigmas_px` (T, J, V), 0 where the view did not see the joint; `views` are their cameras; `rows` (T,) says
        which rows of a larger problem they are.
        """
        T, J, _ = sigmas_px.shape
        if np.any(np.diff(observations.frame) <= 0):
            raise ValueError(f"a person's frames must rise, got {observations.frame}")
        self.config = config.graph
        self.rows = np.arange(T) if rows is None else rows
        """(T,) which rows of the whole problem these are."""
        self.track = int(observations.track[0])
        """Who it is."""
        self.frames = observations.frame
        """(T,) frame of each row."""
        self.times_s = observations.time_s.mean(axis=1)
        """(T,) time of each frame, seconds."""
        joints = np.arange(J)
        self.state_keys = state_keys(self.track, joints, self.frames[:, None], motion.law.order)
        """(T, J, n) keys of each joint's state, `Point3` each: position, velocity, and what the model of motion
        has beside these; in the graph of a single frame, positions only."""
        self.graph = gtsam.NonlinearFactorGraph()
        """The factors of the last solution."""
        self.values = gtsam.Values()
        """The last solution, for `gtsam.Marginals` and for graphs that this one is added to."""
        self.failure = ""
        """Why the last solution is none; empty where it is one."""
        self._motion = motion
        self._observations, self._sigmas_px, self._views = observations, sigmas_px, views
        self._names = config.joints
        self._cameras = _cameras(views)
        self._kernel: KernelName | None = config.observations.robust_kernel
        self._offset_keys = np.stack(
            [offset_keys(self.track, joints, self.frames[:, None], source) for source in (_OF_VIEWS, _OF_BODY)]
        )
        self._added: list[tuple[gtsam.NonlinearFactor, frozenset[int]]] = []
        self._tied: list[frozenset[int]] = []
        self.touched: Mask = np.zeros(J, dtype=bool)
        """(J,) joints on which there is a factor of your own."""
        self.present: Mask = np.zeros((T, J), dtype=bool)
        """(T, J) which joints were in the last problem."""
        self.positions = self.velocity = np.full((T, J, 3), np.nan)
        """(T, J, 3) positions and velocities of the last solution, metres and m/s; NaN where there are none."""
        self.chains: list[Chains] = []
        """The last problem of several frames joint by joint, but for factors of your own."""

    @property
    def keys(self) -> NDArray[np.int64]:
        """(T, J) key of each joint's position, `Point3`, metres."""
        return self.state_keys[..., 0]

    @property
    def velocity_keys(self) -> NDArray[np.int64]:
        """(T, J) key of each joint's velocity, `Point3`, m/s; not in the graph of a single frame."""
        return self.state_keys[..., 1]

    def __len__(self) -> int:
        """T, the number of frames."""
        return len(self.frames)

    @property
    def states(self) -> NDArray[np.int64]:
        """(T, J, n + 2) keys of all that belongs to a joint in a frame: its state, offset of the views and offset
        of the body; not all of them are in every problem.
        """
        return np.concatenate([self.state_keys, np.moveaxis(self._offset_keys, 0, -1)], axis=-1)

    @property
    def seen(self) -> Mask:
        """(T, J, V) of which joints there are detections."""
        return self._observations.seen

    @property
    def temporal(self) -> bool:
        """Whether there is more than one frame: then joints have velocities and motion factors."""
        return len(self) > 1

    def add(self, factor: gtsam.NonlinearFactor) -> None:
        """Append a factor of your own on any of `state_keys`; it stays through all alternations.

        While one of its variables is not in the problem, because neither views nor body nor motion place it, it
        rests. ValueError if it is on anything but this window's keys.
        """
        own = set(self.state_keys.ravel().tolist())
        keys = set(factor.keys())
        if not keys <= own:
            raise ValueError(
                "a factor of your own must be on the window's own keys only (WindowGraph.keys and velocity_keys)"
            )
        self._added.append((factor, frozenset(keys)))
        joined = frozenset(split_key(key).joint for key in keys)
        self.touched[list(joined)] = True
        apart = [each for each in self._tied if not each & joined]
        self._tied = [*apart, joined.union(*(each for each in self._tied if each & joined))]

    @property
    def coupled(self) -> list[frozenset[int]]:
        """Joints that factors of your own tie to each other: sets of two or more, without overlap."""
        return [each for each in self._tied if len(each) > 1]

    @property
    def with_offsets(self) -> Mask:
        """(J,) joints with a factor of your own, in a window of several frames: solved with offsets throughout."""
        return self.touched if self.temporal else np.zeros_like(self.touched)

    def solve(
        self,
        inlier: Mask,
        views: Message,
        body: Message,
        initial: Array,
        lost: Mask | None = None,
        feet: Index | None = None,
    ) -> Array:
        """Minimise over the joints, from `initial` (T, J, 3) metres; returns (T, J, 3).

        `inlier` (T, J, V) are the observations that count (delta_ij of Eq. 2), `views` what they say together at
        `initial`, `body` the priors (Eq. 3). A joint with NaN in `initial` is not in the problem and stays NaN; in
        a window of several frames that goes for all frames of the joint. `lost` (T, J): where joints are hardly
        seen. `feet` (F,): joints that may stand (`contact.walking`).

        In a window of several frames each joint is solved by itself first (`joint_chains`), without factors of
        your own, and GTSAM starts there. It takes the last step, or as many as Levenberg-Marquardt needs.
        """
        self.failure, self.chains = "", []
        self.present = np.asarray(np.isfinite(initial).all(axis=2))
        if self.temporal:
            self.present &= np.asarray(self.present.all(axis=0))
        problem = self._problem(inlier, views, body, initial, lost)
        joints = np.flatnonzero(self.present[0])
        if self.temporal and feet is not None:
            problem = walking(problem, np.intersect1d(joints, feet), initial, lost)
        states = np.full((*self.states.shape, 3), np.nan)
        states[self.present, 0] = initial[self.present]
        if self.temporal:
            self.chains = problem.chains(joints.tolist())
            for chains in self.chains:
                chains.put(chains.solved(initial), states)
        self._start(states)
        self.graph = gtsam.NonlinearFactorGraph()
        self._add(self._seen(problem.seen))
        if problem.seen.lead_s.any():
            self._add(self._seen_between(problem.seen, states))
        self._add(self._pulled(problem.pulls))
        for source, said in enumerate(problem.said):
            self._add(self._lasting(said, source))
        if self.temporal:
            self._add(self._moving(problem))
        exists = self.values.exists
        self._add(factor for factor, keys in self._added if all(map(exists, keys)))
        if not self.values.empty():
            self._optimise()
        self.positions, self.velocity = self._points()
        return self.positions

    def _problem(self, inlier: Mask, views: Message, body: Message, near: Array, lost: Mask | None) -> Problem:
        """What `solve` is asked; how far joints may turn goes by their speed `near` where they are."""
        of_views = of_body = self.present & self.with_offsets
        density, share = np.zeros((len(self) - 1, near.shape[1])), 1.0
        if self.temporal:
            share = self._motion.views.white_share
            variance = 1.0 / np.maximum(np.linalg.eigvalsh(views.information)[..., 0], 1.0)
            speed, turning = motion_of(near, variance, self.times_s)
            density = self._motion.density_of(speed, turning)
            if lost is not None:
                around = near_in_time(lost, self.times_s, self._motion.around_s)
                of_body = self.present & (self.with_offsets | around)
                of_views = self.present & (self.with_offsets | lost)
                density = np.where(lost[1:] & lost[:-1], self._motion.density_lost(speed), density)
        # A lasting error is no outlier, and a weight multiplies the kernel's cost, too: in pixels the kernel is as
        # wide as before either changed the sigma.
        scale, weight, xy = np.sqrt(share / self.config.weight_2d), self.config.weight_shape, self._observations.xy
        lead = leads(self._observations, self._views) if self.temporal else np.zeros(inlier.shape)
        used = inlier & (self._sigmas_px > 0) & (self.present & ~of_views)[..., None]
        return Problem(
            times_s=self.times_s,
            law=self._motion.law,
            density=density,
            seen=Projections(self._views, xy, self._sigmas_px * scale, used, lead, self._kernel, scale),
            pulls=body.where(self.present & ~of_body, weight / share),
            said=(
                Said(views, 1.0 / self.config.weight_2d, self._motion.views, of_views),
                Said(body, 1.0 / weight, self._motion.body, of_body),
            ),
            standing=np.full(density.shape, np.inf),
        )

    def _optimise(self) -> None:
        """Solve from `values`; where that fails they stay as they are, and `failure` says why."""
        # Joint by joint, each from frame to frame: what is eliminated so fills nothing in.
        by_joint = self.states.swapaxes(0, 1)
        ordering = gtsam.Ordering(by_joint[self._there.swapaxes(0, 1)].tolist())
        try:
            if self.touched.any() or not self._confirmed(ordering):
                self._descend(None if self.coupled else ordering)
        except RuntimeError as error:
            key, where = undetermined_key(error), ""
            if key is not None and key in set(self.states.ravel().tolist()):
                joint = split_key(key)
                where = f" near {self._names[joint.joint]} in frame {joint.frame}: nothing determines it there"
            self.failure = f"the solver failed: its system is singular{where}"

    def _confirmed(self, ordering: gtsam.Ordering) -> bool:
        """Whether the error falls by no more than the tolerance in a step by Gauss and Newton; if so, take it."""
        linear = self.graph.linearize(self.values)
        try:
            solved = linear.eliminateSequential(ordering)
            step = solved.optimize()
        except RuntimeError:  # a joint is not determined: damped, the others are solved all the same
            return False
        nowhere = gtsam.VectorValues.Zero(step)
        # What is eliminated has no error left at the step: what it has without is what the step takes away.
        settled = solved.error(nowhere) <= self.config.tolerance * linear.error(nowhere)
        if settled:
            self.values = self.values.retract(step)
        return settled

    def _descend(self, ordering: gtsam.Ordering | None) -> None:
        """Levenberg-Marquardt."""
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(self.config.max_iterations)
        # Of hundreds of joints that hardly move any more, a few thousandths of a sigma.
        parameters.setRelativeErrorTol(self.config.tolerance * (10.0 if self.temporal else 1.0))
        if ordering is not None:
            parameters.setOrdering(ordering)
        optimizer = gtsam.LevenbergMarquardtOptimizer(self.graph, self.values, parameters)
        self.values = optimizer.optimize()
        if not np.isfinite(optimizer.error()):
            self.failure = "the solver left the finite numbers"

    def _add(self, factors: Iterable[gtsam.NonlinearFactor]) -> None:
        deque(map(self.graph.add, factors), maxlen=0)

    def _seen(self, seen: Projections) -> Sequence[gtsam.NonlinearFactor]:
        """The observations that count and are of the time of a state."""
        frame, joint, view = chosen = np.nonzero(seen.used & (seen.lead_s == 0.0))
        return projection_factors(
            self._cameras,
            frame * len(self._views) + view if self._views.rows_known is not None else view,
            self.keys[frame, joint],
            seen.xy[chosen],
            seen.sigmas_px[chosen],
            robust_kernel(seen.kernel, None if seen.kernel is None else seen.width),
        )

    def _seen_between(self, seen: Projections, states: Array) -> list[gtsam.NonlinearFactor]:
        """Those of other times, linear around `states` (T, J, S, 3): all of a joint and frame are one factor."""
        used = seen.used & (seen.lead_s != 0.0)
        position, velocity = np.nan_to_num(states[:, :, 0]), np.nan_to_num(states[:, :, 1])
        moved = position[:, :, None] + seen.lead_s[..., None] * velocity[:, :, None]
        at, _, slope = seen.views.project_apart(moved)
        frame, joint, _ = chosen = np.nonzero(used & np.isfinite(at).all(axis=-1))
        return moving_projection_factors(
            self.keys[frame, joint], self.velocity_keys[frame, joint], seen.lead_s[chosen],
            moved[chosen], slope[chosen], at[chosen] - seen.xy[chosen], seen.sigmas_px[chosen],
            seen.kernel, seen.width,
        )  # fmt: skip

    def _pulled(self, pulls: Message) -> list[gtsam.NonlinearFactor]:
        """The body's pull on joints."""
        known = pulls.known
        covariances = np.linalg.inv(pulls.information[known])
        symmetric = (covariances + covariances.swapaxes(1, 2)) / 2
        return list(body_prior_factors(self.keys[known], pulls.xyz[known], symmetric))

    def _lasting(self, said: Said, source: int) -> list[gtsam.NonlinearFactor]:
        """What is said of joints with an offset each that decays slowly."""
        if not said.where.any():
            return []
        known, keys = said.message.known & said.where, self._offset_keys[source]
        roots = symmetric_roots(said.message.information[known] / said.scale)
        xyz, share = said.message.xyz[known], said.errors.white_share
        factors = lasting_prior_factors(self.keys[known], keys[known], xyz, roots, share)
        # An offset in every frame between two, so that a joint's states are a chain.
        chain = spanned(said.where)
        for joint in np.flatnonzero(chain.any(axis=0)).tolist():
            there = chain[:, joint]
            factors += offset_factors(keys[there, joint], self.times_s[there], said.errors.correlation_s)
        return factors

    def _moving(self, problem: Problem) -> list[gtsam.NonlinearFactor]:
        """Motion of the joints that are in the problem, and feet that stand."""
        factors = list[gtsam.NonlinearFactor]()
        unknown = [diagonal(np.full(3, sigma)) for sigma in problem.law.start]
        for joint in np.flatnonzero(self.present[0]).tolist():
            states = self.state_keys[:, joint]
            for key, noise in zip(states[0, 1:].tolist(), unknown, strict=True):
                factors.append(gtsam.PriorFactorPoint3(key, np.zeros(3), noise))
            factors += problem.law.factors(states, self.times_s, problem.density[:, joint])
        step, joint = np.nonzero(np.isfinite(problem.standing))
        before, after, held = self.keys[step, joint], self.keys[step + 1, joint], problem.standing[step, joint]
        return factors + standing_factors(before, after, np.diff(self.times_s)[step], held)

    def _start(self, states: Array) -> None:
        """Make `values` of `states` (T, J, S, 3), NaN where there are none."""
        self._there = np.isfinite(states[..., 0])
        self.values = gtsam.Values()
        deque(map(self.values.insert, self.states[self._there].tolist(), states[self._there]), maxlen=0)

    def _points(self) -> tuple[Array, Array]:
        """Positions and velocities (T, J, 3) of the last solution. Values are sorted as keys are: by joint, then
        frame.
        """
        present = self.present.T
        positions, speeds = (np.full((*present.shape, 3), np.nan) for _ in range(2))
        count = int(present.sum())
        if count > 0:
            points = gtsam.utilities.extractPoint3(self.values)
            positions[present] = points[:count]
            if self.temporal:
                speeds[present] = points[count : 2 * count]
        return positions.swapaxes(0, 1), speeds.swapaxes(0, 1)


ExtraFactors = Callable[[WindowGraph, NDArray[np.int64]], Iterable[gtsam.NonlinearFactor]]
"""Your own factors for a person's window, made from its keys (T, J)."""


def undetermined_key(error: RuntimeError) -> int | None:
    """The variable near which GTSAM found a system without a solution; None where the error is another."""
    found = re.search(r"[Ii]ndeterminate? linear system.*?variable\s+(\d+)", str(error), re.DOTALL)
    return None if found is None else int(found[1])


def _cameras(views: Views) -> list[gtsam.PinholeCameraCal3_S2]:
    """GTSAM's cameras: V of them, or T V where they move, row by row."""
    last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*views.cTw.shape[:-2], 1, 4))
    wTc = np.linalg.inv(np.concatenate([views.cTw, last], axis=-2))
    shape = np.broadcast_shapes(views.K.shape[:-2], wTc.shape[:-2])
    K, wTc = np.broadcast_to(views.K, (*shape, 3, 3)), np.broadcast_to(wTc, (*shape, 4, 4))
    return list(map(make_camera, K.reshape(-1, 3, 3), wTc.reshape(-1, 4, 4)))
