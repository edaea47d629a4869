"""What must be drawn so that a simulated recording measures like the real one."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.detections import Recording
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation import DetectorConfig
from shapepose_fg.simulation.detector import Detector
from shapepose_fg.simulation.detector_statistics import DetectorStatistics
from shapepose_fg.simulation.measurement.classes import LAGS, rounded
from shapepose_fg.simulation.measurement.memories import memory_of
from shapepose_fg.simulation.measurement.people import CONFIG, FPS, find
from shapepose_fg.simulation.measurement.sample import Sample, pool, take_sample
from shapepose_fg.simulation.measurement.statistics import statistics
from shapepose_fg.simulation.scene import Scene
from shapepose_fg.simulation.visibility import Skin, Visibility, VisibilityConfig, see

SEEDS = 3
"""Simulated recordings in each round of calibration."""


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
    return {name: rounded(value, 4) for name, value in drawn.items()}


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
    moved = np.array(memory_of(np.minimum(curve, 0.99), LAGS, FPS))
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
