"""Fit the ratio of reported covariances to those of the graph (`AssociationUncertainty` and
`CorrelatedErrors` of `estimation/reported_covariances.py`) to the errors in simulated recordings,
and the tails of these errors (`error_tails` of `results/uncertainty.py`), and average the noise
laws learnt from them (`estimation/noise_law.py`).

    python scripts/fit_covariances.py --mocap cmu_smpl24.npz --output covariances.json

Crowds, crossings and pairs with two to six cameras, 4 s each, every frame by itself and over time;
half an hour on one core. The mean log score of the true joint under its Gaussian is maximised.
In single frames joints seen by two or more views and by one have fixed shares in it; over time the
recordings and people whose detections have new errors in every frame count half each. Errors beyond
`FAR` have little influence. Finally, covariances are scaled so that 95 % regions of the recordings
hold 95 %: errors have heavier tails than a Gaussian, those of Student's t.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any
from unittest.mock import patch

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import chi2, f
from typer import Option, Typer

sys.path.insert(0, str(Path(__file__).parent.parent))

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.estimation import body_solution
from shapepose_fg.estimation.body_window import Marginals
from shapepose_fg.estimation.noise_law import NoiseLaw
from shapepose_fg.estimation.reported_covariances import (
    AssociationUncertainty,
    CorrelatedErrors,
    association_features,
    correlation_features,
    covariance_factors,
)
from shapepose_fg.evaluation.metrics import Matches, match_people
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.scene import ring_of_cameras
from shapepose_fg.simulation.sequences import SEQUENCES, Split, sequence
from tests.pipeline.test_fast_limbs import seen, swinging

Columns = tuple[Any, ...]
CASES: tuple[tuple[str, Split, int, int], ...] = (
    ("crowd", "tune", 7001, 3), ("crossing", "tune", 7002, 3), ("crowd", "tune", 7003, 4),
    ("crossing", "tune", 7004, 4), ("two", "tune", 7005, 2), ("crowd", "tune", 7006, 3),
    ("crossing", "tune", 7007, 3), ("two", "tune", 7008, 2), ("crowd", "tune", 7009, 6),
    ("two", "tune", 777, 2), ("crossing", "tune", 7011, 2), ("crowd", "tune", 7012, 2),
    ("salsa", "tune", 7013, 4), ("salsa", "tune", 7014, 6),
)  # fmt: skip
"""Scene, split, seed, number of cameras."""
FRAMES, FPS, NEW = 120, 30.0, 9
"""Length and rate of the recordings, and number of people whose errors are new in every frame."""
FAR = 30.0
"""Squared Mahalanobis distance beyond which the loss grows only logarithmically."""
REJECTED_POWER = 1.5
"""`AssociationUncertainty.rejected`. It is not fitted: 3.4 fits simulated people, but then regions
of recorded people (MVOR) are far too wide, since real detectors have more guesses that gates
reject."""
SHARES = (0.7, 1.0)
"""Shares in the log score of joints that are seen by one view, and by two or more."""


app = Typer(add_completion=False)


@app.command(help=__doc__)
def main(
    mocap: Annotated[Path, Option(help="File of recorded motions.")],
    output: Annotated[Path, Option(help="JSON file to be written.")],
) -> None:
    """Simulate all cases, and write what fits their errors."""
    motions = Mocap.load(mocap)
    laws, frames, windows = list[NoiseLaw](), list[Columns](), list[Columns]()
    for case in CASES:
        scene, seed = scene_of(*case, motions), case[2]
        given = simulate(scene, seed=seed), scene.rig, FrameTimes.from_fps(FPS, len(scene))
        solved, people = solutions(*given, scene.cuts, temporal=False)
        laws.append(NoiseLaw.from_dict(people.run["noise_law"]))
        frames += (errors_in_frames(each, scene.keypoints) for each in solved)
        solved, _ = solutions(*given, scene.cuts, temporal=True)
        windows += (errors_over_time(each, scene.keypoints) for each in solved)
    new = [part for seed in range(NEW) for part in new_errors(seed)]
    columns = [np.concatenate(column) for column in zip(*frames, strict=True)]
    association = fitted(*columns)
    correlated = fitted_over_time(windows, new, association)
    content = {
        "about": f"scripts/fit_covariances.py: {len(columns[0])} joints of simulated people in "
        f"single frames, {sum(len(squared) for squared, *_ in windows)} over time",
        "noise": mean_law(laws),
        "association_uncertainty": asdict(association),
        "correlated_errors": asdict(correlated),
        "tails": tails_of([part for part, _ in widened(windows, correlated, association)]),
    }
    output.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


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


def scene_of(name: str, split: Split, seed: int, cameras: int, mocap: Mocap) -> Scene:
    """The people and cameras of a case."""
    if name == "two":
        return built_in_scene(seed, people=2, cameras=cameras, frames=FRAMES, fps=FPS)
    config = replace(SEQUENCES[name], seed=seed)
    whole = sequence(name, split, mocap, cameras=cameras, until=FRAMES, fps=FPS, config=config)
    return whole.part(range(FRAMES))


def solutions(
    detections: DetectionSequence,
    rig: Rig,
    times: FrameTimes,
    cuts: Sequence[int] = (),
    *,
    temporal: bool,
) -> tuple[list[Marginals], Reconstruction]:
    """The solved windows, or batches of single frames, and the result."""
    solved = list[Marginals]()
    with patch.object(
        body_solution,
        "covariance_factors",
        lambda each, noise: solved.append(each) or covariance_factors(each, noise),
    ):
        config = PipelineConfig(temporal=temporal)
        people = reconstruct(detections, rig, config, times=times, cuts=cuts)
    return solved, people


def squared_errors(marginals: Marginals, truth: np.ndarray) -> tuple[Matches, np.ndarray]:
    """Rows that are one of the true people (F, P, J, 3), and the squared Mahalanobis distances of
    their joints under the graph's covariance.
    """
    joints = marginals.window.joints(marginals.state)
    found = match_people(marginals.window.observations.frame, joints, truth)
    off = (joints[found.row] - truth[found.frame, found.person])[..., None]
    squared = off.mT @ np.linalg.solve(marginals.joints()[found.row], off)
    return found, squared[..., 0, 0]


def errors_in_frames(marginals: Marginals, truth: np.ndarray) -> Columns:
    """For joints that views see: squared distance, number of views, and the person's
    `association_features`.
    """
    found, squared = squared_errors(marginals, truth)
    views = marginals.window.last.evidence.inlier[found.row].sum(axis=-1)
    sigma_m, evidence, used = association_features(marginals)
    rejected = 1 - used / np.maximum(evidence, 1e-9)
    signs = (np.repeat(each[found.row, None], 25, 1) for each in (sigma_m, rejected))
    seen = views > 0
    return tuple(each[seen] for each in (squared, views, *signs))


def errors_over_time(marginals: Marginals, truth: np.ndarray) -> Columns:
    """For joints that views see: squared distances; for the window: share of rejected evidence, and
    `correlation_features`.
    """
    found, squared = squared_errors(marginals, truth)
    seen = marginals.window.last.evidence.inlier[found.row].any(axis=-1)
    _, evidence, used = association_features(marginals)
    rejected = 1 - used.sum() / max(evidence.sum(), 1e-9)
    return squared[seen], rejected, *map(np.array, correlation_features(marginals))


def new_errors(seed: int) -> Iterator[Columns]:
    """`errors_over_time` of a person who swings arm and leg, with detections whose errors are new
    in every frame.
    """
    rng = np.random.default_rng(seed)
    rig = ring_of_cameras(3 + seed % 3, rng)
    fps = (10, 30, 60)[seed % 3]
    truth = swinging(np.arange(3 * fps) / fps, rng.uniform(0.5, 3.0))
    times = FrameTimes.from_fps(fps, len(truth))
    for each in solutions(seen(rig, truth, rng), rig, times, temporal=True)[0]:
        yield errors_over_time(each, truth[:, None])


def fitted(
    squared: np.ndarray, views: np.ndarray, sigma_m: np.ndarray, rejected: np.ndarray
) -> AssociationUncertainty:
    """The parameters of least loss, scaled so that 95 % regions hold 95 % of the joints."""
    share = np.where(views > 1, SHARES[1] / (views > 1).sum(), SHARES[0] / (views == 1).sum())

    def loss(numbers: np.ndarray) -> float:
        model = AssociationUncertainty(np.exp(numbers[0]), numbers[1], REJECTED_POWER)
        factor = model.in_frames(sigma_m, rejected)
        return float((share * (limited(squared / factor) + 3 * np.log(factor))).sum())

    numbers = minimize(loss, (0.0, 1.0), method="Nelder-Mead").x
    power = float(numbers[1])
    off = squared / AssociationUncertainty(1.0, power, REJECTED_POWER).in_frames(sigma_m, rejected)
    order = np.argsort(off, kind="stable")
    at = np.searchsorted(np.cumsum(share[order]) / share.sum(), 0.95)
    scale = off[order][at] / chi2.ppf(0.95, 3)
    return AssociationUncertainty(round(float(scale), 2), round(power, 2), REJECTED_POWER)


def fitted_over_time(
    windows: list[Columns], new: list[Columns], association: AssociationUncertainty
) -> CorrelatedErrors:
    """The parameters of least loss over windows of recordings and of people with new errors, half
    each, scaled so that 95 % regions hold 95 % of the joints in recordings.
    """

    def loss(numbers: np.ndarray) -> float:
        total = 0.0
        for parts in (windows, new):
            each = widened(parts, CorrelatedErrors(*np.exp(numbers)), association)
            each = [(limited(part) + 3 * np.log(by)).sum() for part, by in each]
            total += sum(each) / sum(len(squared) for squared, *_ in parts)
        return total

    numbers = minimize(loss, (0.0, 0.0), method="Nelder-Mead").x
    best = CorrelatedErrors(*np.exp(numbers))
    every = np.concatenate([part for part, _ in widened(windows, best, association)])
    scale = np.quantile(every, 0.95) / chi2.ppf(0.95, 3)
    return CorrelatedErrors(*np.round(np.exp(numbers) * scale, 2).tolist())


def widened(
    parts: list[Columns], correlated: CorrelatedErrors, association: AssociationUncertainty
) -> Iterator[tuple[np.ndarray, float]]:
    """Squared distances by window, under the widened covariances, and the factor."""
    for squared, rejected, share, ratio in parts:
        factor = correlated.factor(share, ratio) * association.of_rejected(rejected)
        yield squared / factor, float(factor)


def tails_of(parts: list[np.ndarray]) -> float:
    """The degrees of freedom of Student's t with the covariances' 95 % region that is most probable
    for squared distances.
    """
    every = np.concatenate(parts)

    def loss(tails: float) -> float:  # a squared distance over its 3 dimensions has F
        scale = chi2.ppf(0.95, 3) / 3 / f.ppf(0.95, 3, tails)
        return -float(f.logpdf(every / 3, 3, tails, scale=scale).mean())

    return round(minimize_scalar(loss, bounds=(2.0, 100.0), method="bounded").x, 1)


def limited(squared: np.ndarray) -> np.ndarray:
    """Squared distances whose influence ends at `FAR`."""
    return np.where(squared > FAR, FAR * (1 + np.log(np.maximum(squared, FAR) / FAR)), squared)


if __name__ == "__main__":
    app()
