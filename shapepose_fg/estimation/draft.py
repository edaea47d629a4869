"""Initial estimates of joints without a graph, for reassociating the detections."""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.body.fitting.fitter import (
    BodyConfig,
    BodyFit,
    BodyFitter,
    FitStatus,
    JointTargets,
)
from shapepose_fg.core.arrays import Array, Index, Mask, pair_keys
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.rows import Rows
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.gated_views import (
    ViewEvidence,
    inverses,
    linearise,
    observation_sigmas,
    triangulate,
)

MODEL_SIGMA_M = BodyConfig.model_sigma_m
"""Standard deviation of a detector's joints from the body's, metres. The body of an initial
estimate is fitted again if a target moves by more: on Shelf a quarter of all fits remain."""
DISAGREE = 6.0
"""Disagreement of a joint's views with the body, in standard deviations, at which they are wrong.
With 4 more correct than wrong joints were rejected in simulated crowds."""
NARROWING_M = (0.2, 0.1, 0.05, 0.05)
"""Widths of the kernel for the body fits of an initial estimate, decreasing as in SMPLify:
reprojection distance, as a length at the joint's depth, at which a detection's weight is a quarter.
On `tune`, frame by frame, MPJPE is 35 mm, and 44 if the body is fitted once, to detections within
`rho_2d_m` of the triangulated joints. With priors that are stiff while the kernel is wide F1 rose
by 1.5 points there, but raised arms sank on real footage."""


@dataclass(frozen=True)
class Draft(Rows):
    """Initial estimates of the joints of N rows."""

    observations: Observations
    """Observations of the estimate."""
    triangulated: Array
    """(N, J, 3) positions of the joints that stage I or several views give, metres; else NaN."""
    body: BodyFit
    """Bodies of the rows."""
    fitted: JointTargets
    """Targets to which the bodies were fitted."""
    places: Array
    """(N, J, 3) positions, metres; NaN if neither views nor body determine them."""
    covariance: Array
    """(N, J, 3, 3) covariances, m²; NaN like the positions."""

    @property
    def start(self) -> Array:
        """(N, J, 3) X_0, metres: joints that views give, others where the body is, so that a single
        view of a joint counts from the first round on.
        """
        return np.where(np.isnan(self.triangulated), self.places, self.triangulated)

    def updated(self, new: "Draft") -> "Draft":
        """The estimates with those of the frames of `new` in their place."""
        others = ~np.isin(self.observations.frame, new.observations.frame)
        return Draft.concatenate([self.rows(others), new])


def draft(
    observations: Observations,
    views: Views,
    fitter: BodyFitter,
    config: EstimatorConfig,
    last: Draft | None = None,
) -> Draft:
    """Initial estimates of the joints of N rows.

    From the views, and from the body where these are weak or contradict it. Measurements are
    linearised at triangulated joints, then at the body's, with a decreasing kernel (`NARROWING_M`).
    Rows with the same detections as in the `last` estimate start from its body, with the narrowest
    kernel; others from a body fitted to the triangulated joints: without it a crowd with three
    cameras lost two points of F1. As a joint's views also determine the body, the covariances are
    too small.
    """
    X = triangulate(observations, views, config.observations)
    sigmas = observation_sigmas(observations, X, views, config.observations, config.joints)
    evidence = linearise(observations, sigmas, X, views, config.observations)
    enough = (evidence.sigma_m <= config.refine.max_sigma_m).sum(axis=1) >= LEAST_JOINTS
    N, J = X.shape[:2]
    fitted = JointTargets(np.zeros((N, J, 3)), np.zeros((N, J, 3, 3)))
    body, near = BodyFit.failed(np.full(N, FitStatus.TOO_FEW_JOINTS), J), np.zeros(N, dtype=bool)
    if last is not None:
        unchanged, previous = _unchanged(observations, last.observations)
        fitted.put(unchanged, last.fitted.rows(previous))
        body.put(unchanged, last.body.rows(previous))
        near[unchanged] = body.ok[unchanged]
    chosen = new = np.flatnonzero(~near)
    evidence = evidence.rows(new)
    for reach_m in (None, *NARROWING_M):  # None: at triangulated joints, as above
        if reach_m is not None:
            chosen = np.arange(N) if reach_m == NARROWING_M[-1] else new
            given, seen_by, around = (
                observations.rows(chosen),
                views.rows(chosen),
                body.rows(chosen),
            )
            around = np.where(around.ok[:, None, None], around.joints, X[chosen])
            evidence = linearise(
                given, sigmas[chosen], around, seen_by, config.observations, reach_m
            )
        targets = joint_targets(evidence, enough[chosen])
        moved = changed_targets(fitted.rows(chosen), targets, MODEL_SIGMA_M, 2.0)
        if len(moved) == 0:
            continue
        fit = fitter.fit(targets.rows(moved))
        fitted.put(chosen[moved], targets.rows(moved))
        placed = np.flatnonzero(fit.ok)
        body.put(chosen[moved[placed]], fit.rows(placed))
    places, covariance = drafted(evidence, body)
    return Draft(observations, X, body, fitted, places, covariance)


def _unchanged(now: Observations, before: Observations) -> tuple[Index, Index]:
    """(K,) rows with the same detections as in the row of their track and frame `before`, and (K,)
    these rows.
    """
    keys = pair_keys(*((each.frame, each.track) for each in (now, before)))
    _, index, previous = np.intersect1d(*keys, assume_unique=True, return_indices=True)
    same = (now.xy[index] == before.xy[previous]).all(axis=(1, 2, 3))
    return index[same], previous[same]


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


def drafted(evidence: ViewEvidence, body: BodyFit) -> tuple[Array, Array]:
    """Positions (N, J, 3), metres, and covariances (N, J, 3, 3) of joints; NaN if neither views nor
    body determine them.

    Information-weighted means of views and body. Views more than `DISAGREE` standard deviations
    from the body are ignored, as its robust kernel did.
    """
    known = (body.ok[:, None] & np.isfinite(body.covariance).all(axis=(2, 3)))[..., None]
    covariance = np.where(
        known[..., None], body.covariance + MODEL_SIGMA_M**2 * np.eye(3), np.eye(3)
    )
    of_body = np.where(known[..., None], inverses(covariance), 0.0)
    views, target = evidence.information, np.nan_to_num(evidence.target)
    at = np.where(known, body.joints, target)
    pull = (views @ (target - at)[..., None])[..., 0]
    spread = inverses(views + of_body)
    step = (np.where(known[..., None], spread, 0.0) @ pull[..., None])[..., 0]
    # d^T (C + H^-1)^-1 d, with possibly singular information H.
    agree = ~known | (((target - at - step) * pull).sum(axis=-1, keepdims=True) < DISAGREE**2)
    spread, place = np.where(agree[..., None], spread, covariance), np.where(agree, at + step, at)
    # Determined to a metre: by the body itself, or by the sum of all information.
    determined = known & (np.trace(covariance, axis1=2, axis2=3) < 1.0)[..., None]
    uncertain = ~determined[..., 0]
    total = (of_body + np.where(agree[..., None], views, 0.0))[uncertain]
    determined[uncertain, 0] = np.linalg.eigvalsh(total)[..., 0] > 1.0
    return np.where(determined, place, np.nan), np.where(determined[..., None], spread, np.nan)
