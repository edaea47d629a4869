"""A person over a window of frames as one factor graph: a position of every joint in every frame.

Stage II of the paper, the X step: E(X) = w_2D E_2D(X) + w_shape E_shape(X, Theta) with Theta fixed; with
more than one frame, joints have velocities too, and motion factors between their states.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import (
    KernelName,
    body_prior_factors,
    diagonal,
    format_key,
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
from shapepose_fg.estimation.contact import walking
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.in_time import motion_of, near_in_time, spanned
from shapepose_fg.estimation.joint_chains import Chains, Problem, Projections, Said
from shapepose_fg.estimation.minimise import NotFinite, confirmed, descend, undetermined_key
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.estimation.out_of_step import leads

_OF_VIEWS, _OF_BODY = 0, 1
"""Sources of messages about joints, for the keys of their offsets."""


@dataclass(frozen=True)
class UserFactor:
    """A factor of the user's own."""

    factor: gtsam.NonlinearFactor
    keys: tuple[int, ...]
    """Its variables: joints' states of people of the window, and variables of the user's own."""
    name: str
    """The name of the function that made it."""


@dataclass
class Ties:
    """What factors of the user's own tie together, solved as one graph: people of a window, and further variables.

    A person without such factors is alone.
    """

    people: list["WindowGraph"]
    """Whose graphs are one."""
    factors: list[UserFactor] = field(default_factory=list)
    """The user's own factors on them."""
    start: gtsam.Values = field(default_factory=gtsam.Values)
    """Where variables of the user's own start."""
    parts: list[frozenset[tuple[int, int]]] = field(default_factory=list)
    """Variables that are tied to each other, sets without overlap: (track, joint), or (-1, key) of the user's."""
    active: list[UserFactor] = field(default_factory=list)
    """Factors whose variables are all in the last problem; the others are inactive in it."""

    def tie(self, nodes: Iterable[tuple[int, int]]) -> None:
        """Note that a factor joins these variables."""
        joined = frozenset(nodes)
        apart = [each for each in self.parts if not each & joined]
        self.parts = [*apart, joined.union(*(each for each in self.parts if each & joined))]

    def take_in(self, other: "Ties") -> None:
        """Merge with the ties of other people, who share these from now on."""
        if other is self:
            return
        for key in other.start.keys():  # noqa: SIM118 - GTSAM's, not a dictionary's
            if self.start.exists(key):
                raise ValueError(f"your variable {format_key(key)} has two initial values")
        self.start.insert(other.start)
        self.people += other.people
        self.factors += other.factors
        for part in other.parts:
            self.tie(part)
        for person in other.people:
            person.ties = self


