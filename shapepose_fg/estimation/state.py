"""State of the people of a window during Algorithm 1."""

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
from shapepose_fg.estimation.user_factors import FactorFunction, add_factors
from shapepose_fg.estimation.window_graph import WindowGraph


@dataclass
class State:
    """N rows: inputs, and results of the rounds."""

    observations: Observations
    """Observations with the assigned detections of each row."""
    views: Views
    """The cameras."""
    sigmas: Array
    """(N, J, V) standard deviations of the observations, pixels; 0 without one."""
    first: Array
    """(N, J, 3) X_0, metres; NaN if unknown."""
    config: EstimatorConfig
    """Settings of stage II."""
    people: list[WindowGraph]
    """Graphs of the people."""
    joints: Array
    """(N, J, 3) X, metres; NaN if unknown."""
    inlier: Mask
    """(N, J, V) delta_ij of Eq. 2: the used observations."""
    contradicts: Mask
    """(N, J) joints with views that contradict the body (`disagreement`), gated again at the body's
    position."""
    of_views: JointTargets
    """Estimates from the views only, N rows, including all of the error."""
    of_body: JointTargets
    """Constraints from the body without each joint's own views; zero where it is not used."""
    enough: Mask
    """(N,) rows with enough joints determined by the views."""
    fit: BodyFit
    """Theta: the bodies, N rows."""
    targets: JointTargets
    """Targets to which the bodies were fitted."""

    @classmethod
    def start(
        cls,
        observations: Observations,
        views: Views,
        fitter: BodyFitter,
        config: EstimatorConfig,
        extra_factors: Sequence[FactorFunction] = (),
    ) -> "State":
        """Initial state: X_0, standard deviations of the observations there, and graphs including
        user factors.
        """
        first = first_places(observations, views, fitter, config)
        sigmas = observation_sigmas(observations, first, views, config.observations, config.joints)
        people = list[WindowGraph]()
        for rows in np.concatenate([np.empty(0, np.intp), *window_rows(observations)])[:, None]:
            given = observations.rows(rows), sigmas[rows], views.rows(rows)
            people.append(WindowGraph(*given, config, rows, first[rows]))
        if len(extra_factors) > 0:
            add_factors(people, extra_factors)
        N, J, V = sigmas.shape
        of_views, of_body = (
            JointTargets(np.full((N, J, 3), np.nan), np.zeros((N, J, 3, 3))) for _ in range(2)
        )
        return cls(
            observations, views, sigmas, first, config, people, first.copy(),
            np.zeros((N, J, V), dtype=bool), np.zeros((N, J), dtype=bool), of_views, of_body,
            np.zeros(N, dtype=bool),
            BodyFit.failed(np.full(N, FitStatus.TOO_FEW_JOINTS), J),
            JointTargets(np.zeros((N, J, 3)), np.zeros((N, J, 3, 3))),
        )  # fmt: skip

    def put(
        self,
        rows: Index,
        joints: Array,
        evidence: ViewEvidence,
        wrong: Mask,
        of_body: JointTargets,
        fit: BodyFit,
    ) -> None:
        """Store the results of a round for some `rows` (R,)."""
        self.joints[rows], self.inlier[rows] = joints, evidence.inlier
        self.contradicts[rows] |= wrong
        for kept, new in ((self.of_views, evidence.message), (self.of_body, of_body)):
            kept.xyz[rows], kept.information[rows] = new.xyz, new.information
        self.fit = self.fit.with_rows(rows, fit)


def window_rows(observations: Observations) -> list[Index]:
    """Rows of each window, i.e. track, with ascending frames. Raises ValueError if a track has two
    rows in a frame.
    """
    order = np.lexsort((observations.frame, observations.track))
    track, frame = observations.track[order], observations.frame[order]
    if np.any((np.diff(track) == 0) & (np.diff(frame) == 0)):
        raise ValueError(
            "a track may have only one row per frame: give each person another track number"
        )
    return np.split(order, np.flatnonzero(np.diff(track)) + 1) if len(order) else []
