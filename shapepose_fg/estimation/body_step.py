"""The Theta step: what the body is fitted to, and what it then says of each joint."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.linearisation import ViewEvidence, squared_distance
from shapepose_fg.estimation.window_graph import WindowGraph

MODEL_SIGMA_M = 0.02
"""How far a detector's joints lie from the body's, metres."""
JOINT_SIGMA_M = 0.03
"""Sigma of every joint where the body is fitted to X, all joints alike, metres."""
_SAME, _AS_MUCH = 2.5, 1.25
"""The body of a frame by itself is as before where all targets moved by less than so many times what joints move
that have settled, and weigh up to a quarter more or less: 5 mm, a quarter of `MODEL_SIGMA_M`."""


@dataclass(frozen=True)
class BodyStep:
    """The Theta step of one round, for its R rows."""

    fitter: BodyFitter
    """Fits bodies."""
    people: Sequence[WindowGraph]
    """Whose the rows are, one person's after the other's."""
    config: EstimatorConfig
    """How."""

    def targets(self, evidence: ViewEvidence, enough: Mask) -> JointTargets:
        """What the bodies of the rows whom their views determine, `enough` (R,), are fitted to."""
        if self.config.refine.body_from_views:
            return joint_targets(evidence, enough)
        known = np.isfinite(evidence.points).all(axis=-1) & enough[:, None]
        information = known[..., None, None] * np.eye(3) / JOINT_SIGMA_M**2
        return JointTargets(np.nan_to_num(evidence.points), information)

    def fit_changed(self, targets: JointTargets, last: BodyFit, told: JointTargets) -> tuple[BodyFit, Index]:
        """Bodies (R), and which rows were fitted anew, from the `last` ones, fitted to what they were `told`."""
        near_m = _SAME * self.config.refine.settled_m
        over_time = np.concatenate([np.full(len(person), person.temporal) for person in self.people])
        rows = np.arange(len(targets))
        if near_m > 0:
            rows = np.union1d(
                changed_targets(told, targets, near_m, _AS_MUCH), np.flatnonzero(over_time | ~last.ok)
            )
        return last.with_rows(rows, self.fit(targets, last, rows)) if len(rows) > 0 else last, rows

    def fit(self, targets: JointTargets, last: BodyFit, rows: Index | None = None) -> BodyFit:
        """Bodies of some `rows` (K,) or of all, from the `last` ones (R) on.

        A group's shape is then that of those of its rows that are in `rows`: a row fitted again has another shape
        than the rest of its group. Over time results are measured so; a frame alone is a group of its own.
        """
        lengths = [len(person) for person in self.people]
        groups = np.repeat(np.arange(len(lengths)), lengths) if max(lengths, default=1) > 1 else None
        if rows is not None:
            targets = targets.rows(rows)
            last, groups = last.rows(rows), None if groups is None else groups[rows]
        if self.config.refine.body_from_views:
            return self.fitter.fit(targets, last, groups)
        fit = self.fitter.fit_whole(targets, last) if groups is None else self.fitter.fit(targets, last, groups)
        return replace(fit, prior_xyz=fit.joints, prior_covariance=fit.covariance + MODEL_SIGMA_M**2 * np.eye(3))

    def message(self, body: BodyFit, targets: JointTargets, pulled: Mask) -> JointTargets:
        """What the bodies say of the joints `pulled` (R, J): E_shape of Eq. 3."""
        xyz, covariance = body.prior_xyz.copy(), body.prior_covariance.copy()
        ok = np.repeat(body.ok[:, None], xyz.shape[1], axis=1)
        tied = {each for person in self.people for each in person.coupled}
        for joints in sorted(tied, key=sorted) if self.config.refine.body_from_views else ():
            # Tied to each other, each would get the others' views twice: through the tie, and through the body.
            ties = [np.full(len(person), joints in person.coupled) for person in self.people]
            rows = np.flatnonzero(np.concatenate(ties))
            columns = np.array(sorted(joints))
            information = targets.information.copy()
            information[:, columns] = 0.0
            alone = self.fit(JointTargets(targets.xyz, information), body, rows)
            here = np.ix_(rows, columns)
            xyz[here], covariance[here] = alone.prior_xyz[:, columns], alone.prior_covariance[:, columns]
            ok[here] = alone.ok[:, None]
        pulled = pulled & ok
        information = np.zeros_like(covariance)
        sigma_m = self.config.graph.shape_sigma_m
        information[pulled] = np.eye(3) / sigma_m**2 if sigma_m > 0 else np.linalg.inv(covariance[pulled])
        return JointTargets(np.where(pulled[..., None], xyz, np.nan), information)


def joint_targets(evidence: ViewEvidence, enough: Mask) -> JointTargets:
    """What the body is fitted to: what the views say of all joints, of rows whom they determine (`enough`)."""
    information = np.where(enough[:, None, None, None], evidence.information, 0.0)
    return JointTargets(np.nan_to_num(evidence.target), information)


def changed_targets(before: JointTargets, now: JointTargets, moved_m: float, times: float) -> Index:
    """Rows with a joint whose target moved by more than `moved_m`, or weighs so many `times` more or less."""
    weights = [np.trace(each.information, axis1=2, axis2=3) for each in (before, now)]
    less, more = np.minimum(*weights), np.maximum(*weights)
    moved = (more > 0) & (np.linalg.norm(now.xyz - before.xyz, axis=-1) > moved_m)
    return np.flatnonzero((moved | (more > times * less)).any(axis=1))


def disagreement(evidence: ViewEvidence, fit: BodyFit) -> Array:
    """How far (N, J) each joint's views put it from where the body can have it, in standard deviations.

    The smaller of two distances, each against the sum of both covariances: to where the rest of the body puts the
    joint (`prior_xyz`), a Gaussian around one pose, far from which a forearm is that is only bent further; and to
    the joint of the body that was fitted with it, whose robust kernel stays away from what no pose reaches. Where
    the views leave a direction open, they cannot disagree in it. 0 for rows without a body.
    """
    fitted = np.nan_to_num(fit.covariance) + MODEL_SIGMA_M**2 * np.eye(3)
    squared = [
        squared_distance(evidence.message, *body)
        for body in ((fit.prior_xyz, fit.prior_covariance), (fit.joints, fitted))
    ]
    return np.where(fit.ok[:, None], np.sqrt(np.maximum(np.fmin(*squared), 0.0)), 0.0)
