"""Estimates the time offset of each camera against the others, and whether it is significant."""

from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.cameras.check.evidence import SetupHypothesis
from shapepose_fg.cameras.check.findings import SURE
from shapepose_fg.cameras.offsets.scan import LEAST_MISS, scan
from shapepose_fg.cameras.resection import independent, likelihood
from shapepose_fg.cameras.sightings import GATE

_CLEAR = 0.25
"""Minimum gain of a time offset. Correct cameras have up to 0.2, late ones 0.3 to 1."""


@dataclass(frozen=True)
class Lag:
    """Time offset of a camera."""

    frames: int = 0
    """The camera shows at t + frames what the others show at frame t; positive is late."""
    gain: float = 0.0
    """Decrease of the mean residual by the offset, relative to the depth of its minimum under the
    median of all offsets."""
    agreement: float = 0.0
    """Share of the other cameras against which the best offset is the same, within two frames; 0 if
    there is one only, or if the offset is the largest or smallest that was tried. Where people
    stand still, errors of the detector decide which offset is best, differently for each camera."""
    probability: float = 0.0
    """Probability of the offset against chance; computed where the gain is significant."""

    def exceeds(self, share: float) -> bool:
        """Whether the offset exceeds a `share` of what makes it significant."""
        return self.gain > share * _CLEAR

    @property
    def is_offset(self) -> bool:
        """Whether the offset is significant."""
        return self.exceeds(1.0) and (self.agreement >= 0.75 or self.probability > SURE)


def lags(setup: SetupHypothesis) -> list[Lag]:
    """Time offset of each camera against the others; none in a short recording."""
    # Minimum number of frames for time offsets. In fewer, people hardly move enough to separate a
    # small time offset from chance.
    if len(np.unique(setup.evidence.sightings.frame)) < 40:
        return [Lag()] * setup.view_count
    return [lag_of(setup, view) for view in range(setup.view_count)]


def lag_of(setup: SetupHypothesis, view: int, most: int | None = None) -> Lag:
    """Time offset of a camera against the others, up to `most` frames, with the smallest mean
    residual.
    """
    most = setup.evidence.most_lag if most is None else min(most, setup.evidence.most_lag)
    offsets, seen, around = np.arange(-most, most + 1), setup.shifted, setup.evidence.around
    rows = seen.rows((seen.view == view) | np.isin(seen.frame, around))
    # Distance of people above which they count as missed by a camera, as a share of the size; other
    # people come that near seldom.
    of_pairs = [
        scan(rows, setup.views, other, view, offsets, np.ptp(around) / 4, GATE / 3)
        for other in np.unique(rows.view).tolist()
        if other != view
    ]
    known = np.isfinite(np.reshape(of_pairs, (-1, len(offsets))))
    count = known.sum(axis=0)
    if count[most] == 0:
        return Lag()
    curve = np.where(known, of_pairs, 0.0).sum(axis=0) / np.where(count > 0, count, np.nan)
    best = int(np.nanargmin(curve))
    depth, drop = float(np.nanmedian(curve) - curve[best]), float(curve[most] - curve[best])
    lag = Lag(int(offsets[best]), drop / max(depth, LEAST_MISS))
    if not lag.exceeds(1.0) or best in (0, len(offsets) - 1):
        return lag
    of_each = np.where(known, of_pairs, np.inf)[known.any(axis=1)].argmin(axis=1)
    agreement = float((np.abs(of_each - best) <= 2).mean()) if len(of_each) > 1 else 0.0
    log_odds = likelihood(drop / GATE, independent(setup.others(view)), 1)
    return replace(
        lag, agreement=agreement, probability=float(np.exp(-np.logaddexp(0.0, -log_odds)))
    )
