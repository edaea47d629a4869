"""How a real 2D detector errs, measured without any annotation: python scripts/measure_detector.py [--update].

Each view is judged by the others: where at least three other views agree on a joint, their triangulation, without
the view in question, says where the joint is in it. Bodies fitted to all views say who hides whom. The annotation
of the recording is not read. What the simulated detector draws is then calibrated: the same measurement on a
simulated recording of the same poses must find the same. `--update` writes what was found to
shapepose_fg/simulation/data/detector.json, from which the simulated detector draws. Takes about seven minutes.
"""

import argparse
import json
import os
import re
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from detector_misses import FREE, miss_tables, tetrachoric
from detector_sample import MIRROR, NEAR_M, RAMP, People, Sample, find, pool, take_sample, twin
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import ndtri

from shapepose_fg.camera import Rig
from shapepose_fg.detections import DetectionSequence, Recording
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline import PipelineConfig
from shapepose_fg.simulation import DetectorConfig
from shapepose_fg.simulation.detector import Detector
from shapepose_fg.simulation.detector_statistics import DetectorStatistics
from shapepose_fg.simulation.scene import Scene
from shapepose_fg.simulation.visibility import Skin, Visibility, VisibilityConfig, see
from shapepose_fg.skeleton import BODY_25

ROOT = Path(__file__).parents[1]
OUTPUT = ROOT / "shapepose_fg" / "simulation" / "data" / "detector.json"
CONFIG = PipelineConfig()
SEEDS = 3
"""Simulated recordings in each round of calibration."""
FPS = 25.0
"""Of the Shelf recording."""
SEEN, HIDDEN = 0.7, 0.3
"""A joint is visible when more than this share of it is seen, hidden when less than that."""
LEVELS = np.array([0.0, 0.02, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.98, 1.0])
"""Where distributions are told by their quantiles."""
KNOTS = np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
"""Confidences at which errors are told."""
LAGS = np.array([1, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 40])
"""Frames over which memories are fitted."""
LONGEST_S = 6.0
"""Of what lasts longer, a recording of 12 seconds tells nothing."""
DETOURS = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0])
"""Lower edges of the classes of wrong pairs, in limb lengths."""
PRIOR = 20
"""All joints together count as this many cases of each of them."""
MIRROR_APART_M = 0.12
"""Left and right are told apart where they are at least this far from each other in the image."""

GROUPS = tuple(j for j in range(25) if j <= MIRROR[j])
"""The first of each joint and its mirror: 14."""
GROUP = np.array([GROUPS.index(min(j, int(MIRROR[j]))) for j in range(25)])
"""(25,) the group of each joint."""
LIMBS = np.array(BODY_25.limbs)
_LIMB_NAMES = [min(tuple(limb), tuple(MIRROR[limb].tolist())) for limb in LIMBS.tolist()]
LIMB_GROUP = np.array([sorted(set(_LIMB_NAMES)).index(name) for name in _LIMB_NAMES])
"""(26,) the same for limbs: 14."""


