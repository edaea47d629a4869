"""The Theta step: targets of the body fit, and the body's constraints on the joints."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.linearisation import ViewEvidence, squared_distance
from shapepose_fg.estimation.window_graph import WindowGraph

MODEL_SIGMA_M = 0.02
"""Standard deviation of a detector's joints from the body's, metres."""
JOINT_SIGMA_M = 0.03
"""Standard deviation of all joints if the body is fitted to X as in the paper, metres."""
_SAME, _AS_MUCH = 2.5, 1.25
"""Criteria for reusing a single-frame body: maximum motion of targets relative to `settled_m` (5
mm, a quarter of `MODEL_SIGMA_M`), and maximum change of their weights."""


@dataclass(frozen=True)
class BodyStep:
    """Fits bodies to the measurements of the views: the Theta step of the paper's alternation, in
    one round, for R rows (a row is a person in a frame).
    """

    fitter: BodyFitter
    """Fits bodies."""
    people: Sequence[WindowGraph]
    """Graphs of the people, whose rows follow one another."""
    config: EstimatorConfig
    """Settings of stage II."""

    def targets(self, evidence: ViewEvidence, enough: Mask) -> JointTargets:
        """Targets of the bodies (R), for rows that their views determine, `enough` (R,)."""
        if self.config.refine.body_from_views:
            return joint_targets(evidence, enough)
        known = np.isfinite(evidence.points).all(axis=-1) & enough[:, None]
        information = known[..., None, None] * np.eye(3) / JOINT_SIGMA_M**2
        return JointTargets(np.nan_to_num(evidence.points), information)

    def fit_changed(
        self, targets: JointTargets, last: BodyFit, before: JointTargets
    ) -> tuple[BodyFit, Index]:
        """Fit bodies (R) again where targets differ from `before`, those of the `last` fit; also
        returns these rows.
        """
        near_m, rows = _SAME * self.config.refine.settled_m, np.arange(len(targets))
        if near_m > 0:
            changed = changed_targets(before, targets, near_m, _AS_MUCH)
            rows = np.union1d(changed, np.flatnonzero(~last.ok))
        return last.with_rows(rows, self.fit(targets, last, rows)) if len(rows) > 0 else last, rows

    def fit(self, targets: JointTargets, last: BodyFit, rows: Index | None = None) -> BodyFit:
        """Fit the bodies of some `rows` (K,) or all, starting at the `last` ones (R)."""
        if rows is not None:
            targets, last = targets.rows(rows), last.rows(rows)
        if self.config.refine.body_from_views:
            return self.fitter.fit(targets, last)
        fit = self.fitter.fit_whole(targets, last)
        return replace(
            fit,
            prior_xyz=fit.joints,
            prior_covariance=fit.covariance + MODEL_SIGMA_M**2 * np.eye(3),
        )

    def message(self, body: BodyFit, targets: JointTargets, pulled: Mask) -> JointTargets:
        """The bodies' constraints on the joints `pulled` (R, J): E_shape of Eq. 3."""
        xyz, covariance = body.prior_xyz.copy(), body.prior_covariance.copy()
        ok = np.repeat(body.ok[:, None], xyz.shape[1], axis=1)
        tied = {each for person in self.people for each in person.coupled}
        for joints in sorted(tied, key=sorted) if self.config.refine.body_from_views else ():
            # Coupled joints would get each other's views twice: by the coupling, and by the body.
            rows = np.flatnonzero([joints in person.coupled for person in self.people])
            columns = np.array(sorted(joints))
            information = targets.information.copy()
            information[:, columns] = 0.0
            alone = self.fit(JointTargets(targets.xyz, information), body, rows)
            here = np.ix_(rows, columns)
            xyz[here], covariance[here] = (
                alone.prior_xyz[:, columns],
                alone.prior_covariance[:, columns],
            )
            ok[here] = alone.ok[:, None]
        pulled = pulled & ok
        information = np.zeros_like(covariance)
        sigma_m = self.config.graph.shape_sigma_m
        information[pulled] = (
            np.eye(3) / sigma_m**2 if sigma_m > 0 else np.linalg.inv(covariance[pulled])
        )
        return JointTargets(np.where(pulled[..., None], xyz, np.nan), information)


def joint_targets(evidence: ViewEvidence, enough: Mask) -> JointTargets:
    """Targets of the body: estimates of all joints from the views, for rows that these determine
    (`enough`).
    """
    information = np.where(enough[:, None, None, None], evidence.information, 0.0)
    return JointTargets(np.nan_to_num(evidence.target), information)


def changed_targets(before: JointTargets, now: JointTargets, moved_m: float, times: float) -> Index:
    """Rows with a target that moved by more than `moved_m`, or changed its weight by more than the
    factor `times`.
    """
    weights = [np.trace(each.information, axis1=2, axis2=3) for each in (before, now)]
    less, more = np.minimum(*weights), np.maximum(*weights)
    moved = (more > 0) & (np.linalg.norm(now.xyz - before.xyz, axis=-1) > moved_m)
    return np.flatnonzero((moved | (more > times * less)).any(axis=1))


def disagreement(evidence: ViewEvidence, fit: BodyFit) -> Array:
    """Disagreement (N, J) of each joint's views with the body, in standard deviations.

    The smaller of two Mahalanobis distances, with the sum of both covariances: to the prediction by
    the rest of the body (`prior_xyz`), a Gaussian around one pose that is too narrow for, say, a
    forearm bent further; and to the joint of the body fitted with it, which its robust kernel keeps
    away from unreachable positions. The views cannot disagree in directions they leave unobserved.
    0 for rows without a body.
    """
    fitted = np.nan_to_num(fit.covariance) + MODEL_SIGMA_M**2 * np.eye(3)
    squared = [
        squared_distance(evidence.message, *body)
        for body in ((fit.prior_xyz, fit.prior_covariance), (fit.joints, fitted))
    ]
    return np.where(fit.ok[:, None], np.sqrt(np.maximum(np.fmin(*squared), 0.0)), 0.0)
