"""Factors that users add to a person's window: their rules, and which people they couple."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import format_key
from shapepose_fg.core.arrays import Array, Index, Mask, Whole


@dataclass(frozen=True)
class UserFactor:
    """A factor that a function of the user has added to the graph of people."""

    factor: gtsam.NonlinearFactor
    keys: tuple[int, ...]
    """Variables of the factor: states of joints of people in the window, and user variables."""
    name: str
    """Name of the function that created the factor."""

    def problem(self, values: gtsam.Values) -> str:
        """Compute the error at `values`, and describe it if it is not finite; empty if it is.

        ValueError if it cannot be computed: a solver reports that as a singular system, without the
        name of the factor.
        """
        what = f"{_called(self.name)} on {', '.join(map(format_key, self.keys))}"
        try:
            error = self.factor.error(values)
        except (ValueError, RuntimeError) as reason:
            raise ValueError(f"{what} cannot be computed: {reason}") from reason
        return "" if np.isfinite(error) else f"the error of {what} is not finite"


@dataclass
class CoupledGraph:
    """People of a window, and user variables, that user factors couple, and that are solved as one
    graph.

    A person without such factors is separate.
    """

    people: list["PersonWindow"]
    """The people in this graph."""
    factors: list[UserFactor] = field(default_factory=list)
    """The user factors that couple these people."""
    start: gtsam.Values = field(default_factory=gtsam.Values)
    """Initial values of user variables."""
    parts: list[frozenset[tuple[int, int]]] = field(default_factory=list)
    """Disjoint sets of coupled variables: (track, joint), or (-1, key) for user variables."""
    active: list[UserFactor] = field(default_factory=list)
    """Factors with all variables in the last problem; the others were inactive."""
    computed: set[int] = field(default_factory=set)
    """Identities of the factors whose error has been computed."""
    problem: str = ""
    """Description of the first user factor with an error that is not finite; empty if there is
    none."""

    def tie(self, nodes: Iterable[tuple[int, int]]) -> None:
        """Record that a factor couples these variables (`parts`)."""
        joined = frozenset(nodes)
        others = [each for each in self.parts if not each & joined]
        self.parts = [*others, joined.union(*(each for each in self.parts if each & joined))]

    def take_in(self, other: "CoupledGraph") -> None:
        """Merge with the coupling of other people, who share this object from now on."""
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

    def joined(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """The factors and values of all people, the active user factors, which are last, and the
        user variables in them.

        ValueError for a factor that cannot be computed.
        """
        if len(self.people) == 1 and len(self.factors) == 0:
            return self.people[0].graph, self.people[0].values
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for person in self.people:
            graph.push_back(person.graph)
            values.insert(person.values)
        self.active = [
            each
            for each in self.factors
            if all(values.exists(key) or self.start.exists(key) for key in each.keys)
        ]
        for each in self.active:
            graph.add(each.factor)
        idle = gtsam.Values(self.start)
        for key in self.start.keys():  # noqa: SIM118 - GTSAM's, not a dictionary's
            if all(key not in each.keys for each in self.active):
                idle.erase(key)
        values.insert(idle)
        for each in self.active:
            if id(each) not in self.computed:
                self.problem = self.problem or each.problem(values)
                self.computed.add(id(each))
        return graph, values


class PersonWindow:
    """One person in T frames, as functions that make user factors see it; with the graph of these
    factors.
    """

    def __init__(
        self,
        track: int,
        frames: Whole,
        times_s: Array,
        keys: NDArray[np.int64],
        rows: Index | None = None,
        first: Array | None = None,
    ) -> None:
        """Make the window of a `track`; `keys` (T, J, n) are those of each joint's state."""
        T, J, _ = keys.shape
        self.track = track
        """Track number of the person."""
        self.frames = frames
        """(T,) frame of each row."""
        self.times_s = times_s
        """(T,) time of each frame, seconds."""
        self.state_keys = keys
        """(T, J, n) keys of each joint's state, a `Point3` each: position, velocity, and further
        derivatives of the motion model; in the graph of a single frame, positions only."""
        self.body_keys: NDArray[np.int64] = np.full(T, -1)
        """(T,) key of each frame's body, a vector; -1 where bodies are not variables."""
        self.shape_key = -1
        """Key of the body's shape, a vector (10,) of betas; -1 where it is not a variable."""
        self.rows: Index = np.arange(T) if rows is None else rows
        """(T,) row indices in the whole problem."""
        self.first: Array = np.full((T, J, 3), np.nan) if first is None else first
        """(T, J, 3) initial joints, metres; NaN if unknown. Functions may use them to choose what
        their factors connect."""
        self.people: list[PersonWindow] = [self]
        """All people in the window, including this one; for single frames, in the frame."""
        self.ties = CoupledGraph([self])
        """The people coupled to this one by user factors, and these factors."""
        self.touched: Mask = np.zeros(J, dtype=bool)
        """(J,) joints with a user factor."""
        self.failure = ""
        """Reason why the last solution failed; empty on success."""
        self._graph: gtsam.NonlinearFactorGraph | None = None
        self._values = gtsam.Values()

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The factors of the last solution; of all coupled people, with the active user factors
        last.
        """
        if self._graph is None:
            self.build()
        assert self._graph is not None
        return self._graph

    @property
    def values(self) -> gtsam.Values:
        """The last solution, for `gtsam.Marginals` and for graphs to which this one is added."""
        if self._graph is None:
            self.build()
        return self._values

    def set_graph(
        self, graph: gtsam.NonlinearFactorGraph | None, values: gtsam.Values | None = None
    ) -> None:
        """Set the factors and the solution; without them, they are made when they are asked for."""
        self._graph, self._values = graph, gtsam.Values() if values is None else values

    def build(self) -> "PersonWindow":
        """Make `graph` and `values` of this person only."""
        self.set_graph(gtsam.NonlinearFactorGraph(), gtsam.Values())
        return self

    def of_body(self, t: int, joint: int) -> Array:
        """(3, 3) information on a joint in row `t` from its body in the same frame, without the
        joint's own views, 1/m².
        """
        raise NotImplementedError

    widen = 1.0
    """Ratio of all variances in the graph to those of its noise models."""

    @property
    def seen(self) -> Mask:
        """(T, J, V) whether there is a detection of the joint."""
        raise NotImplementedError

    @property
    def keys(self) -> NDArray[np.int64]:
        """(T, J) key of each joint's position, `Point3`, metres."""
        return self.state_keys[..., 0]

    @property
    def velocity_keys(self) -> NDArray[np.int64]:
        """(T, J) key of each joint's velocity, `Point3`, m/s; not in the graph of a single
        frame.
        """
        return self.state_keys[..., 1]

    def __len__(self) -> int:
        """Number of frames, T."""
        return len(self.frames)

    @property
    def temporal(self) -> bool:
        """Whether there are several frames, so that joints have velocities and motion factors."""
        return len(self) > 1

    @property
    def partners(self) -> "list[PersonWindow]":
        """The window's people after this one, so that each pair occurs once."""
        return self.people[next(n for n, each in enumerate(self.people) if each is self) + 1 :]

    def shared(self, other: "PersonWindow") -> tuple[Index, Index]:
        """Rows (S,) of this person and of another in their common frames."""
        _, rows, other_rows = np.intersect1d(
            self.frames, other.frames, assume_unique=True, return_indices=True
        )
        return rows, other_rows

    def add(self, item: gtsam.NonlinearFactor | gtsam.Values, name: str = "") -> None:
        """Add a user factor, which stays through all alternations, or initial values of user
        variables.

        A factor may be on variables of this person and of all others of the window (`people`), who
        are then solved jointly, and on user variables with initial values given before. It is
        inactive while one of its variables is not in the problem, because neither views nor body
        nor motion determine it, and `run` counts it under `name`, the function that created it.
        Raises ValueError for any other key, for initial values of a joint, for a sigma of 0, and
        for an `item` of any other type.
        """
        if isinstance(item, gtsam.Values):
            self._add_start(item)
            return
        nodes, touched = list[tuple[int, int]](), list[tuple[PersonWindow, int]]()
        refuse_unsuitable(item, name)
        what = _called(name)
        for key in item.keys():  # noqa: SIM118 - GTSAM's, not a dictionary's
            person = next((each for each in (self, *self.people) if key in each._own), None)
            if person is not None:
                joint = person._own[key]
                touched.append((person, joint))
                nodes.append((person.track, joint))
                continue
            holder = self._holder(key)
            if holder is None:
                raise ValueError(
                    f"{what} uses {format_key(key)}, which is not in this window: use keys of "
                    "its people (`keys`, `velocity_keys`, `body_keys` and `shape_key` of "
                    "`window.people`; people are not in every frame), or first yield gtsam.Values "
                    "with the initial value of your variable"
                )
            nodes.append((-1, key))
            self.ties.take_in(holder)
        for person, joint in touched:
            self.ties.take_in(person.ties)
            person.touched[joint : joint + 1] |= joint >= 0
        if len(touched) == 0 and len(nodes) == 0:
            raise ValueError(f"{what} has no variable; give it the keys of joints")
        self.ties.factors.append(UserFactor(item, tuple(item.keys()), name))
        self.ties.tie(nodes)

    def _add_start(self, start: gtsam.Values) -> None:
        """Add initial values of user variables; existing ones are kept."""
        new = gtsam.Values(start)
        for key in start.keys():  # noqa: SIM118 - GTSAM's, not a dictionary's
            if any(key in person._own for person in self.people):
                raise ValueError(
                    f"{format_key(key)} is the key of a joint: use gtsam.symbol for your variables"
                )
            if self._holder(key) is not None:
                new.erase(key)
        self.ties.start.insert(new)

    def _holder(self, key: int) -> CoupledGraph | None:
        """The coupling that contains a user variable."""
        return next(
            (each.ties for each in (self, *self.people) if each.ties.start.exists(key)), None
        )

    @cached_property
    def _own(self) -> dict[int, int]:
        """Keys of the person's variables on which factors may be, with the index of their joint; -1
        for variables of the body.
        """
        joint = np.broadcast_to(np.arange(self.state_keys.shape[1])[:, None], self.state_keys.shape)
        body = [key for key in (*self.body_keys.tolist(), self.shape_key) if key >= 0]
        own = dict(zip(self.state_keys.ravel().tolist(), joint.ravel().tolist(), strict=True))
        return own | dict.fromkeys(body, -1)


