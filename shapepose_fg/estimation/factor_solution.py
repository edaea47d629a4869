"""Solves people whose bodies are in the graph together with the factors that users add to them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.estimation.body_window import Marginals
from shapepose_fg.estimation.estimator_config import WindowGraphConfig
from shapepose_fg.estimation.minimise import NotFinite, descend
from shapepose_fg.estimation.person_graph import BodyGraph, graph_covariances, ordering
from shapepose_fg.estimation.user_factors import CoupledGraph
from shapepose_fg.estimation.window_solution import RUNAWAY_M

_ROUNDS, _STEPS = 8, 4
"""Maximum number of linearisations of the bodies, and of GTSAM's steps around each; detections are
gated anew in each."""
_SETTLED_M = 5e-4
"""Mean motion of joints at which a solution has converged, m."""


@dataclass(frozen=True)
class FactorSolution:
    """A person solved with user factors."""

    person: BodyGraph
    """The person, whose state and graph are those of the solution."""
    covariance: Array
    """(T, J, 3, 3) covariances of the joints in the graph, m²."""
    marginals: Marginals
    """Marginal covariances of the person's window in this solution."""


def solve_with_factors(
    people: Sequence[BodyGraph], config: WindowGraphConfig
) -> list[FactorSolution]:
    """Solve the people of a window who have active user factors; people whom factors couple are
    solved as one graph.

    In each round GTSAM minimises the graph linearised at the present bodies; then bodies are
    linearised, and detections gated, again. People whose solution fails keep their previous state,
    with a `failure`.
    """
    found = list[FactorSolution]()
    for ties in {id(each.ties): each.ties for each in people if each.ties.factors}.values():
        found += _solved([each for each in people if each.ties is ties], ties, config)
    return found


def _solved(
    people: list[BodyGraph], ties: CoupledGraph, config: WindowGraphConfig
) -> list[FactorSolution]:
    limited = replace(config, max_iterations=min(config.max_iterations, _STEPS))
    before = [(each.state, each.window.last) for each in people]
    for each in people:
        each.refresh()
    try:
        for _ in range(_ROUNDS):
            graph, values = _joined(people, ties)
            if len(ties.active) == 0:
                return []
            order = ordering(people, values)
            values = descend(graph, values, order, limited, over_time=people[0].temporal)
            moved = [each.take(values) for each in people]
            _keep_own(ties, values)
            for each in people:
                displacement_m = np.linalg.norm(
                    each.window.joints(each.state) - each.first, axis=-1
                )
                if not displacement_m[:, each.touched].max(initial=0.0) < RUNAWAY_M:
                    raise NotFinite("diverged from its views and the body")
            if max(moved) < _SETTLED_M:
                break
        graph, values = _joined(people, ties)
        every = graph_covariances(graph, values, ordering(people, values))
    except RuntimeError as error:
        singular = "the solver failed: its system is singular"
        for each, (state, last) in zip(people, before, strict=True):
            each.state, each.window.last = state, last
            each.failure = ties.problem or (
                str(error) if isinstance(error, NotFinite) else singular
            )
        return []
    finally:  # whoever asks for a graph gets the one with all joints
        for each in people:
            each.set_graph(None)
    return [FactorSolution(each, *_covariances(each, every)) for each in people]


def _covariances(person: BodyGraph, every: dict[tuple[int, int], Array]) -> tuple[Array, Marginals]:
    """Covariances of the joints of a solved person, and the marginals of the model."""
    marginals = person.marginals(every)
    found = person.widen * marginals.joints()
    for joint in np.flatnonzero(person.touched):
        found[:, joint] = [every[key, key] for key in person.keys[:, joint].tolist()]
    return found, marginals


def _joined(
    people: list[BodyGraph], ties: CoupledGraph
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The graph around the present state of the people, and its values: with the joints that user
    factors are on.
    """
    for each in people:
        each.part(each.touched)
    return ties.joined()


def _keep_own(ties: CoupledGraph, values: gtsam.Values) -> None:
    """Start the next round at the present values of the user's variables."""
    solved, idle = gtsam.Values(values), gtsam.Values(ties.start)
    for key in values.keys():  # noqa: SIM118 - GTSAM's, not a dictionary's
        if ties.start.exists(key):
            idle.erase(key)
        else:
            solved.erase(key)
    solved.insert(idle)
    ties.start = solved
