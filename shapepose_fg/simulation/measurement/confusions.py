"""Confusions: left with right, one person's joint with another's, nothing with a joint."""

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from shapepose_fg.core.camera import Rig
from shapepose_fg.simulation.measurement.classes import GROUP, GROUPS, LEVELS, rounded
from shapepose_fg.simulation.measurement.memories import memory_of
from shapepose_fg.simulation.measurement.sample import Sample
from shapepose_fg.simulation.measurement.sample_tables import MIRROR, NEAR_M

MIRROR_APART_M = 0.12
"""Left and right are told apart where they are at least this far from each other in the image."""


def swaps(expected: dict[str, NDArray]) -> dict[str, Any]:
    """Share of joints, apart from their mirror, that are found under the mirrored name, instead or besides."""
    apart = np.nan_to_num(expected["mirror_m"]) > MIRROR_APART_M
    visible = apart & (expected["seen"] > 0.5)
    instead = expected["swapped"] & ~expected["hit"]
    besides = expected["swapped"] & expected["hit"]
    return {
        "instead": round(float(instead[visible].mean()), 5),
        "besides": round(float(besides[visible].mean()), 5),
        # Of two coordinates, half of the distances are below 1.1774 sigma.
        "double_m": round(float(np.median(expected["double_m"][besides & visible])) / 1.1774, 4),
        "double_confidence": rounded(np.quantile(expected["double_confidence"][besides & visible], LEVELS)),
    }


def capture(captured: dict[str, NDArray]) -> dict[str, Any]:
    """Share of joints missed behind another person whose neighbours' affinity reaches that person's joint."""
    edges = np.array([0.0, 0.1, 0.2, 0.3, 0.5, 1.0])
    which = np.searchsorted(edges, captured["gap_m"], side="right") - 1
    share = [float(captured["taken"][which == b].mean()) if (which == b).any() else 0.0 for b in range(len(edges))]
    return {"gap_m": edges.tolist(), "share": rounded(np.array(share))}


def merging(sample: Sample, rig: Rig) -> dict[str, Any]:
    """Distance in pixels at which two people's same joints, both visible, are found as two in half the cases."""
    pairs = sample.neighbours
    edges = np.arange(0, 121, 10)
    both = []
    for low, high in pairwise(edges):
        those = (pairs["gap_px"] >= low) & (pairs["gap_px"] < high) & (pairs["hits"] > 0)
        both.append((pairs["hits"][those] == 2).mean() if those.sum() > 5 else np.nan)
    both, middle = np.array(both), (edges[:-1] + edges[1:]) / 2
    known = np.isfinite(both)

    def misfit(x: NDArray) -> float:
        ceiling = 0.85
        return float(np.square(ceiling / (1 + np.exp(-(middle - x[0]) / abs(x[1]))) - both)[known].sum())

    at, width = minimize(misfit, [45.0, 8.0], method="Nelder-Mead").x
    return {
        "half_px": round(float(at), 1),
        "width_px": round(float(abs(width)), 1),
        "found_apart": rounded(np.nan_to_num(both), 2),
        "image_height_px": float(rig.image_sizes[:, 1].mean()),
    }


def false_candidates(sample: Sample, rig: Rig, fps: float) -> dict[str, Any]:
    """Candidates of nobody, parts of people nobody reconstructed left out."""
    c = sample.candidates
    nobody = (c["owner"] < 0) & ~c["stranger"]
    near = nobody & (c["any_joint_m"] < NEAR_M)
    far = nobody & ~near
    frames = c["frame"].max() + 1
    person_views = sample.people_in_views
    mirrored = near & (c["mirrored_m"] < 0.1) & (MIRROR[c["joint"]] != c["joint"])
    others = nobody & ~mirrored
    groups = np.bincount(GROUP[c["joint"][others]], minlength=len(GROUPS)) / max(others.sum(), 1)
    lags = np.array([1, 2, 3, 5, 10])
    still_there = _persistence(c, nobody, lags)
    return {
        "near_per_person": round(float(near.sum() / person_views), 4),
        "far_per_view": round(float(far.sum() / (frames * len(rig))), 4),
        "others_per_person": round(float((near & others).sum() / person_views), 4),
        "near_m": rounded(np.quantile(c["any_joint_m"][near & others], LEVELS)),
        "joints": rounded(groups),
        "near_confidence": rounded(np.quantile(c["confidence"][near & others], LEVELS)),
        "far_confidence": rounded(np.quantile(c["confidence"][far], LEVELS)),
        "lags": lags.tolist(),
        "still_there": rounded(still_there),
        "memory": memory_of(still_there, lags, fps),
    }


def _persistence(c: dict[str, NDArray], those: NDArray, lags: NDArray) -> NDArray[np.float64]:
    """Share of the false candidates with one of the same joint and view within 40 px some frames later."""
    found, total = np.zeros(len(lags)), 0
    for label in np.unique(c["view"][those] * 25 + c["joint"][those]):
        of_label = those & (c["view"] * 25 + c["joint"] == label)
        frame, xy = c["frame"][of_label], c["xy"][of_label]
        near = np.linalg.norm(xy[None] - xy[:, None], axis=-1) < 40
        later = frame[None] - frame[:, None]
        found += [((later == lag) & near).any(axis=1).sum() for lag in lags]
        total += of_label.sum()
    return found / max(total, 1)