class WindowGraph:
    """The graph of one person in T frames; T = 1 is a frame by itself, without velocities.

    Joints are not tied to each other, and people not to people, but by factors of your own, which keeps marginal
    covariances cheap. People who are tied (`ties`) are one graph, and `graph` and `values` are that of them all.

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
        first: Array | None = None,
    ) -> None:
        """Make the factors of all observations: T rows of one person, frames rising.

        `sigmas_px` (T, J, V), 0 where the view did not see the joint; `views` are their cameras; `rows` (T,) says
        which rows of a larger problem they are, `first` (T, J, 3) where joints are
        before anything is solved.
        """
        T, J, _ = sigmas_px.shape
        if np.any(np.diff(observations.frame) <= 0):
            raise ValueError(f"frames of a person must increase, got {observations.frame}")
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
        self.first: Array = np.full((T, J, 3), np.nan) if first is None else first
        """(T, J, 3) where joints are before anything is solved, to within decimetres, metres; NaN where unknown.
        Functions may choose by it what their factors join."""
        self.people: list[WindowGraph] = [self]
        """Everybody in the window, this person too; frame by frame, in the frame."""
        self.ties = Ties([self])
        """The people to whom factors of your own tie this one, and these factors."""
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
        """(T, J, V) whether there is a detection of the joint."""
        return self._observations.seen

    @property
    def temporal(self) -> bool:
        """Whether there is more than one frame: then joints have velocities and motion factors."""
        return len(self) > 1

    @property
    def partners(self) -> "list[WindowGraph]":
        """Those of the window's people who come after this one: so each pair of people comes once."""
        return self.people[next(n for n, each in enumerate(self.people) if each is self) + 1 :]

    def shared(self, other: "WindowGraph") -> tuple[Index, Index]:
        """Rows (S,) of this person, and those of another, of the frames in which both are."""
        _, mine, theirs = np.intersect1d(self.frames, other.frames, assume_unique=True, return_indices=True)
        return mine, theirs

    def add(self, item: gtsam.NonlinearFactor | gtsam.Values, name: str = "") -> None:
        """Append a factor of your own; it stays through all alternations. Or where variables of your own start.

        A factor may be on `state_keys` of this person and of all others of the window (`people`), who are solved
        together then, and on variables of your own that `Values` gave before. While one of its variables is not in
        the problem, because neither views nor body nor motion place it, it is inactive, and `run` counts it under
        the `name` of what made it. ValueError if it is on any other key, and for a start that is a joint's.
        """
        if isinstance(item, gtsam.Values):
            self._add_start(item)
            return
        nodes, touched = list[tuple[int, int]](), list[tuple[WindowGraph, int]]()
        whose = f"your factor{f' ({name})' if name else ''}"
        for key in item.keys():  # noqa: SIM118 - GTSAM's, not a dictionary's
            person = next((each for each in (self, *self.people) if key in each._own), None)
            if person is not None:
                joint = split_key(key).joint
                touched.append((person, joint))
                nodes.append((person.track, joint))
                continue
            holder = self._holder(key)
            if holder is None:
                raise ValueError(
                    f"{whose} uses {format_key(key)}, which is not in this window: use keys of its people"
                    " (`keys` and `velocity_keys` of `window.people`; people are not in every frame), or"
                    " first yield gtsam.Values with the initial value of your variable"
                )
            nodes.append((-1, key))
            self.ties.take_in(holder)
        for person, joint in touched:
            self.ties.take_in(person.ties)
            person.touched[joint] = True
        if len(touched) == 0 and len(nodes) == 0:
            raise ValueError(f"{whose} has no variable")
        self.ties.factors.append(UserFactor(item, tuple(item.keys()), name))
        self.ties.tie(nodes)

    def _add_start(self, start: gtsam.Values) -> None:
        """Where variables of the user's own start; one that has a start keeps it."""
        new = gtsam.Values(start)
        for key in start.keys():  # noqa: SIM118 - GTSAM's, not a dictionary's
            if any(key in person._own for person in self.people):
                raise ValueError(f"{format_key(key)} is the key of a joint: use gtsam.symbol for your variables")
            if self._holder(key) is not None:
                new.erase(key)
        self.ties.start.insert(new)

    def _holder(self, key: int) -> Ties | None:
        """The ties that a variable of the user's own is in."""
        return next((each.ties for each in (self, *self.people) if each.ties.start.exists(key)), None)

    @cached_property
    def _own(self) -> frozenset[int]:
        return frozenset(self.state_keys.ravel().tolist())

    @property
    def coupled(self) -> list[frozenset[int]]:
        """The person's joints that factors of your own tie to each other: sets of two or more, without overlap."""
        mine = [frozenset(joint for track, joint in part if track == self.track) for part in self.ties.parts]
        return [each for each in mine if len(each) > 1]

    @property
    def with_offsets(self) -> Mask:
        """(J,) joints with a factor of your own, in a window of several frames: solved with offsets throughout."""
        return self.touched if self.temporal else np.zeros_like(self.touched)

    def solve(
        self,
        inlier: Mask,
        views: JointTargets,
        body: JointTargets,
        initial: Array,
        lost: Mask | None = None,
        feet: Index | None = None,
    ) -> Array:
        """`prepare` and `optimise`, of a person who is alone; returns joints (T, J, 3), metres."""
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
        """Make the problem of this person's joints, from `initial` (T, J, 3) metres on.

        `inlier` (T, J, V) are the observations that count (delta_ij of Eq. 2), `views` what they say together at
        `initial`, `body` the priors (Eq. 3). A joint with NaN in `initial` is not in the problem and stays NaN; in
        a window of several frames that goes for all frames of the joint. `lost` (T, J): where joints are hardly
        seen. `feet` (F,): joints that may stand (`contact.walking`).

        In a window of several frames each joint is solved by itself first (`joint_chains`), without factors of
        your own, and GTSAM starts there.
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

    def optimise(self) -> None:
        """Minimise over the joints of this person and of all who are tied to them, who must be prepared, too.

        GTSAM takes one last step, or as many as Levenberg-Marquardt needs. `graph` and `values` of all of them are
        those of the whole problem then.
        """
        ties, people = self.ties, self.ties.people
        graph, values = self.graph, self.values
        if len(people) > 1:
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            for person in people:
                graph.push_back(person.graph)
                values.insert(person.values)
        there = values.exists
        ties.active = [
            each for each in ties.factors if all(there(key) or ties.start.exists(key) for key in each.keys)
        ]
        for each in ties.active:
            graph.add(each.factor)
        if not ties.start.empty():
            values = gtsam.Values(values)
            idle = gtsam.Values(ties.start)
            used = {key for each in ties.active for key in each.keys}
            for key in ties.start.keys():  # noqa: SIM118 - GTSAM's, not a dictionary's
                if key not in used:
                    idle.erase(key)
            values.insert(idle)
        failure = ""
        if not values.empty():
            try:
                values = self._minimum(graph, values)
            except NotFinite as error:
                failure = str(error)
            except RuntimeError as error:
                failure = f"the solver failed: its system is singular{_where(error, people)}"
        for person in people:
            person.graph, person.values, person.failure = graph, values, failure
            person.positions, person.velocity = person._points()

    def _problem(
        self, inlier: Mask, views: JointTargets, body: JointTargets, near: Array, lost: Mask | None
    ) -> Problem:
        """What `solve` is asked; how far joints may turn goes by their speed `near` where they are."""
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

    def _minimum(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
        """The solution from `values` on; RuntimeError where there is none."""
        if len(self.ties.factors) > 0:
            chains = all(len(part) == 1 for part in self.ties.parts) and len(self.ties.people) == 1
            over_time = any(person.temporal for person in self.ties.people)
            own = not self.ties.start.empty()
            return descend(
                graph, values, self._ordering() if chains and not own else None, self.config, over_time=over_time
            )
        ordering = self._ordering()
        found = confirmed(graph, values, ordering, self.config)
        return descend(graph, values, ordering, self.config, over_time=self.temporal) if found is None else found

    def _ordering(self) -> gtsam.Ordering:
        """Joint by joint, each from frame to frame: what is eliminated so fills nothing in."""
        return gtsam.Ordering(self.states.swapaxes(0, 1)[self._there.swapaxes(0, 1)].tolist())

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

    def _pulled(self, pulls: JointTargets) -> list[gtsam.NonlinearFactor]:
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
        roots = symmetric_root(said.message.information[known] / said.scale)
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
        """Positions and velocities (T, J, 3) of the last solution."""
        positions, speeds = (np.full((*self.present.shape, 3), np.nan) for _ in range(2))
        if not self.present.any():
            return positions, speeds
        kinds = [(positions, self.keys), *([(speeds, self.velocity_keys)] if self.temporal else [])]
        if len(self.ties.people) > 1 or not self.ties.start.empty():
            for into, keys in kinds:
                into[self.present] = [self.values.atPoint3(key) for key in keys[self.present].tolist()]
            return positions, speeds
        # Values are sorted as keys are: by kind, joint, then frame.
        points, count = gtsam.utilities.extractPoint3(self.values), int(self.present.sum())
        for n, (into, _) in enumerate(kinds):
            into.swapaxes(0, 1)[self.present.T] = points[n * count : (n + 1) * count]
        return positions, speeds


FactorFunction = Callable[[WindowGraph, NDArray[np.int64]], Iterable[gtsam.NonlinearFactor | gtsam.Values]]
"""Your own factors for a person's window, made from its keys (T, J), and from those of `window.people`."""
ExtraFactors = FactorFunction | Sequence[FactorFunction]
"""One such function or several."""


