"""People of a window on their way through Algorithm 1."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, FitStatus, JointTargets
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.draft import first_places
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.linearisation import ViewEvidence, observation_sigmas
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.estimation.window_graph import FactorFunction, WindowGraph, add_factors


@dataclass
class State:
    """N rows: what is given, and what each round changes."""

    observations: Observations
    """Which detections each row has."""
    views: Views
    """The cameras."""
    sigmas: Array
    """(N, J, V) standard deviations of the observations, pixels; 0 where there are none."""
    first: Array
    """(N, J, 3) X_0, metres; NaN where unknown."""
    config: EstimatorConfig
    """How."""
    motion: MotionModel
    """How joints move, and how long errors last."""
    people: list[WindowGraph]
    """Everybody's factors."""
    joints: Array
    """(N, J, 3) X, metres; NaN where unknown."""
    inlier: Mask
    """(N, J, V) delta_ij of Eq. 2: which observations were kept."""
    contradicts: Mask
    """(N, J) joints whose views the body contradicts (`disagreement`): gated anew from the body's place."""
    of_views: JointTargets
    """What the views alone say of N rows, all of the error in it."""
    of_body: JointTargets
    """What the body says of each joint without the joint's own views; zero where it does not pull."""
    enough: Mask
    """(N,) rows whose views place enough joints to place a person."""
    fit: BodyFit
    """Theta: the bodies, N rows."""
    told: JointTargets
    """What they were fitted to."""

    @classmethod
    def start(
        cls,
        observations: Observations,
        views: Views,
        fitter: BodyFitter,
        config: EstimatorConfig,
        motion: MotionModel,
        extra_factors: Sequence[FactorFunction] = (),
    ) -> "State":
        """X_0, the observations' sigmas there, and a graph for everybody, with the user's factors in it."""
        first = first_places(observations, views, fitter, config)
        sigmas = observation_sigmas(observations, first, views, config.observations, config.joints)
        people = list[WindowGraph]()
        for rows in window_rows(observations):
            given = observations.rows(rows), sigmas[rows], views.rows(rows)
            people.append(WindowGraph(*given, config, motion, rows, first[rows]))
        if len(extra_factors) > 0:
            add_factors(people, extra_factors)
        N, J, V = sigmas.shape
        of_views, of_body = (JointTargets(np.full((N, J, 3), np.nan), np.zeros((N, J, 3, 3))) for _ in range(2))
        return cls(
            observations, views, sigmas, first, config, motion, people, first.copy(),
            np.zeros((N, J, V), dtype=bool), np.zeros((N, J), dtype=bool), of_views, of_body,
            np.zeros(N, dtype=bool),
            BodyFit.failed(np.full(N, FitStatus.TOO_FEW_JOINTS), J),
            JointTargets(np.zeros((N, J, 3)), np.zeros((N, J, 3, 3))),
        )  # fmt: skip

    def put(
        self, rows: Index, joints: Array, evidence: ViewEvidence, wrong: Mask, of_body: JointTargets, fit: BodyFit
    ) -> None:
        """What a round found of some `rows` (R,)."""
        self.joints[rows], self.inlier[rows] = joints, evidence.inlier
        self.contradicts[rows] |= wrong
        for kept, new in ((self.of_views, evidence.message), (self.of_body, of_body)):
            kept.xyz[rows], kept.information[rows] = new.xyz, new.information
        self.fit = self.fit.with_rows(rows, fit)


def parts_of(people: Sequence[WindowGraph]) -> list[tuple[WindowGraph, slice]]:
    """Everybody with their place among the rows of all these people."""
    ends = np.cumsum([len(person) for person in people]).tolist()
    return [(person, slice(end - len(person), end)) for person, end in zip(people, ends, strict=True)]


def window_rows(observations: Observations) -> list[Index]:
    """Rows of each window, frames rising: those of one track. ValueError where a person is twice in a frame."""
    order = np.lexsort((observations.frame, observations.track))
    track, frame = observations.track[order], observations.frame[order]
    if np.any((np.diff(track) == 0) & (np.diff(frame) == 0)):
        raise ValueError("a track may have only one row per frame: give each person another track number")
    return np.split(order, np.flatnonzero(np.diff(track)) + 1) if len(order) else []
