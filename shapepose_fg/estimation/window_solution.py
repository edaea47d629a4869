"""A person over a window of frames, solved: joints, covariances, and one graph that says all of it."""

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import lasting_difference_factors, offset_factors, offset_keys, reported_keys
from shapepose_fg.body.fitting.fitter import BodyFit
from shapepose_fg.estimation.motion_model import Lasting
from shapepose_fg.estimation.window_graph import WindowGraph

LEAST_M = 1e-4
"""Where the solver's graph leaves a joint no less certain than it is reported, its error is taken to be this much
larger, metres."""
_OF_SOLUTION = 2
"""Source of the offset of the whole solution, for keys."""


@dataclass(frozen=True)
class WindowSolution:
    """One person in T frames.

    The graph that is solved holds the share of all errors that is new in every frame: motion smooths no more. What
    is reported has the rest, too: detections and body err alike for a while, a detection may be another's, a limb
    may be exchanged. `graph` holds all of it: beside each position of the solver's graph there is a reported one,
    which differs by what was found after solving, with an error that lasts. Its marginal covariances, of `keys`,
    are the reported ones, and its values the reported joints.
    """

    rows: NDArray[np.intp]
    """(T,) rows of the estimates, frames rising."""
    joints: NDArray[np.float64]
    """(T, J, 3) where the joints are reported, metres in the world; NaN where unknown."""
    covariance: NDArray[np.float64]
    """(T, J, 3, 3) as it is reported, m²; NaN where unknown."""
    bodies: BodyFit
    """The bodies, T rows."""
    window: WindowGraph
    """What the solver solved."""
    solved: NDArray[np.float64]
    """(T, J, 3) where the solver has the joints, metres."""
    solved_covariance: NDArray[np.float64]
    """(T, J, 3, 3) and how surely: marginals of its graph, m²."""
    lasting: Lasting
    """How the error goes on that is in the report and not in the solver's graph."""

    @property
    def person(self) -> int:
        """Who it is: the person number in all keys."""
        return self.window.track

    @property
    def frames(self) -> NDArray[np.integer]:
        """(T,) frame of each row."""
        return self.window.frames

    @property
    def keys(self) -> NDArray[np.int64]:
        """(T, J) keys of the reported positions, `Point3`, metres; those of joints that are unknown (NaN) are not
        in the graph.
        """
        return reported_keys(self.person, np.arange(self.joints.shape[1]), self.frames[:, None])

    @property
    def velocity_keys(self) -> NDArray[np.int64]:
        """(T, J) keys of the velocities, `Point3`, m/s; not in the graph of a single frame."""
        return self.window.velocity_keys

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All factors: projections, bodies, motion, your own, and the errors that last. Joint by joint it is a
        chain over time, unless factors of your own tie joints.
        """
        graph = gtsam.NonlinearFactorGraph(self.window.graph)
        reported, offsets, known = self.keys, self._offset_keys, self._known
        factors = lasting_difference_factors(
            reported[known],
            self.window.keys[known],
            offsets[known],
            (self.joints - self.solved)[known],
            self._more[known],
            self.lasting.white_share,
        )
        for joint in np.flatnonzero(known.any(axis=0)).tolist():
            there = known[:, joint]
            factors += offset_factors(
                offsets[there, joint], self.window.times_s[there], self.lasting.correlation_s
            )
        for factor in factors:
            graph.push_back(factor)
        return graph

    @cached_property
    def values(self) -> gtsam.Values:
        """The solution: the solver's variables, the reported positions, and their offsets, which are 0."""
        values, known, zero = gtsam.Values(self.window.values), self._known, np.zeros(3)
        for key, place in zip(self.keys[known].tolist(), self.joints[known], strict=True):
            values.insert(key, place)
        for key in self._offset_keys[known].tolist():
            values.insert(key, zero)
        return values

    @property
    def _offset_keys(self) -> NDArray[np.int64]:
        return offset_keys(self.person, np.arange(self.joints.shape[1]), self.frames[:, None], _OF_SOLUTION)

    @property
    def _known(self) -> NDArray[np.bool_]:
        """(T, J) joints that are reported, and how surely."""
        finite = np.isfinite(self.covariance).all(axis=(2, 3)) & np.isfinite(self.solved_covariance).all(
            axis=(2, 3)
        )
        return np.asarray(finite & np.isfinite(self.joints).all(axis=2) & self.window.present)

    @property
    def _more(self) -> NDArray[np.float64]:
        """(T, J, 3, 3) what the reported covariances are larger by, m²: positive definite."""
        more = np.where(self._known[..., None, None], self.covariance - self.solved_covariance, np.eye(3))
        values, vectors = np.linalg.eigh((more + more.mT) / 2)
        return (vectors * np.maximum(values, LEAST_M**2)[..., None, :]) @ vectors.mT
