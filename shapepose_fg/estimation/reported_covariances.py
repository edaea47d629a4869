"""Reported covariances of joints: the factor by which they are larger than the marginals of the
graph, because errors of detectors are correlated over time, and some detections are another
person's.

`solve_bodies` in `body_solution.py` makes the covariance of a joint, and lists its terms:

1. the marginal of the person's graph: `BodyWindow.covariances` and `Marginals` in
   `body_window.py`; with user factors `graph_covariances` in `person_graph.py`;
2. times the person's factor: `covariance_factors` in this file;
3. plus errors of the poses of moving cameras: `camera_pose_uncertainty.py`;
4. plus the error if left and right are exchanged: `mirrored_sides.py`.

One factor applies to all covariances of a graph, so its solution and its gates do not change.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.shipped_numbers import shipped_numbers
from shapepose_fg.estimation.body_window import Marginals

REJECTED = 0.1
"""Unit of the share of rejected evidence: the base of `AssociationUncertainty.rejected` is 2 at
this share."""
_LASTS_S, _LASTS, _PRIOR_COUNT = 1.0, 0.4, 20.0
"""Time lag, s, at which residuals are compared for correlated errors; the prior share of correlated
errors, and the prior's weight, as a number of squared standard deviations."""
_SINGLE_FRAMES = 8
"""Number of frames, spread evenly over the window, in which single-frame variances are computed."""
_ANYWHERE = 1e-3
"""Prior information on the place and direction of a body in a single frame, 1/m² and 1/rad²."""


@dataclass(frozen=True)
class CorrelatedErrors:
    """Weights of independent and of correlated detection errors in the covariances of a window."""

    independent: float
    """Factor on variances if the errors of all frames are independent."""
    correlated: float
    """Factor on variances if errors stay the same over the window. It is larger, because residuals
    show less of such errors."""

    @classmethod
    @cache
    def measured(cls) -> "CorrelatedErrors":
        """The numbers that ship, measured by `scripts/fit_covariances.py`."""
        return cls(**shipped_numbers("estimation", "covariances")["correlated_errors"])

    def factor(self, share: Array | float, ratio: Array | float) -> Array | float:
        """Factor on the variances of a window, for the `share` of correlated errors and the `ratio`
        of single-frame variances to those of the window (`correlation_features`).
        """
        return self.independent * (1 - share) + self.correlated * share * ratio


@dataclass(frozen=True)
class AssociationUncertainty:
    """Factors on variances because some detections of a person are another person's."""

    scale: float
    """Factor on all variances in single frames."""
    sigma: float
    """Exponent of the mean standard deviation of a person's joints in a single frame, in
    centimetres."""
    rejected: float
    """Exponent of one plus the share of evidence that gates reject, over `REJECTED`."""

    @classmethod
    @cache
    def measured(cls) -> "AssociationUncertainty":
        """The numbers that ship, measured by `scripts/fit_covariances.py`."""
        return cls(**shipped_numbers("estimation", "covariances")["association_uncertainty"])

    def in_frames(self, sigma_m: Array, rejected: Array) -> Array:
        """(T,) factors on variances in single frames, for the mean standard deviation of each row,
        metres, and the share of rejected evidence. Without time, associations are less certain.
        """
        return self.scale * (sigma_m / 1e-2) ** self.sigma * self.of_rejected(rejected)

    def of_rejected(self, rejected: Array) -> Array:
        """Factors on variances for shares of rejected evidence."""
        return (1 + rejected / REJECTED) ** self.rejected


def covariance_factors(marginals: Marginals, noise: float) -> Array:
    """Factors on variances: (1,) of a person's window, or (T,) of people in single frames.

    `noise` is the ratio of the standard deviation of the recording's detections to the usual one.
    The detections are weighted by it already; this factor is for large errors, which are also more
    frequent with such detectors.
    """
    association = AssociationUncertainty.measured()
    sigma_m, evidence, used = association_features(marginals)
    if not marginals.window.over_time:
        return association.in_frames(sigma_m, 1 - used / np.maximum(evidence, 1e-9))
    rejected = 1 - used.sum(keepdims=True) / max(evidence.sum(), 1e-9)
    correlated = CorrelatedErrors.measured().factor(*correlation_features(marginals))
    return np.sqrt(noise) * correlated * association.of_rejected(rejected)


def association_features(marginals: Marginals) -> tuple[Array, Array, Array]:
    """(T,) mean standard deviation of each row's joints, metres; (T,) its evidence, the weights
    w_ij of Eq. 1, and (T,) the part of it that gates do not reject.
    """
    window = marginals.window
    sigma_m = np.sqrt(np.trace(marginals.joints(), axis1=-2, axis2=-1) / 3).mean(axis=1)
    weight = window.config.weight(window.observations.confidence) * window.observations.seen
    used = weight * window.last.evidence.inlier
    return sigma_m, weight.sum(axis=(1, 2)), used.sum(axis=(1, 2))


def correlation_features(marginals: Marginals) -> tuple[float, float]:
    """The share of correlated errors in a window, and the ratio of the variances that the same
    views give in a single frame to those of the window.

    Errors that are new in every frame are averaged over time, correlated ones are not.
    """
    window, last = marginals.window, marginals.window.last
    some = slice(None, None, max(len(window) // _SINGLE_FRAMES, 1))
    seen = np.asarray(last.evidence.inlier.any(axis=-1))[some]
    if not seen.any():
        return 1.0, 1.0
    slope, gain = marginals.slopes[some, ..., 10:], last.gain[some]
    variance = window.variance[some, ..., None, None]
    (T, J), N = seen.shape, slope.shape[-1]
    flat = slope.reshape(T, 3 * J, N)
    views = flat.mT @ (gain / variance @ slope).reshape(flat.shape)
    prior = _ANYWHERE * np.eye(N)
    prior[3:-3, 3:-3] += window.energy.priors.precision
    shown = np.linalg.inv(views + prior)
    of_body = (flat @ (shown @ views @ shown)).reshape(slope.shape) @ slope.mT
    kept = np.eye(3) - gain
    one_frame = np.trace(kept @ of_body @ kept.mT + variance * kept, axis1=-2, axis2=-1)
    over_time = np.trace(marginals.joints()[some], axis1=-2, axis2=-1)
    return _correlated_share(marginals), float(np.exp(np.log(one_frame / over_time)[seen].mean()))


def _correlated_share(marginals: Marginals) -> float:
    """Share of correlated errors in the variance of detections: the correlation of residuals that
    are `_LASTS_S` apart.
    """
    window, evidence = marginals.window, marginals.window.last.evidence
    sigma = np.where(evidence.inlier, window.sigmas_px, np.inf)[..., None]
    ratio = np.nan_to_num(evidence.residual_px) / sigma
    later = np.searchsorted(window.times_s, window.times_s + _LASTS_S - 1e-3)
    now = np.flatnonzero(later < len(window))
    first, second = ratio[now], ratio[later[now]]
    both = (first != 0) & (second != 0)
    product = (first * second)[both].sum() + _PRIOR_COUNT * _LASTS
    squared = (first**2 + second**2)[both].sum() / 2 + _PRIOR_COUNT
    return float(np.clip(product / squared, 0.0, 1.0))
