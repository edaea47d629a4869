"""How long errors, confidences and misses last, and which of a person's joints share them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import ndtri

from shapepose_fg.core.camera import Rig
from shapepose_fg.simulation.measurement.classes import LAGS, LONGEST_S, rounded
from shapepose_fg.simulation.measurement.errors import whitened
from shapepose_fg.simulation.measurement.misses import FREE, tetrachoric
from shapepose_fg.simulation.measurement.sample_tables import MIRROR


def autocorrelation(value: NDArray, expected: dict[str, NDArray], lags: NDArray) -> NDArray[np.float64]:
    """(L,) of values (M,) of one joint of one person in one view, over frames; NaN values are left out.

    NaN for a lag that is longer than the recording.
    """
    known = np.isfinite(value)
    key = (expected["track"] * 64 + expected["view"]) * 25 + expected["joint"]
    rows, row = np.unique(key[known], return_inverse=True)
    table = np.full((len(rows), expected["frame"].max() + 1), np.nan)
    table[row, expected["frame"][known]] = value[known]
    found = []
    for lag in lags:
        product = table[:, lag:] * table[:, : max(table.shape[1] - lag, 0)]
        found.append(_mean(product) / _mean(table**2))
    return np.array(found)


def _mean(values: NDArray) -> float:
    """Of what is known; NaN where nothing is."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) > 0 else float("nan")


def memory_of(values: NDArray, lags: NDArray, fps: float) -> list[list[float]]:
    """[[share, seconds], [share, seconds]]: a fast and a slow process whose sum has this autocorrelation.

    What is missing to 1 is new in every frame.
    """
    lags, values = lags[np.isfinite(values)], values[np.isfinite(values)]
    lag_s = lags / fps

    def misfit(x: NDArray) -> float:
        a, b, fast, slow = x
        penalty = 100 * max(0.0, a + b - 1) + 100 * max(0.0, -a) + 100 * max(0.0, -b)
        return (
            float(np.square(a * np.exp(-lag_s / np.exp(fast)) + b * np.exp(-lag_s / np.exp(slow)) - values).sum())
            + penalty
        )

    found = minimize(
        misfit,
        [0.25, 0.6, np.log(0.12), np.log(2.0)],
        method="Nelder-Mead",
        options={"maxiter": 4000, "fatol": 1e-9},
    )
    a, b, fast, slow = found.x
    return [
        [round(float(np.clip(share, 0.0, 1.0)), 3), round(float(min(np.exp(log_s), LONGEST_S)), 3)]
        for share, log_s in ((a, fast), (b, slow))
    ]


def normal_scores(expected: dict[str, NDArray], state: NDArray) -> NDArray:
    """(M,) confidences of visible joints by their rank within the joint, as a standard normal; misses NaN."""
    scores = np.full(len(state), np.nan)
    for joint in range(25):
        those = np.flatnonzero(expected["hit"] & (state == 0) & (expected["joint"] == joint))
        rank = np.argsort(np.argsort(expected["confidence"][those]))
        scores[those] = ndtri((rank + 0.5) / max(len(those), 1))
    return scores


def hits_about_mean(expected: dict[str, NDArray], state: NDArray) -> NDArray:
    """(M,) 1 or 0 for visible joints that were found or missed, less the mean of the joint."""
    hit = np.where(state == 0, expected["hit"].astype(float), np.nan)
    for joint in range(25):
        those = expected["joint"] == joint
        if np.isfinite(hit[those]).any():
            hit[those] -= np.nanmean(hit[those])
    return hit


def memories(expected: dict[str, NDArray], state: NDArray, errors: dict[str, Any], fps: float) -> dict[str, Any]:
    """How long errors, confidences and misses of visible joints last: two processes each, as `memory_of`."""
    z = whitened(expected, state, errors)
    error = np.mean([autocorrelation(z[:, axis], expected, LAGS) for axis in range(2)], axis=0)
    score = autocorrelation(normal_scores(expected, state), expected, LAGS)
    found = autocorrelation(hits_about_mean(expected, state), expected, LAGS)
    lost = tetrachoric(found, 1 - float(expected["hit"][state == 0].mean()))
    return {
        "error": memory_of(error, LAGS, fps),
        "confidence": memory_of(score, LAGS, fps),
        "lost": memory_of(lost, LAGS, fps),
    }


def joint_correlation(
    expected: dict[str, NDArray], state: NDArray, errors: dict[str, Any], rig: Rig
) -> dict[str, Any]:
    """(25, 25) correlations between a person's joints in one view and frame: of errors, of confidences."""
    key = expected["person"] * len(rig) + expected["view"]
    rows, row = np.unique(key, return_inverse=True)
    z = whitened(expected, state, errors)

    def correlation(value: NDArray) -> NDArray:
        table = np.full((len(rows), 25), np.nan)
        table[row, expected["joint"]] = value
        known = np.isfinite(table)
        table = np.where(known, table, 0.0)
        both = known.T.astype(float) @ known
        product = table.T @ table
        square = (table**2).T @ known
        C = product / np.sqrt(np.maximum(square * square.T, 1e-12))
        C = np.where(both > 100, C, 0.0)
        C = (C + C[np.ix_(MIRROR, MIRROR)]) / 2  # left and right alike
        values, vectors = np.linalg.eigh((C + C.T) / 2)
        C = vectors * np.maximum(values, 0.02) @ vectors.T
        return C / np.sqrt(np.outer(np.diag(C), np.diag(C)))

    of_errors = (correlation(z[:, 0]) + correlation(z[:, 1])) / 2
    free = (state == 0) & (expected["buried"] < FREE)
    found = correlation(np.where(free, hits_about_mean(expected, state), np.nan))
    of_misses = tetrachoric(found, 1 - float(expected["hit"][free].mean()))
    np.fill_diagonal(of_misses, 1.0)
    return {
        "lost": rounded(of_misses, 2),
        "error": rounded(of_errors, 2),
        "confidence": rounded(correlation(normal_scores(expected, state)), 2),
    }
