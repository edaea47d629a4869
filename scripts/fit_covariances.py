"""Fit how uncertain people in single frames are (`Doubt` of `estimation/covariance_factors.py`) to
the errors in simulated recordings, and average the noise laws learnt from them
(`estimation/noise_law.py`).

    python scripts/fit_covariances.py --mocap cmu_smpl24.npz --output covariances.json

Crowds, crossings and pairs with two to six cameras, 4 s each, every frame by itself; a quarter of
an hour on one core. The mean log score of the true joint under its Gaussian is maximised. Joints
seen by two or more views and by one have fixed shares in it, and errors beyond `FAR` have little
influence. Finally, covariances are scaled so that 95 % regions hold 95 %: errors have heavier tails
than a Gaussian.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.estimation import body_solution
from shapepose_fg.estimation.covariance_factors import Doubt, covariance_factors, signs_of_doubt
from shapepose_fg.estimation.noise_law import NoiseLaw
from shapepose_fg.evaluation.metrics import match_people
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import SEQUENCES, Split, sequence

CASES: tuple[tuple[str, Split, int, int], ...] = (
    ("crowd", "tune", 7001, 3), ("crossing", "tune", 7002, 3), ("crowd", "tune", 7003, 4),
    ("crossing", "tune", 7004, 4), ("two", "tune", 7005, 2), ("crowd", "tune", 7006, 3),
    ("crossing", "tune", 7007, 3), ("two", "tune", 7008, 2), ("crowd", "tune", 7009, 6),
    ("two", "tune", 777, 2), ("crossing", "tune", 7011, 2), ("crowd", "tune", 7012, 2),
    ("salsa", "tune", 7013, 4), ("salsa", "tune", 7014, 6),
)  # fmt: skip
"""Scene, split, seed, number of cameras."""
FRAMES, FPS = 120, 30.0
FAR = 30.0
"""Squared Mahalanobis distance beyond which the loss grows only logarithmically."""
REJECTED_POWER = 1.5
"""`Doubt.rejected`. It is not fitted: simulated people say 3.4, with which regions of recorded
people (MVOR) are far too wide, since real detectors have more guesses that gates reject."""
SHARES = (0.7, 1.0)
"""Shares in the log score of joints that are seen by one view, and by two or more."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mocap", type=Path, required=True, help="file of recorded motions")
    parser.add_argument("--output", type=Path, required=True, help="JSON file to be written")
    arguments = parser.parse_args()
    mocap = Mocap.load(arguments.mocap)
    laws = list[NoiseLaw]()
    parts = [part for case in CASES for part in errors(*case, mocap, laws)]
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    content = {
        "about": f"scripts/fit_covariances.py: {len(columns[0])} joints of simulated people",
        "noise": mean_law(laws),
        "doubt": asdict(fitted(*columns)),
    }
    arguments.output.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def mean_law(laws: list[NoiseLaw]) -> dict:
    """The mean noise law of recordings: what ships."""
    weights = np.array([law.count for law in laws]) + 1e-6
    squared, gross = (
        np.average(values, axis=0, weights=weights)
        for values in (np.square([law.times for law in laws]), [law.gross for law in laws])
    )
    return NoiseLaw(
        tuple(np.sqrt(squared).round(2).tolist()), tuple(gross.round(3).tolist())
    ).as_dict()


def errors(
    name: str, split: Split, seed: int, cameras: int, mocap: Mocap, laws: list[NoiseLaw]
) -> Iterator[tuple[np.ndarray, ...]]:
    """For joints that views see, in each window: squared Mahalanobis distance of the true one under
    the graph's covariance, number of views, and the person's signs of doubt.
    """
    if name == "two":
        scene = built_in_scene(seed, people=2, cameras=cameras, frames=FRAMES, fps=FPS)
    else:
        config = replace(SEQUENCES[name], seed=seed)
        whole = sequence(name, split, mocap, cameras=cameras, until=FRAMES, fps=FPS, config=config)
        scene = whole.part(range(FRAMES))
    detections, solved = simulate(scene, seed=seed), []
    with patch.object(
        body_solution,
        "covariance_factors",
        lambda each, noise: solved.append(each) or covariance_factors(each, noise),
    ):
        people = reconstruct(
            detections,
            scene.rig,
            PipelineConfig(temporal=False),
            times=FrameTimes.from_fps(FPS, len(detections)),
            cuts=scene.cuts,
        )
    laws.append(NoiseLaw.from_dict(people.run["noise_law"]))
    for marginals in solved:
        window, joints = marginals.window, marginals.window.joints(marginals.state)
        found = match_people(window.observations.frame, joints, scene.keypoints)
        off = (joints[found.row] - scene.keypoints[found.frame, found.person])[..., None]
        squared = (off.mT @ np.linalg.solve(marginals.joints()[found.row], off))[..., 0, 0]
        views = window.last.evidence.inlier[found.row].sum(axis=-1)
        sigma_m, told, used = signs_of_doubt(marginals)
        signs = (
            np.repeat(each[found.row, None], 25, 1)
            for each in (sigma_m, 1 - used / np.maximum(told, 1e-9))
        )
        seen = views > 0
        yield tuple(each[seen] for each in (squared, views, *signs))


def fitted(
    squared: np.ndarray, views: np.ndarray, sigma_m: np.ndarray, rejected: np.ndarray
) -> Doubt:
    """The numbers of least loss, scaled for 95 %."""
    share = np.where(views > 1, SHARES[1] / (views > 1).sum(), SHARES[0] / (views == 1).sum())

    def loss(numbers: np.ndarray) -> float:
        factor = Doubt(np.exp(numbers[0]), numbers[1], REJECTED_POWER).in_frames(sigma_m, rejected)
        off = squared / factor
        off = np.where(off > FAR, FAR * (1 + np.log(np.maximum(off, FAR) / FAR)), off)
        return float((share * (off + 3 * np.log(factor))).sum())

    numbers = minimize(loss, (0.0, 1.0), method="Nelder-Mead").x
    power = float(numbers[1])
    off = squared / Doubt(1.0, power, REJECTED_POWER).in_frames(sigma_m, rejected)
    order = np.argsort(off, kind="stable")
    at = np.searchsorted(np.cumsum(share[order]) / share.sum(), 0.95)
    scale = off[order][at] / chi2.ppf(0.95, 3)
    return Doubt(round(float(scale), 2), round(power, 2), REJECTED_POWER)


if __name__ == "__main__":
    main()
