"""The body fitters that ship, on bodies that are known: their joints made worse step by step.

Bodies of random shapes in recorded poses of people not used for learning or choosing (`training.motions`),
half of them dancers, anywhere in a room; the same targets for every fitter. Times are of whole fits, and the
processor's, of one thread.
"""

import time
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.fitter import BodyFitter, JointTargets
from shapepose_fg.body.fitting.fitters import SmplFitter, make_fitter
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.experiments.experiment import Case, Column, Experiment, Figures
from shapepose_fg.evaluation.experiments.stretches import Scale
from shapepose_fg.evaluation.metrics import covariance_calibration
from shapepose_fg.simulation.sequences import DANCERS
from shapepose_fg.simulation.training.motions import load_motions

Array = NDArray[np.float64]

FITTERS: dict[str, Callable[[], BodyFitter]] = {
    "Levenberg-Marquardt": SmplFitter,
    "learned": make_fitter,
}
TARGETS = {"clean": (0.0, 0.0), "10 mm": (0.01, 0.0), "20 mm, 30 % missing": (0.02, 0.3)}
"""Noise along each axis, metres, and the expected share of joints without a target."""
BODIES, BATCH = 2048, 64
SHAPE_LIMIT, ROOM_M, SIGMA_FLOOR_M = 2.5, 4.0, 0.005
"""Betas are standard normal, clipped here; the side of the room; no joint is known better than this."""
LIMBS = tuple(
    [BODY_25.index(side + part) for part in parts.split()]
    for side in "LR"
    for parts in ("Shoulder Elbow Wrist", "Hip Knee Ankle BigToe SmallToe Heel")
)
"""What is hidden together: arms and legs."""
COLUMNS = (
    *(Column("all joints, mm", "mm"), Column("seen", "seen_mm"), Column("missing", "missing_mm")),
    *(Column("inside 50 %, %", "seen_inside_50"), Column("95 %", "seen_inside_95")),
    *(Column("missing: 50 %", "missing_inside_50"), Column("95 %", "missing_inside_95")),
    *(Column(f"ms a fit, {BATCH} at a time", "ms", 2), Column("no body", "without", 0)),
)


def fitters(scale: Scale) -> Experiment:
    """Errors and times of every fitter on every kind of targets."""
    rows = {}
    if scale.mocap is not None and not scale.quick:
        for kind in TARGETS:
            for name in FITTERS:
                rows[f"{kind}: {name}"] = [Case(f"{kind} {name}", partial(measure, scale.mocap, kind, name))]
    return Experiment("fitter", rows, COLUMNS, "bodies")


def measure(motions: Path, kind: str, name: str) -> Figures:
    """One fitter on one kind of targets: distances to the true joints, and whether covariances say them."""
    truth, fitter = _truth(motions), FITTERS[name]()
    targets, missing = corrupt(truth, *TARGETS[kind], np.random.default_rng(1))
    with torch_threads(1):
        fitter.fit(targets.rows(np.arange(BATCH)))  # warm-up
        began = time.process_time()
        fits = [fitter.fit(targets.rows(np.arange(first, first + BATCH))) for first in range(0, BODIES, BATCH)]
        ms = 1e3 * (time.process_time() - began) / BODIES
    joints, covariance = (
        np.concatenate([getattr(fit, part) for fit in fits]) for part in ("joints", "covariance")
    )
    error, fitted = joints - truth, np.asarray(np.isfinite(joints).all(axis=(1, 2)))
    figures: Figures = {"mm": _mean_mm(error[fitted]), "ms": ms, "without": int((~fitted).sum())}
    for group, mask in (("seen", ~missing), ("missing", missing)):
        mask = mask & fitted[:, None]
        found = covariance_calibration(error[mask], covariance[mask])
        figures[f"{group}_mm"] = _mean_mm(error[mask])
        for level in (0.5, 0.95):
            figures[f"{group}_inside_{100 * level:.0f}"] = 100 * found.coverage[level] if mask.any() else None
    return figures


def corrupt(
    keypoints: Array, sigma_m: float, share: float, rng: np.random.Generator
) -> tuple[JointTargets, NDArray[np.bool_]]:
    """Targets of joints (N, 25, 3), and which are missing (N, 25): NaN there, and without information.

    Half of what is missing goes with its whole limb, half singly.
    """
    each_way = share / 2 * len(BODY_25)
    missing = rng.random(keypoints.shape[:2]) < each_way / (len(BODY_25) - each_way)
    gone = rng.random((len(keypoints), len(LIMBS))) < each_way / sum(map(len, LIMBS))
    for limb, joints in enumerate(LIMBS):
        missing[:, joints] |= gone[:, limb, None]
    xyz = np.where(missing[..., None], np.nan, keypoints + sigma_m * rng.normal(size=keypoints.shape))
    precision = np.where(missing, 0.0, max(sigma_m, SIGMA_FLOOR_M) ** -2)
    return JointTargets(xyz, precision[..., None, None] * np.eye(3)), missing


@lru_cache(maxsize=1)
def _truth(motions: Path) -> Array:
    """(N, 25, 3) joints of bodies, metres, z up; recorded frames evenly spread, every second one of a dancer."""
    test = load_motions(motions).of("test")
    dances = np.isin(test.subject, sorted(DANCERS))
    spread = [
        group[np.linspace(0, len(group) - 1, BODIES // 2).astype(np.intp)]
        for group in map(np.flatnonzero, (dances, ~dances))
    ]
    return true_joints(test.poses[np.stack(spread, axis=1).ravel()].astype(np.float64), np.random.default_rng(0))


def true_joints(poses: Array, rng: np.random.Generator) -> Array:
    """(N, 25, 3) joints, z up, of bodies of drawn shapes in recorded `poses` (N, 24, 3), axis-angle, y up."""
    count = len(poses)
    heading = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (count, 1)))
    upright = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0])
    orient = (heading * upright * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    betas = np.clip(rng.normal(size=(count, 10)), -SHAPE_LIMIT, SHAPE_LIMIT)
    transl = np.concatenate([rng.uniform(-ROOM_M / 2, ROOM_M / 2, (count, 2)), np.ones((count, 1))], axis=1)
    bodies = BodyParameters(*map(torch.from_numpy, (betas, orient, poses[:, 1:], transl)))
    with torch.no_grad():
        return BodyModel.default().to(torch.float64).keypoints(bodies).numpy()


def _mean_mm(error: Array) -> float | None:
    return float(1e3 * np.linalg.norm(error, axis=-1).mean()) if error.size > 0 else None
