"""Solved rows as rows of a result."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.estimation.window_solution import WindowSolution


def result_rows(
    solution: WindowSolution,
    place: NDArray[np.integer],
    rig: Rig,
    joint_names: Sequence[str],
    person: NDArray[np.integer],
) -> Reconstruction:
    """N solved rows as a result, in their order; bodies that were not fitted are NaN there.

    `place` (N, J, V) is each detection's place among those of its view (`place_in_view`), `person` (N,) who it is.
    """
    fit, observations = solution.fit, solution.observations
    body = {name: getattr(fit, name).copy() for name in ("betas", "global_orient", "body_pose", "transl")}
    for values in body.values():
        values[~fit.ok] = np.nan
    dropped = np.where(solution.contradicts[..., None], Gate.CONTRADICTS_BODY, Gate.TOO_FAR)
    table = ObservationTable.of(
        observations,
        place,
        solution.joints,
        np.where(solution.inlier, Gate.USED, dropped),
        rig,
        frame=observations.frame,
        person=person,
        joint_names=joint_names,
    )
    return Reconstruction(
        frame=observations.frame,
        person=person,
        time_s=observations.time_s.mean(axis=1),
        joint_names=np.array(joint_names),
        joints=solution.joints,
        covariance=solution.covariance,
        velocity=solution.velocity,
        velocity_covariance=solution.velocity_covariance,
        known=solution.known,
        confidence=solution.confidence,
        status=solution.status,
        observations=table,
        **body,
    )