def add_factors(people: Sequence[WindowGraph], functions: Sequence[FactorFunction]) -> None:
    """Add the factors of the user's functions to the people of a window, who are those of one frame each where all
    have a single frame.
    """
    alone = all(len(person) == 1 for person in people)
    together: dict[int, list[WindowGraph]] = {}
    for person in people:
        together.setdefault(int(person.frames[0]) if alone else 0, []).append(person)
    for person in people:
        person.people = together[int(person.frames[0]) if alone else 0]
    for function in functions:
        for person in people:
            for item in function(person, person.keys):
                person.add(item, name_of(function))


def functions_of(given: ExtraFactors | None) -> tuple[FactorFunction, ...]:
    """One function of the user's, several, or none, as several."""
    if given is None:
        return ()
    return (given,) if callable(given) else tuple(given)


def name_of(function: FactorFunction) -> str:
    """What a function of the user's is called."""
    inner = getattr(function, "func", function)  # of functools.partial
    return str(getattr(inner, "__name__", type(inner).__name__))


def _where(error: RuntimeError, people: Sequence[WindowGraph]) -> str:
    """Name the joint that a singular system leaves open."""
    key = undetermined_key(error)
    if key is None or all(key not in set(person.states.ravel().tolist()) for person in people):
        return ""
    joint = split_key(key)
    whose = f" of person {joint.person}" if len(people) > 1 else ""
    return f" near {people[0]._names[joint.joint]}{whose} in frame {joint.frame}: no factor determines it there"


def _cameras(views: Views) -> list[gtsam.PinholeCameraCal3_S2]:
    """GTSAM's cameras: V of them, or T V where they move, row by row."""
    last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*views.cTw.shape[:-2], 1, 4))
    wTc = np.linalg.inv(np.concatenate([views.cTw, last], axis=-2))
    shape = np.broadcast_shapes(views.K.shape[:-2], wTc.shape[:-2])
    K, wTc = np.broadcast_to(views.K, (*shape, 3, 3)), np.broadcast_to(wTc, (*shape, 4, 4))
    return list(map(make_camera, K.reshape(-1, 3, 3), wTc.reshape(-1, 4, 4)))
