"""How far a detector is off, and how sure it is: by confidence, joint, and whether the joint is visible."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.simulation.measurement.classes import GROUP, GROUPS, KNOTS, LEVELS, PRIOR, rounded


def confidence_tables(expected: dict[str, NDArray], state: NDArray) -> dict[str, Any]:
    """Quantiles of the confidence (G, 3, K): a rare case leans on all joints together."""
    quantiles = np.zeros((len(GROUPS), 3, len(LEVELS)))
    for s in range(3):
        of_all = state == s
        pooled = np.quantile(expected["confidence"][of_all & expected["hit"]], LEVELS)
        for g in range(len(GROUPS)):
            hits = of_all & (GROUP[expected["joint"]] == g) & expected["hit"]
            found = hits.sum()
            own = np.quantile(expected["confidence"][hits], LEVELS) if found > 0 else pooled
            quantiles[g, s] = (found * own + PRIOR * pooled) / (found + PRIOR)
    return {"confidence": rounded(quantiles)}


def error_tables(expected: dict[str, NDArray], state: NDArray) -> dict[str, Any]:
    """Sigma and tail by confidence and state, its scale by joint and axis, and what the grid adds in pixels.

    A residual holds the view's own error and the prediction's. The prediction's sigma rests on what the pipeline
    assumes of the other views; `spread_factor` corrects it to what is found here, joint and axis included, in a
    few rounds.
    """
    hit, confidence, joint = expected["hit"], expected["confidence"], GROUP[expected["joint"]]
    scale, factor = np.ones((len(GROUPS), 2)), 1.0
    sigma, tail = np.zeros((3, len(KNOTS))), np.zeros((3, len(KNOTS)))
    visible = hit & (state == 0) & (confidence > 0.4)
    for _ in range(4):
        spread = factor * expected["spread_m"]
        length = np.linalg.norm(expected["residual_m"] / scale[joint], axis=1)
        for s in range(3):
            for k, knot in enumerate(KNOTS):
                near = hit & (state == s) & (np.abs(confidence - knot) < (0.05, 0.08, 0.12)[s])
                sigma[s, k], tail[s, k] = _scale_and_tail(length[near], spread[near])
        expected_m = np.hypot(np.interp(confidence, KNOTS, sigma[0]), spread)
        for g in range(len(GROUPS)):
            z = np.abs(expected["residual_m"] / expected_m[:, None])[visible & (joint == g)]
            scale[g] = np.median(z, axis=0) / 0.6745
        scale /= np.sqrt((scale[joint[visible]] ** 2).mean())
        assumed = np.hypot(0.013 / confidence[visible] ** 2, 1.0 / expected["px_a_metre"][visible])
        factor = float(np.median(np.interp(confidence[visible], KNOTS, sigma[0]) / assumed))
    # By size: the same confidence, near and far people: sigma_m² = a² + (floor / size)².
    those = hit & (state == 0) & (confidence > 0.75) & (confidence < 0.9)
    size, spread = expected["px_a_metre"][those], factor * expected["spread_m"][those]
    which = np.clip(np.searchsorted(np.quantile(size, np.linspace(0, 1, 7)), size) - 1, 0, 5)
    rows = []
    for b in range(6):
        own2 = (np.median(length[those][which == b]) / 1.1774) ** 2 - np.median(spread[which == b]) ** 2
        rows.append((1.0, 1.0 / np.median(size[which == b]) ** 2, own2))
    rows = np.array(rows)
    floor2 = np.linalg.lstsq(rows[:, :2], rows[:, 2], rcond=None)[0][1]
    return {
        "knots": KNOTS.tolist(),
        "sigma_m": rounded(sigma, 4),
        "tail": rounded(tail, 2),
        "joint_scale": rounded(scale, 2),
        "spread_factor": round(factor, 3),
        "floor_px": round(float(np.sqrt(max(floor2, 0.0))), 2),
        "size_px_a_metre": round(float(np.median(expected["px_a_metre"])), 1),
    }


_DRAWS = np.random.default_rng(0).normal(size=(6000, 5))
_TAILS = np.linspace(0.0, 1.2, 25)


def _scale_and_tail(length: NDArray, spread: NDArray) -> tuple[float, float]:
    """Sigma of each axis, metres, and tail: the standard deviation of the logarithm of a changing sigma.

    The length of an error with sigma exp(tail g), g normal, has a ratio of 90 % to 50 % quantile that grows with
    the tail; the prediction's own error is Gaussian.
    """
    if len(length) < 30:
        return np.nan, np.nan
    median, ninety = np.quantile(length, [0.5, 0.9])
    other = np.median(spread)
    own = np.sqrt(max((median / 1.1774) ** 2 - other**2, 0.003**2))
    best = (np.inf, own, 0.0)
    for tail in _TAILS:
        drawn = np.exp(tail * _DRAWS[:, :1]) * _DRAWS[:, 1:3]
        for sigma in own * np.array([0.8, 0.85, 0.9, 0.95, 1.0, 1.05]):
            q = np.quantile(np.linalg.norm(sigma * drawn + other * _DRAWS[:, 3:], axis=1), [0.5, 0.9])
            best = min(best, (abs(q[0] / median - 1) + abs(q[1] / ninety - 1), sigma, tail))
    return float(best[1]), float(best[2])


def whitened(expected: dict[str, NDArray], state: NDArray, errors: dict[str, Any]) -> NDArray:
    """Residuals (M, 2) of visible joints by the sigma that is expected of them; wild ones NaN."""
    sigma = np.interp(expected["confidence"], KNOTS, errors["sigma_m"][0])
    total = np.hypot(sigma, errors["spread_factor"] * expected["spread_m"])[:, None]
    z = expected["residual_m"] / total / np.array(errors["joint_scale"])[GROUP[expected["joint"]]]
    return np.where((np.abs(z) < 4) & (state == 0)[:, None], z, np.nan)
