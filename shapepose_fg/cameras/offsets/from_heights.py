"""Time offsets of cameras with unknown poses: joints rise and fall at the same times in all of
them.

Each track of one camera may be the person of any track of the other: the vertical speeds of their
joints, relative to the people's size, are correlated at all offsets, and correlations unlikely by
chance are summed. As walking and dancing are periodic, the best offsets are tested for a common
pose of the cameras.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations, product

import numpy as np
from scipy.fft import next_fast_len

from shapepose_fg.cameras.relative_pose import relative
from shapepose_fg.cameras.tracks import FASTEST, CameraTracks, fast_part
from shapepose_fg.core.arrays import Array

_STEP_S = 0.04
"""Interval between compared frames, s."""
_BRISK_S = 0.5
"""Time scale of the high-pass filter, s: a person who walks towards one camera sinks in its picture
and rises in another's."""
_LEAST_S = 1.0
"""Minimum common duration of two tracks, s."""
_AROUND_S = 0.3
"""Distance below which two offsets are the same, s."""
_LEAST_ALIKE = 0.1
"""Minimum correlation that is used; that of different people is lower."""
_PEAKS, _PAIRS = 8, 3
"""Number of offsets per pair of cameras, or of groups of cameras, that are tested, and number of
pairs that test them."""
_SURE = 2.0
"""Minimum of an offset's prominence times the score of the fitting pose (`Relative.score`): wrong
ones are below 1.6, four in five correct ones above, on Shelf and in simulations."""
_FITS_S = 5.0
"""Person-seconds below which a fit has a lower weight."""


def offsets_without_poses(
    tracks: list[CameraTracks],
    fps: float,
    most_s: float,
    advance: Callable[[], None] = lambda: None,
) -> Array:
    """(V,) shifts in frames: frame f of the first camera is frame f + shift of another, to a few
    frames.

    `tracks` are in their cameras' own frames, y down. Cameras were started up to `most_s` apart.
    Groups of cameras are joined in order of the prominence of their offset.
    """
    step = max(1, round(_STEP_S * fps))
    parts = [_rises(each, step, fps) for each in tracks]
    last = max(int(each.frame.max(initial=0)) for each in tracks) // step
    most = min(round(most_s * fps / step), last)
    curves = dict[tuple[int, int], Array]()
    for a, b in product(range(len(tracks)), repeat=2):
        if a < b:
            curves[a, b] = np.zeros(2 * most + 1)
            _add_likeness(curves[a, b], parts[a], parts[b], round(_LEAST_S * fps / step))
            curves[b, a] = curves[a, b][::-1]
    fits = dict[tuple[int, int, int], float]()

    def fit(a: int, b: int, lag: int) -> float:
        """Score of the relative pose of two cameras, one of them `lag` steps later."""
        if (a, b, lag) not in fits:
            moved = replace(tracks[b], frame=tracks[b].frame - lag * step)
            found = relative(tracks[a], moved, fps)
            fits[a, b, lag] = (
                0.0 if found is None else found.score * min(1.0, found.seconds / _FITS_S)
            )
        return fits[a, b, lag]

    groups = [{view: 0} for view in range(len(tracks))]
    while len(groups) > 1:
        offers = [
            (prominence, one, other, lag)
            for one, other in combinations(range(len(groups)), 2)
            for prominence, lag in _peaks(
                groups[one], groups[other], curves, most, round(_AROUND_S * fps / step)
            )
        ]
        best = (-1.0, 0, 1, 0)
        for prominence, one, other, lag in sorted(offers, reverse=True):
            pairs = [
                (a, b, lag + groups[other][b] - groups[one][a])
                for a in groups[one]
                for b in groups[other]
            ]
            pairs.sort(key=lambda pair: -curves[pair[:2]][np.clip(pair[2] + most, 0, 2 * most)])
            merit = prominence * float(np.mean([fit(*pair) for pair in pairs[:_PAIRS]]))
            best = max(best, (merit, one, other, lag))
            if merit > _SURE:
                break
        _, one, other, lag = best
        groups[one] |= {view: at + lag for view, at in groups[other].items()}
        del groups[other]
        advance()
    shift = np.array([groups[0][view] for view in range(len(tracks))])
    return (shift - shift[0]) * float(step)


def _peaks(
    one: dict[int, int],
    other: dict[int, int],
    curves: dict[tuple[int, int], Array],
    most: int,
    around: int,
) -> list[tuple[float, int]]:
    """Offsets between two groups of cameras with their prominence, the best first."""
    total = np.zeros(2 * most + 1)
    for a, b in product(one, other):
        moved = np.arange(-most, most + 1) + other[b] - one[a]
        inside = np.abs(moved) <= most
        total[inside] += curves[a, b][moved[inside] + most]
    usual, found = (
        float(np.sqrt((total[total > 0] ** 2).mean())) if total.any() else 1.0,
        list[tuple[float, int]](),
    )
    for _ in range(_PEAKS):
        top = int(np.argmax(total))
        found.append((float(total[top]) / usual, top - most))
        total[max(0, top - around) : top + around + 1] = 0.0
    return found


def _rises(tracks: CameraTracks, step: int, fps: float) -> list[tuple[int, Array]]:
    """For each track, the index of its first sample, and vertical speeds (N, J) of its joints, as
    shares of the person's size per frame, one sample every `step` frames; 0 if unknown.
    """
    values = tracks.speed[:, :, 1] / tracks.size[:, None]
    known = np.abs(values) < FASTEST / fps  # false for NaN
    values = fast_part(values, known, tracks.track, _BRISK_S * fps)
    kept = np.flatnonzero(tracks.frame % step == 0)
    _, first = np.unique(tracks.track[kept], return_index=True)
    begins = (tracks.frame[kept] // step)[first]
    return list(zip(begins.tolist(), np.split(values[kept], first)[1:], strict=True))


def _add_likeness(
    significance: Array, a: list[tuple[int, Array]], b: list[tuple[int, Array]], least: int
) -> None:
    """Add to `significance` (2 L + 1,), at offsets -L to L of b against a, the significance of the
    similarity of tracks.

    Tracks are compared if they have at least `least` common samples.
    """
    for begin_one, one in a:
        for begin_other, other in b:
            lag = np.arange(1 - len(one), len(other))
            size = next_fast_len(len(lag), real=True)
            waves = np.fft.rfft(other, size, axis=0) * np.fft.rfft(one[::-1], size, axis=0)
            dots = np.fft.irfft(waves.sum(axis=1), size)[: len(lag)]
            start, stop = np.maximum(0, -lag), np.minimum(len(one), len(other) - lag)
            power, power_other = (
                np.append(0.0, np.cumsum((each**2).sum(axis=1))) for each in (one, other)
            )
            energy = (power[stop] - power[start]) * (
                power_other[stop + lag] - power_other[start + lag]
            )
            square = dots**2 / np.maximum(energy, 1e-12)
            place = begin_other - begin_one + lag + len(significance) // 2
            significant = (stop - start >= least) & (dots > 0) & (square > _LEAST_ALIKE**2)
            significant &= (place >= 0) & (place < len(significance))
            significance[place[significant]] -= (stop - start)[significant] * np.log(
                np.maximum(1 - square[significant], 1e-6)
            )