FactorFunction = Callable[
    [PersonWindow, NDArray[np.int64]], Iterable[gtsam.NonlinearFactor | gtsam.Values]
]
"""Function that makes your own factors for a person's window, from its keys (T, J) and those of
`window.people`."""
ExtraFactors = FactorFunction | Sequence[FactorFunction]
"""One function for user factors, or several."""


def add_factors(people: Sequence[PersonWindow], functions: Sequence[FactorFunction]) -> None:
    """Add the factors of user functions to the people of a window; if all have a single frame, to
    those of each frame.
    """
    single_frames = all(len(person) == 1 for person in people)
    together: dict[int, list[PersonWindow]] = {}
    for person in people:
        together.setdefault(int(person.frames[0]) if single_frames else 0, []).append(person)
    for person in people:
        person.people = together[int(person.frames[0]) if single_frames else 0]
    for function in functions:
        for person in people:
            for item in items_of(function(person, person.keys), name_of(function)):
                person.add(item, name_of(function))


def functions_of(given: ExtraFactors | None) -> tuple[FactorFunction, ...]:
    """User functions as a tuple; ValueError if they are not functions."""
    if given is None:
        return ()
    functions = (given,) if callable(given) else tuple(given)
    for each in functions:
        if not callable(each):
            raise ValueError(
                f"extra_factors must be a function (window, keys), or a list of them, got {each!r}"
            )
    return functions


