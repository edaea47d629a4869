"""What covariances of joints are made of: all that tells how well each is known, weighed by measured numbers."""

from dataclasses import dataclass
from importlib.resources import as_file, files

import numpy as np

from shapepose_fg.core.arrays import Array, Whole
from shapepose_fg.core.storage.files import read_json

LASTS_S = 0.25
"""Doubts are the same before and after, over this time, seconds, one sigma; 0.5 and 1 s scored less."""
SURE_M = 0.02
"""Joints that views see are known to this, metres."""
CARRIED_MOST = 3.0
"""A joint that no view sees is as doubtful at any sigma over this many times as much: it has room enough then."""

PERSON_MOST = 4.0
"""A person known on average to this many times `SURE_M` is as doubtful at any more."""

WEIGHTS = ("power", "unseen", "association", "draft", "exchange", "person")
"""What the file names beside the scales of joints, as `Calibration` has them."""


@dataclass(frozen=True)
class Clues:
    """How well the joints of N rows, solved over time, are known: what the graph says, and what speaks against it.

    The last four are means over the frames around (`in_time.smoothed_in_time`).
    """

    frame: Whole
    """(N,) frame of each row."""
    joints: Array
    """(N, J, 3) the joints, metres; NaN where unknown."""
    views: Whole
    """(N, J) how many views see each."""
    covariance: Array
    """(N, J, 3, 3) covariance from the graph, with errors that last, m²."""
    disagreement: Array
    """(N, J) squared Mahalanobis distance of the joint from where the body has it."""
    association: Array
    """(N, J, 3, 3) between places with and without its doubtful observations (`doubt.association_spread`), m²."""
    draft: Array
    """(N, J, 3, 3) outer product of the way from the draft, around which detections were given out, to the joint,
    m²."""
    exchange: Array
    """(N, J, 3, 3) between it and others' joints that may be its own (`doubt.exchange_spread`), m²."""

    @property
    def carried(self) -> Array:
        """(N, J) sigma over `SURE_M` of joints that no view sees, from 1 to `CARRIED_MOST`; 1 of others."""
        sigma_m = np.sqrt(np.trace(self.covariance, axis1=-2, axis2=-1) / 3)
        return np.where(self.views == 0, np.clip(sigma_m / SURE_M, 1.0, CARRIED_MOST), 1.0)

    @property
    def person(self) -> Array:
        """(N, 1) squared logarithm of a person's mean sigma over `SURE_M`, from 1 to `PERSON_MOST`."""
        known = np.isfinite(self.covariance).all(axis=(-2, -1))
        variance = np.where(known, np.trace(self.covariance, axis1=-2, axis2=-1) / 3, 0.0)
        sigma_m = np.sqrt(variance).sum(axis=1, keepdims=True) / np.maximum(known.sum(axis=1, keepdims=True), 1)
        return np.square(np.log(np.clip(sigma_m / SURE_M, 1.0, PERSON_MOST)))


@dataclass(frozen=True)
class Calibration:
    """What each clue weighs."""

    scale: Array
    """(J,) what the variances of each joint are multiplied with where nothing speaks against them: by the whole
    recording's errors a shoulder or a hip is known less well than the graph takes it, a nose or a knee better."""
    power: float
    """Exponent of one plus the disagreement, by which variances are multiplied, too."""
    unseen: float
    """Exponent of the sigma over `SURE_M`, where over 1, of a joint that no view sees: body and
    motion, which carry it then, err rarely and by much."""
    association: float
    """How many times the clue of this name is added: single doubts of several views, of neighbouring joints and of
    frames are one."""
    draft: float
    """How many times the clue of this name is added."""
    exchange: float
    """How many times the clue of this name is added: how probable it is that two limbs that both bodies can have
    are exchanged."""
    person: float
    """Covariances are multiplied by the exponential of this times how badly the person is known as a whole
    (`Clues.person`): where that is badly, detections are somebody else's more often, and nothing tells which."""

    @classmethod
    def load(cls, joints: tuple[str, ...]) -> "Calibration":
        """For a detector's joints, as `scripts/fit_covariances.py` wrote it; joints it lacks are as the mean."""
        with as_file(files("shapepose_fg.estimation") / "data" / "calibration.json") as path:
            data = read_json(path)
        known = data["scale"]
        mean = float(np.exp(np.mean(np.log(list(known.values())))))
        scale = np.array([known.get(name, mean) for name in joints])
        return cls(scale, *(float(data[name]) for name in WEIGHTS))

    def covariance(self, clues: Clues) -> Array:
        """(N, J, 3, 3) covariances to report, m²."""
        times = self.scale * (1 + clues.disagreement) ** self.power * clues.carried**self.unseen
        added = self.association * clues.association + self.draft * clues.draft + self.exchange * clues.exchange
        whole = times[..., None, None] * clues.covariance + added
        return np.exp(self.person * clues.person)[..., None, None] * whole
