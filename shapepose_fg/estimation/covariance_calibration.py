"""Calibrated covariances of joints: combines all features of their uncertainty with measured
weights.
"""

from dataclasses import dataclass
from importlib.resources import as_file, files

import numpy as np

from shapepose_fg.core.arrays import Array, Whole
from shapepose_fg.core.storage.files import read_json

SURE_M = 0.02
"""Usual standard deviation of joints that views see, metres."""
CARRIED_MOST = 3.0
"""Upper limit of the feature `carried`, the ratio of sigma and `SURE_M`."""

PERSON_MOST = 4.0
"""Upper limit of the ratio of a person's mean sigma and `SURE_M`."""

WEIGHTS = ("power", "unseen", "association", "draft", "exchange", "person")
"""Entries of the file besides the scales of joints, as in `Calibration`."""


@dataclass(frozen=True)
class CovarianceFeatures:
    """Features of the uncertainty of N rows' joints: the graph's covariance, and contradicting
    evidence.
    """

    frame: Whole
    """(N,) frame of each row."""
    joints: Array
    """(N, J, 3) the joints, metres; NaN where unknown."""
    views: Whole
    """(N, J) number of views that see each joint."""
    covariance: Array
    """(N, J, 3, 3) covariance from the graph, including correlated errors, m²."""
    disagreement: Array
    """(N, J) squared Mahalanobis distance of the joint from the body's prediction."""
    association: Array
    """(N, J, 3, 3) spread due to uncertain associations
    (`association_uncertainty.association_spread`), m²."""
    draft: Array
    """(N, J, 3, 3) outer product of the displacement from the initial estimate used for
    reassociation, m²."""
    exchange: Array
    """(N, J, 3, 3) spread due to possible exchanges with other people's joints
    (`association_uncertainty.exchange_spread`), m²."""

    @property
    def carried(self) -> Array:
        """(N, J) sigma over `SURE_M`, clipped to 1 to `CARRIED_MOST`, for joints that no view sees;
        1 for others.
        """
        sigma_m = np.sqrt(np.trace(self.covariance, axis1=-2, axis2=-1) / 3)
        return np.where(self.views == 0, np.clip(sigma_m / SURE_M, 1.0, CARRIED_MOST), 1.0)

    @property
    def person(self) -> Array:
        """(N, 1) squared logarithm of a person's mean sigma over `SURE_M`, with the ratio clipped
        to 1 to `PERSON_MOST`.
        """
        known = np.isfinite(self.covariance).all(axis=(-2, -1))
        variance = np.where(known, np.trace(self.covariance, axis1=-2, axis2=-1) / 3, 0.0)
        sigma_m = np.sqrt(variance).sum(axis=1, keepdims=True) / np.maximum(
            known.sum(axis=1, keepdims=True), 1
        )
        return np.square(np.log(np.clip(sigma_m / SURE_M, 1.0, PERSON_MOST)))


@dataclass(frozen=True)
class Calibration:
    """Weights of the features."""

    scale: Array
    """(J,) factor on each joint's variances without contradicting evidence: over whole recordings a
    shoulder or a hip is less certain than the graph's covariance, a nose or a knee more."""
    power: float
    """Exponent of one plus the disagreement, as a further factor on variances."""
    unseen: float
    """Exponent of `carried`, for joints that no view sees: errors of body and motion, which then
    determine them, are rare and large."""
    association: float
    """Factor on the feature of this name: uncertainties of several views, of neighbouring joints
    and of frames are correlated."""
    draft: float
    """Factor on the feature of this name."""
    exchange: float
    """Factor on the feature of this name: probability that two limbs that fit both bodies are
    exchanged."""
    person: float
    """Covariances are multiplied by the exponential of this times `CovarianceFeatures.person`. If
    the overall uncertainty of a person is large, its detections more often belong to another
    person, and no other feature shows this."""

    @classmethod
    def load(cls, joints: tuple[str, ...]) -> "Calibration":
        """Read the weights for a detector's joints, fitted by `scripts/fit_covariances.py`; others
        get the mean scale.
        """
        with as_file(files("shapepose_fg.estimation") / "data" / "calibration.json") as path:
            data = read_json(path)
        known = data["scale"]
        mean = float(np.exp(np.mean(np.log(list(known.values())))))
        scale = np.array([known.get(name, mean) for name in joints])
        return cls(scale, *(float(data[name]) for name in WEIGHTS))

    def covariance(self, clues: CovarianceFeatures) -> Array:
        """(N, J, 3, 3) covariances to report, m²."""
        times = self.scale * (1 + clues.disagreement) ** self.power * clues.carried**self.unseen
        added = (
            self.association * clues.association
            + self.draft * clues.draft
            + self.exchange * clues.exchange
        )
        whole = times[..., None, None] * clues.covariance + added
        return np.exp(self.person * clues.person)[..., None, None] * whole
