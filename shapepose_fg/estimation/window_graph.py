"""Factor graph of a person over a window of frames: a position of every joint in every frame.

Stage II of the paper, the X step: E(X) = w_2D E_2D(X) + w_shape E_shape(X, Theta) with fixed Theta.
With several frames, joints also have velocities, and motion factors between their states.
"""

from collections import deque
from collections.abc import Iterable, Sequence

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
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.decompositions import symmetric_root
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.asynchronous_views import leads
from shapepose_fg.estimation.contact import walking
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.in_time import motion_of, near_in_time, spanned
from shapepose_fg.estimation.joint_chains import Chains, Problem, Projections, Said
from shapepose_fg.estimation.minimise import NotFinite, confirmed, descend, undetermined_key
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.estimation.user_factors import PersonWindow

_OF_VIEWS, _OF_BODY = 0, 1
"""Numbers of the sources of estimates, for the keys of their offsets."""


class WindowGraph(PersonWindow):
    """Graph of one person in T frames; T = 1 is a single frame, without velocities.

    Joints, and people, are coupled only by user factors, so that marginal covariances are cheap.
    Coupled people (`ties`) are one graph; `graph` and `values` are then of all of them.

    **Correlated errors.** A detector that is wrong by 2 cm is so in the next frame too, and so is
    the body's estimate. In a window of several frames therefore

    - projections and body priors have only the white share of their variance, so that motion
      smooths only that;
      `state_covariances` exclude the rest (`reported_covariance.with_lasting` adds it);
    - where a joint is lost (`lost` of `solve`) the body's prior gets a slowly decaying offset
      (`factors.motion`): the
      difference between joint and body when it was seen; and so do the views' estimates, which,
      with nearly parallel
      rays, would otherwise be averaged over time as if independent in every frame;
    - joints with user factors are solved with offsets of both views and body, and the views'
      estimates are one Gaussian
      each: a user factor is weighed against all of the error, and the covariances include it.
    """

    def __init__(
        self,
        observations: Observations,
        sigmas_px: Array,
        views: Views,
        config: EstimatorConfig,
        motion: MotionModel,
        rows: Index | None = None,
        first: Array | None = None,
    ) -> None:
        """Build the factors of all observations: T rows of one person, ascending frames.

        `sigmas_px` (T, J, V), 0 if the view has no detection of the joint; `views` are their
        cameras; `rows` (T,) are the indices in a larger problem, `first` (T, J, 3) the initial
        joints.
        """
        T, J, _ = sigmas_px.shape
        if np.any(np.diff(observations.frame) <= 0):
            raise ValueError(f"frames of a person must increase, got {observations.frame}")
        frames, joints = observations.frame, np.arange(J)
        super().__init__(
            int(observations.track[0]),
            frames,
            observations.time_s.mean(axis=1),
            state_keys(int(observations.track[0]), joints, frames[:, None], motion.law.order),
            rows,
            first,
        )
        self.config = config.graph
        self._motion = motion
        self._observations, self._sigmas_px, self._views = observations, sigmas_px, views
        self._names = config.joints
        self._cameras = _cameras(views)
        self._kernel: KernelName | None = config.observations.robust_kernel
        self._offset_keys = np.stack(
            [
                offset_keys(self.track, joints, self.frames[:, None], source)
                for source in (_OF_VIEWS, _OF_BODY)
            ]
        )
        self.present: Mask = np.zeros((T, J), dtype=bool)
        """(T, J) joints in the last problem."""
        self.positions = self.velocity = np.full((T, J, 3), np.nan)
        """(T, J, 3) positions and velocities of the last solution, metres and m/s; NaN if not in
        it."""
        self.chains: list[Chains] = []
        """The last multi-frame problem, as chains of joints without user factors."""

    @property
    def states(self) -> NDArray[np.int64]:
        """(T, J, n + 2) keys of all variables of a joint in a frame: state, offset of the views,
        offset of the body.
        """
        return np.concatenate([self.state_keys, np.moveaxis(self._offset_keys, 0, -1)], axis=-1)

    @property
    def coupled(self) -> list[frozenset[int]]:
        """Disjoint sets of two or more joints of the person coupled by user factors."""
        mine = [
            frozenset(joint for track, joint in part if track == self.track)
            for part in self.ties.parts
        ]
        return [each for each in mine if len(each) > 1]

    @property
    def with_offsets(self) -> Mask:
        """(J,) joints with a user factor, in a window of several frames: always solved with
        offsets.
        """
        return self.touched if self.temporal else np.zeros_like(self.touched)

    @property
    def seen(self) -> Mask:
        """(T, J, V) whether there is a detection of the joint."""
        return self._observations.seen

    def solve(
        self,
        inlier: Mask,
        views: JointTargets,
        body: JointTargets,
        initial: Array,
        lost: Mask | None = None,
        feet: Index | None = None,
    ) -> Array:
        """`prepare` and `optimise` for a person without coupling; returns joints (T, J,
        3), metres.
        """
        self.prepare(inlier, views, body, initial, lost, feet)
        self.optimise()
        return self.positions

    def prepare(
        self,
        inlier: Mask,
        views: JointTargets,
        body: JointTargets,
        initial: Array,
        lost: Mask | None = None,
        feet: Index | None = None,
    ) -> None:
        """Build the problem of this person's joints, starting at `initial` (T, J, 3) metres.

        `inlier` (T, J, V) are the used observations (delta_ij of Eq. 2), `views` their estimates at
        `initial`, `body` the priors (Eq. 3). A joint with NaN in `initial` is not in the problem
        and stays NaN; in a window of several frames this applies to all frames of the joint. `lost`
        (T, J): weakly observed joints. `feet` (F,): joints that may stand (`contact.walking`). In a
        window of several frames each joint is first solved independently (`joint_chains`), without
        user factors, and GTSAM starts there.
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
        self._add(self._seen(problem.seen))
        if problem.seen.lead_s.any():
            self._add(self._seen_between(problem.seen, states))
        self._add(self._pulled(problem.pulls))
        for source, said in enumerate(problem.said):
            self._add(self._lasting(said, source))
        if self.temporal:
            self._add(self._moving(problem))

    def optimise(self) -> None:
        """Minimise over the joints of this person and all coupled people, who must be prepared,
        too.

        GTSAM takes a single step if that suffices, else Levenberg-Marquardt steps. `graph` and
        `values` of all of them are then those of the whole problem.
        """
        people = self.ties.people
        graph, values = self.ties.joined()
        failure = ""
        if not values.empty():
            try:
                values = self._minimum(graph, values)
            except NotFinite as error:
                failure = str(error)
            except RuntimeError as error:
                failure = (
                    f"the solver failed: its system is singular{_where(error, people, self._names)}"
                )
        for person in people:
            person.set_graph(graph, values)
            person.failure = failure
            assert isinstance(person, WindowGraph)
            person.positions, person.velocity = person._points()

    def _problem(
        self, inlier: Mask, views: JointTargets, body: JointTargets, near: Array, lost: Mask | None
    ) -> Problem:
        """The problem of `solve`; the noise of accelerations depends on speeds at the positions
        `near`.
        """
        of_views = of_body = self.present & self.with_offsets
        density, share = np.zeros((len(self) - 1, near.shape[1])), 1.0
        if self.temporal:
            share = self._motion.views.white_share
            variance = 1.0 / np.maximum(np.linalg.eigvalsh(views.information)[..., 0], 1.0)
            speed, turning = motion_of(near, variance, self.times_s)
            density = self._motion.density(speed, turning=turning)
            if lost is not None:
                around = near_in_time(lost, self.times_s, self._motion.around_s)
                of_body = self.present & (self.with_offsets | around)
                of_views = self.present & (self.with_offsets | lost)
                density = np.where(lost[1:] & lost[:-1], self._motion.density_lost(speed), density)
        # A correlated error is not an outlier, and a weight also multiplies the kernel's cost: in
        # pixels the kernel's width is as before either scaled the sigma.
        scale, weight, xy = (
            np.sqrt(share / self.config.weight_2d),
            self.config.weight_shape,
            self._observations.xy,
        )
        lead = leads(self._observations, self._views) if self.temporal else np.zeros(inlier.shape)
        used = inlier & (self._sigmas_px > 0) & (self.present & ~of_views)[..., None]
        return Problem(
            times_s=self.times_s,
            law=self._motion.law,
            density=density,
            seen=Projections(
                self._views, xy, self._sigmas_px * scale, used, lead, self._kernel, scale
            ),
            pulls=body.where(self.present & ~of_body, weight / share),
            said=(
                Said(views, 1.0 / self.config.weight_2d, self._motion.views, of_views),
                Said(body, 1.0 / weight, self._motion.body, of_body),
            ),
            standing=np.full(density.shape, np.inf),
        )

    def _minimum(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        """The solution, starting at `values`; raises RuntimeError if there is none."""
        if len(self.ties.factors) > 0:
            chains = all(len(part) == 1 for part in self.ties.parts) and len(self.ties.people) == 1
            over_time = any(person.temporal for person in self.ties.people)
            own = not self.ties.start.empty()
            return descend(
                graph,
                values,
                self._ordering() if chains and not own else None,
                self.config,
                over_time=over_time,
            )
        ordering = self._ordering()
        found = confirmed(graph, values, ordering, self.config)
        return (
            descend(graph, values, ordering, self.config, over_time=self.temporal)
            if found is None
            else found
        )

    def _ordering(self) -> gtsam.Ordering:
        """Elimination by joint, then frame, which causes no fill-in."""
        return gtsam.Ordering(self.states.swapaxes(0, 1)[self._there.swapaxes(0, 1)].tolist())

    def _add(self, factors: Iterable[gtsam.NonlinearFactor]) -> None:
        deque(map(self.graph.add, factors), maxlen=0)

    def _seen(self, seen: Projections) -> Sequence[gtsam.NonlinearFactor]:
        """Projection factors of used observations exposed at the frame's time."""
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
        """Factors of the others, linearised at `states` (T, J, S, 3): one per joint and frame."""
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

    def _pulled(self, pulls: JointTargets) -> list[gtsam.NonlinearFactor]:
        """Body prior factors on joints."""
        known = pulls.known
        covariances = np.linalg.inv(pulls.information[known])
        symmetric = (covariances + covariances.swapaxes(1, 2)) / 2
        return list(body_prior_factors(self.keys[known], pulls.xyz[known], symmetric))

    def _lasting(self, said: Said, source: int) -> list[gtsam.NonlinearFactor]:
        """Factors of estimates with correlated errors, with a slowly decaying offset each."""
        if not said.where.any():
            return []
        known, keys = said.message.known & said.where, self._offset_keys[source]
        roots = symmetric_root(said.message.information[known] / said.scale)
        xyz, share = said.message.xyz[known], said.errors.white_share
        factors = lasting_prior_factors(self.keys[known], keys[known], xyz, roots, share)
        # An offset in every frame of the span, so that a joint's states are a chain.
        chain = spanned(said.where)
        for joint in np.flatnonzero(chain.any(axis=0)).tolist():
            there = chain[:, joint]
            factors += offset_factors(
                keys[there, joint], self.times_s[there], said.errors.correlation_s
            )
        return factors

    def _moving(self, problem: Problem) -> list[gtsam.NonlinearFactor]:
        """Motion factors of the joints in the problem, and factors of standing feet."""
        factors = list[gtsam.NonlinearFactor]()
        unknown = [diagonal(np.full(3, sigma)) for sigma in problem.law.start]
        for joint in np.flatnonzero(self.present[0]).tolist():
            states = self.state_keys[:, joint]
            for key, noise in zip(states[0, 1:].tolist(), unknown, strict=True):
                factors.append(gtsam.PriorFactorPoint3(key, np.zeros(3), noise))
            factors += problem.law.factors(states, self.times_s, problem.density[:, joint])
        step, joint = np.nonzero(np.isfinite(problem.standing))
        before, after, held = (
            self.keys[step, joint],
            self.keys[step + 1, joint],
            problem.standing[step, joint],
        )
        return factors + standing_factors(before, after, np.diff(self.times_s)[step], held)

    def _start(self, states: Array) -> None:
        """Set `values` from `states` (T, J, S, 3), NaN where absent."""
        self._there = np.isfinite(states[..., 0])
        self.build()
        deque(
            map(self.values.insert, self.states[self._there].tolist(), states[self._there]),
            maxlen=0,
        )

    def _points(self) -> tuple[Array, Array]:
        """Positions and velocities (T, J, 3) of the last solution."""
        positions, speeds = (np.full((*self.present.shape, 3), np.nan) for _ in range(2))
        if not self.present.any():
            return positions, speeds
        kinds = [(positions, self.keys), *([(speeds, self.velocity_keys)] if self.temporal else [])]
        if len(self.ties.people) > 1 or not self.ties.start.empty():
            for into, keys in kinds:
                into[self.present] = [
                    self.values.atPoint3(key) for key in keys[self.present].tolist()
                ]
            return positions, speeds
        # Values are sorted by key: kind, joint, frame.
        points, count = gtsam.utilities.extractPoint3(self.values), int(self.present.sum())
        for n, (into, _) in enumerate(kinds):
            into.swapaxes(0, 1)[self.present.T] = points[n * count : (n + 1) * count]
        return positions, speeds


def _where(error: RuntimeError, people: Sequence[PersonWindow], names: Sequence[str]) -> str:
    """Description of the joint that a singular system leaves undetermined."""
    key = undetermined_key(error)
    if key is None or all(key not in set(person.states.ravel().tolist()) for person in people):
        return ""
    joint = split_key(key)
    whose = f" of person {joint.person}" if len(people) > 1 else ""
    return (
        f" near {names[joint.joint]}{whose} in frame {joint.frame}: no factor determines it there"
    )


def _cameras(views: Views) -> list[gtsam.PinholeCameraCal3_S2]:
    """GTSAM cameras: V of them, or T V by row if they move."""
    last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*views.cTw.shape[:-2], 1, 4))
    wTc = np.linalg.inv(np.concatenate([views.cTw, last], axis=-2))
    shape = np.broadcast_shapes(views.K.shape[:-2], wTc.shape[:-2])
    K, wTc = np.broadcast_to(views.K, (*shape, 3, 3)), np.broadcast_to(wTc, (*shape, 4, 4))
    return list(map(make_camera, K.reshape(-1, 3, 3), wTc.reshape(-1, 4, 4)))