def main() -> None:
    """Measure, calibrate, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with data/shelf/ (default SHAPEPOSE_DATA, ../shared)")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of calibration (default 5)")
    parser.add_argument("--afresh", action="store_true", help="begin with what was measured, not with the file's")
    parser.add_argument("--update", action="store_true", help=f"write {OUTPUT.relative_to(ROOT)}")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    detections, rig, people = shelf_people(shelf_folder(arguments.data))
    sample = take_sample(detections, rig, people, CONFIG)
    measured = statistics(sample, rig, FPS)
    provenance = PROVENANCE | {
        "joints judged": len(sample.expected["hit"]),
        "rounds": arguments.rounds,
        "recordings a round": SEEDS,
    }
    begin = {} if arguments.afresh else json.loads(OUTPUT.read_text(encoding="utf-8"))["drawn"]
    drawn = calibrate(measured, twin(people, rig, FPS), arguments.rounds, begin)
    text = pretty({"provenance": provenance, "measured": measured, "drawn": drawn})
    print(text)
    if arguments.update:
        OUTPUT.parent.mkdir(exist_ok=True)
        OUTPUT.write_text(text + "\n", encoding="utf-8")


def shelf_folder(data: Path | None) -> Path:
    """Where the recording is."""
    root = data or Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    return root / "data" / "shelf"


PROVENANCE = {
    "recording": "Shelf (Belagiannis et al. 2014), 301 frames, 5 cameras, 25 frames a second",
    "detections": "OpenPose BODY_25 candidates of github.com/zhangyux15/4d_association (Zhang et al., CVPR 2020)",
    "method": "each view against the triangulation of at least 3 others; no annotation was read",
    "script": "scripts/measure_detector.py",
}


def shelf_people(folder: Path) -> tuple[DetectionSequence, Rig, People]:
    """The Shelf recording and whom it shows; its annotation is not opened."""
    rig = read_rig(folder / "calibration.json")
    detections = read_detections(folder, rig)
    return detections, rig, find(detections, rig, CONFIG)


def calibrate(measured: dict[str, Any], scene: Scene, rounds: int, begin: dict[str, Any]) -> dict[str, Any]:
    """What must be drawn so that this script measures in a simulated recording what it measured in the real one.

    Bodies and predictions are not quite right, and so a part of what is measured is the measurement's own error.
    The simulated recording shows the same poses before the same cameras; each round moves what is drawn by what
    is measured too much or too little. `begin` is what was drawn before, empty to begin with what was measured.
    """
    flat = flatten(measured)
    drawn = {name: np.array(begin.get(name, flat[key]), dtype=float) for name, (key, _) in ADJUSTED.items()}
    looks = watch(scene)
    for index in range(rounds):
        gain = 0.8 / (1.0 + 0.5 * index)  # recordings have their own chances: later ones are averaged
        plain = {name: value.tolist() for name, value in drawn.items()}
        config = DetectorConfig(statistics=DetectorStatistics.of(measured, plain))
        seeds = range(SEEDS * index, SEEDS * (index + 1))
        found = flatten(statistics(pool(simulated(scene, looks, config, seeds)), scene.rig, FPS))
        for name, (key, way) in ADJUSTED.items():
            drawn[name] = _moved(drawn[name], np.array(flat[key]), np.array(found[key]), way, gain)
    return {name: _rounded(value, 4) for name, value in drawn.items()}


Looks = list[tuple[NDArray[np.float64], Visibility]]
"""True joints (P, 25, 3) and what is seen of them, frame by frame: the same for every seed."""


def watch(scene: Scene) -> Looks:
    """Everybody in `scene`, and who is visible."""
    config = VisibilityConfig()
    skin = Skin.of(scene.body, config.cell_m)
    joints = [scene.truth_at(frame) for frame in range(len(scene))]
    surfaces = (scene.vertices_at(frame, skin.vertices) for frame in range(len(scene)))
    pairs = zip(joints, surfaces, strict=True)
    return [(at, see(scene.rig, at, surface, skin, config)) for at, surface in pairs]


def simulated(scene: Scene, looks: Looks, config: DetectorConfig, seeds: Iterable[int]) -> list[Sample]:
    """Recordings of one scene with several seeds, each measured like the real one."""
    samples = []
    for seed in seeds:
        detector = Detector(scene.rig, scene.people, scene.fps, config, seed)
        recording = Recording(BODY_25, [detector.detect(*look) for look in looks])
        samples.append(take_sample(recording, scene.rig, find(recording, scene.rig, CONFIG), CONFIG))
    return samples


def flatten(nested: dict[str, Any]) -> dict[str, Any]:
    """Inner keys joined to the outer by a dot."""
    parts = {key: part for key, part in nested.items() if isinstance(part, dict)}
    return nested | {f"{key}.{name}": inner for key, part in parts.items() for name, inner in part.items()}


ADJUSTED = {
    "miss": ("miss", "odds by state"),
    "buried": ("buried", "probit"),
    "lost": ("lost", "nested ratio"),
    "lost_memory": ("memory.lost", "memory"),
    "confidence": ("confidence", "quantiles by state"),
    "sigma_m": ("sigma_m", "ratio by state"),
    "tail": ("tail", "visible"),
    "joint_scale": ("joint_scale", "ratio"),
    "error_memory": ("memory.error", "memory"),
    "confidence_memory": ("memory.confidence", "memory"),
    "swap": ("swap.instead", "ratio"),
    "double": ("swap.besides", "ratio"),
    "merge_px": ("merge.half_px", "ratio"),
    "capture": ("capture.share", "odds"),
    "false_near": ("false.others_per_person", "ratio"),
    "false_far": ("false.far_per_view", "ratio"),
    "false_near_m": ("false.near_m", "one ratio"),
    "affinity_right": ("affinity.right", "quantiles"),
    "affinity_wrong": ("affinity.wrong", "quantiles together"),
    "affinity_wrong_share": ("affinity.wrong_share", "odds"),
    "affinity_nobody_share": ("affinity.nobody_share", "odds"),
}
"""What is calibrated: field of `DetectorStatistics`, where it is measured, and how it is moved. What is rare moves
together, so that no chance of one recording is copied."""


def _moved(drawn: NDArray, wanted: NDArray, found: NDArray, way: str, gain: float) -> NDArray:
    """`drawn`, moved by how far what was `found` is from what is `wanted`, not all the way at once."""
    found = np.where(np.isfinite(found), found, wanted)  # too rare to be measured
    if way.startswith("odds"):
        step = _logit(wanted) - _logit(found)
        if way == "odds by state":  # by joint where visible, of all joints together where hidden
            step[:, 1:] = np.mean(step[:, 1:], axis=0)
        moved = 1 / (1 + np.exp(-(_logit(drawn) + np.clip(gain * step, -0.7, 0.7))))
        return np.where(wanted > 0, moved, 0.0)
    if way.endswith("ratio"):
        ratio = np.median(wanted / found) if way == "one ratio" else wanted / np.maximum(found, 1e-9)
        if way == "nested ratio":  # the second is a part of the first, and rarer
            drawn = drawn * np.clip(ratio, 0.6, 1.6) ** gain
            return np.array([drawn[0], min(drawn[1], 0.8 * drawn[0])])
        moved = drawn * np.clip(ratio, 0.6, 1.6) ** gain
        return np.minimum(moved, 1.6 * wanted) if way == "one ratio" else moved
    if way == "ratio by state":
        step = np.log(wanted / found)
        step[0] = np.convolve(np.pad(step[0], 1, mode="edge"), np.ones(3) / 3, mode="valid")
        step[1:] = np.median(step[1:], axis=1, keepdims=True)
        return drawn * np.exp(gain * np.clip(step, -0.4, 0.4))
    if way == "visible":
        return np.vstack(
            [np.clip(drawn[:1] + gain * np.clip(wanted - found, -0.3, 0.3)[:1], 0.05, 1.0), drawn[1:]]
        )
    if way == "probit":
        return np.maximum.accumulate(drawn + gain * np.clip(wanted - found, -0.5, 0.5))
    if way.startswith("quantiles"):
        return _matched(drawn, wanted, found, way, gain)
    curve = _curve(drawn) * np.clip(_curve(wanted) / np.maximum(_curve(found), 1e-3), 0.7, 1.5) ** gain
    moved = np.array(_memory(np.minimum(curve, 0.99), LAGS, FPS))
    moved[:, 0] *= min(1.0, 0.995 / moved[:, 0].sum())
    return moved


def _matched(drawn: NDArray, wanted: NDArray, found: NDArray, way: str, gain: float) -> NDArray:
    """Quantiles (..., K): each drawn value moves to the value that is wanted where it is found itself.

    By value and not by level: at the low end may be people mostly hidden, whom no drawn quantile moves, and values
    that move together stay in order. Rare rows are moved together, by the mean over their quantiles.
    """
    shown, aim, share = found, wanted, np.full(drawn.shape, gain)
    if way == "quantiles by state":  # by joint where visible, of all joints together where hidden
        shown, aim = found.copy(), wanted.copy()
        shown[:, 1:], aim[:, 1:] = found[:, 1:].mean(axis=0), wanted[:, 1:].mean(axis=0)
        share[:, 1:] = 0.8  # well known, but slow to follow: how much others hide moves them too
    if way == "quantiles together":
        shown, aim = (np.broadcast_to(table.mean(axis=0), table.shape) for table in (found, wanted))
    rows = [part.reshape(-1, part.shape[-1]) for part in (drawn, shown, aim)]
    step = np.stack([np.interp(at, x, y - x) for at, x, y in zip(*rows, strict=True)]).reshape(drawn.shape)
    moved = np.maximum.accumulate(drawn + np.clip(share * step, -0.1, 0.1), axis=-1)
    return np.clip(moved, wanted.min(axis=0)[..., :1], wanted.max(axis=0)[..., -1:])


def _curve(memory: NDArray) -> NDArray:
    """The autocorrelation over LAGS of a fast and a slow process."""
    return (memory[:, :1] * np.exp(-LAGS / FPS / memory[:, 1:])).sum(axis=0)


def _logit(share: NDArray) -> NDArray:
    share = np.clip(share, 1e-3, 0.99)
    return np.log(share / (1 - share))


def pretty(value: dict[str, Any]) -> str:
    """JSON with one row of numbers a line."""
    text = json.dumps(value, indent=1)
    # Inner lists of numbers on one line each.
    return re.sub(r"\[\s+([-\d.,\s]+?)\s+\]", lambda row: "[" + " ".join(row[1].split()) + "]", text)


def statistics(sample: Sample, rig: Rig, fps: float) -> dict[str, Any]:
    """What the simulated detector draws from; lengths in metres, times in seconds."""
    expected = sample.expected
    state = joint_states(expected)
    confidence = _confidence_tables(expected, state)
    errors = _errors(expected, state)
    return {
        "states": ["visible", "hidden by itself", "hidden by another person"],
        "levels": LEVELS.tolist(),
        **miss_tables(expected, state, GROUP[expected["joint"]], len(GROUPS)),
        **confidence,
        **errors,
        "facing": RAMP.tolist(),
        "memory": _memories(expected, state, errors, fps),
        "joint_correlation": _joint_correlation(expected, state, errors, rig),
        "swap": swaps(expected),
        "capture": _capture(sample.captured),
        "merge": merging(sample, rig),
        "false": false_candidates(sample, rig, fps),
        "affinity": _affinity(sample.pairs),
    }


def joint_states(expected: dict[str, NDArray]) -> NDArray[np.intp]:
    """0 visible, 1 hidden by itself, 2 hidden by another, -1 in between."""
    hidden = np.where(expected["hidden_by"] >= 0, 2, 1)
    return np.where(expected["seen"] > SEEN, 0, np.where(expected["seen"] < HIDDEN, hidden, -1))


def _confidence_tables(expected: dict[str, NDArray], state: NDArray) -> dict[str, Any]:
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
    return {"confidence": _rounded(quantiles)}


def _errors(expected: dict[str, NDArray], state: NDArray) -> dict[str, Any]:
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
        "sigma_m": _rounded(sigma, 4),
        "tail": _rounded(tail, 2),
        "joint_scale": _rounded(scale, 2),
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


def autocorrelation(value: NDArray, expected: dict[str, NDArray], lags: NDArray) -> NDArray[np.float64]:
    """Of values (M,) of one joint of one person in one view, over frames; NaN values are left out."""
    known = np.isfinite(value)
    key = (expected["track"] * 64 + expected["view"]) * 25 + expected["joint"]
    rows, row = np.unique(key[known], return_inverse=True)
    table = np.full((len(rows), expected["frame"].max() + 1), np.nan)
    table[row, expected["frame"][known]] = value[known]
    found = []
    for lag in lags:
        product = table[:, lag:] * table[:, : table.shape[1] - lag]
        found.append(np.nanmean(product) / np.nanmean(table**2))
    return np.array(found)


def _memory(values: NDArray, lags: NDArray, fps: float) -> list[list[float]]:
    """[[share, seconds], [share, seconds]]: a fast and a slow process whose sum has this autocorrelation.

    What is missing to 1 is new in every frame.
    """
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


def whitened(expected: dict[str, NDArray], state: NDArray, errors: dict[str, Any]) -> NDArray:
    """Residuals (M, 2) of visible joints by the sigma that is expected of them; wild ones NaN."""
    sigma = np.interp(expected["confidence"], KNOTS, errors["sigma_m"][0])
    total = np.hypot(sigma, errors["spread_factor"] * expected["spread_m"])[:, None]
    z = expected["residual_m"] / total / np.array(errors["joint_scale"])[GROUP[expected["joint"]]]
    return np.where((np.abs(z) < 4) & (state == 0)[:, None], z, np.nan)


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


def _memories(expected: dict[str, NDArray], state: NDArray, errors: dict[str, Any], fps: float) -> dict[str, Any]:
    z = whitened(expected, state, errors)
    error = np.mean([autocorrelation(z[:, axis], expected, LAGS) for axis in range(2)], axis=0)
    score = autocorrelation(normal_scores(expected, state), expected, LAGS)
    found = autocorrelation(hits_about_mean(expected, state), expected, LAGS)
    lost = tetrachoric(found, 1 - float(expected["hit"][state == 0].mean()))
    return {
        "error": _memory(error, LAGS, fps),
        "confidence": _memory(score, LAGS, fps),
        "lost": _memory(lost, LAGS, fps),
    }


def _joint_correlation(
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
        "lost": _rounded(of_misses, 2),
        "error": _rounded(of_errors, 2),
        "confidence": _rounded(correlation(normal_scores(expected, state)), 2),
    }


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
        "double_confidence": _rounded(np.quantile(expected["double_confidence"][besides & visible], LEVELS)),
    }


def _capture(captured: dict[str, NDArray]) -> dict[str, Any]:
    """Share of joints missed behind another person whose neighbours' affinity reaches that person's joint."""
    edges = np.array([0.0, 0.1, 0.2, 0.3, 0.5, 1.0])
    which = np.searchsorted(edges, captured["gap_m"], side="right") - 1
    share = [float(captured["taken"][which == b].mean()) if (which == b).any() else 0.0 for b in range(len(edges))]
    return {"gap_m": edges.tolist(), "share": _rounded(np.array(share))}


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
        "found_apart": _rounded(np.nan_to_num(both), 2),
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
        "near_m": _rounded(np.quantile(c["any_joint_m"][near & others], LEVELS)),
        "joints": _rounded(groups),
        "near_confidence": _rounded(np.quantile(c["confidence"][near & others], LEVELS)),
        "far_confidence": _rounded(np.quantile(c["confidence"][far], LEVELS)),
        "lags": lags.tolist(),
        "still_there": _rounded(still_there),
        "memory": _memory(still_there, lags, fps),
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


def _affinity(pairs: dict[str, NDArray]) -> dict[str, Any]:
    """Right pairs by limb, with the lower confidence; wrong ones by how far the wrong end is off."""
    limb_group, right = LIMB_GROUP[pairs["limb"]], pairs["right"]
    count = LIMB_GROUP.max() + 1
    affinity = np.stack([np.quantile(pairs["affinity"][right & (limb_group == g)], LEVELS) for g in range(count)])
    confidence = np.stack(
        [np.quantile(pairs["confidence"][right & (limb_group == g)], LEVELS) for g in range(count)]
    )
    scores = []
    for g in range(count):
        those = np.flatnonzero(right & (limb_group == g))
        rank = [np.argsort(np.argsort(pairs[name][those])) for name in ("affinity", "confidence")]
        scores.append(ndtri((np.array(rank) + 0.5) / len(those)))
    scores = np.concatenate(scores, axis=1)
    wrong = ~right & ~pairs["nobody"]
    which = np.searchsorted(DETOURS, pairs["detour"], side="right") - 1
    listed = pairs["affinity"] > 0
    result = {
        "limbs": [list(map(int, LIMBS[g == LIMB_GROUP][0])) for g in range(count)],
        "right": _rounded(affinity),
        "right_confidence": _rounded(confidence),
        "correlation": round(float(np.corrcoef(scores)[0, 1]), 3),
        "detours": DETOURS.tolist(),
    }
    for name, those in (("wrong", wrong), ("nobody", pairs["nobody"])):
        share, quantiles = [], []
        for b in range(len(DETOURS)):
            here = those & (which == b)
            share.append(float(listed[here].mean()) if here.any() else 0.0)
            values = pairs["affinity"][here & listed]
            values = values if len(values) >= 8 else pairs["affinity"][those & listed]
            quantiles.append(np.quantile(values, LEVELS))
        result[f"{name}_share"], result[name] = _rounded(np.array(share), 4), _rounded(np.array(quantiles))
    return result


def _rounded(values: NDArray, digits: int = 3) -> list:
    return np.round(values, digits).tolist()


if __name__ == "__main__":
    main()