def items_of(returned: object, name: str) -> Iterable[Any]:
    """What the function `name` of the user returned; ValueError if it cannot be gone through."""
    if not isinstance(returned, Iterable):
        raise ValueError(
            f"{name} returned a {type(returned).__name__} instead of factors: yield them one by "
            "one, or return a list of them"
        )
    return returned


def refuse_unsuitable(factor: object, name: str) -> None:
    """Raise ValueError if a `factor` of the function `name` is none, or has a sigma of 0."""
    if not isinstance(factor, gtsam.NonlinearFactor):
        raise ValueError(
            f"{_called(name)} is a {type(factor).__name__}: yield factors of GTSAM, or, on people, "
            "gtsam.Values with initial values of your variables"
        )
    if _is_constrained(factor):
        raise ValueError(
            f"{_called(name)} has a sigma of 0, which the solver does not meet: give it a small "
            "one, for example isotropic(3, 0.001)"
        )


def _called(name: str) -> str:
    """A factor in messages, by the name of the function that created it."""
    return f"your factor ({name})" if name else "your factor"


def _is_constrained(factor: gtsam.NonlinearFactor) -> bool:
    """Whether a sigma of the factor is 0. Levenberg-Marquardt weighs such a factor by a number of
    its own when it compares errors, rejects the steps that meet it, and stays where it is.
    """
    model = getattr(factor, "noiseModel", None)
    noise = None if model is None else model()
    while isinstance(noise, gtsam.noiseModel.Robust):
        noise = noise.noise()
    return noise is not None and noise.isConstrained()


def name_of(function: Callable[..., Any]) -> str:
    """Name of a user function."""
    inner = getattr(function, "func", function)  # of functools.partial
    return str(getattr(inner, "__name__", type(inner).__name__))


def factors_of(people: Sequence[PersonWindow]) -> dict[str, tuple[int, int]]:
    """Number of factors by user function, and how many were inactive in the last problem."""
    ties = {id(person.ties): person.ties for person in people}.values()
    made, active = (
        Counter(factor.name for each in ties for factor in of(each))
        for of in (lambda each: each.factors, lambda each: each.active)
    )
    return {name: (count, count - active[name]) for name, count in made.items()}
