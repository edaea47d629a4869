"""Fit the parameters of joint covariances (`estimation/covariance_calibration.py`) to the errors in
simulated recordings.

    python scripts/fit_covariances.py --mocap cmu_smpl24.npz --output calibration.json

Crowds, crossings and pairs with two to six cameras, 4 s each; half an hour on one core. The mean
log score of the true joint under its Gaussian is maximised. Joints seen by two or more views, by
one and by none have fixed shares in it, and errors beyond `FAR` have little influence, so that
outliers without any feature that predicts them do not widen all covariances. Finally, all
covariances are scaled so that 95 % regions have nominal coverage for people of every association
uncertainty: the errors have heavier tails than a Gaussian, the more so the more uncertain a person
is. The detector's noise law that ships (`estimation/noise_law.py`) is the mean of what is
learnt from these recordings.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch

from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.covariance_calibration import WEIGHTS, Calibration, CovarianceFeatures
from shapepose_fg.estimation.noise_law import NoiseLaw
from shapepose_fg.evaluation.metrics import match_people
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import SEQUENCES, Split, sequence

CASES: tuple[tuple[str, Split, int, int], ...] = (
    ("crowd", "tune", 7001, 3), ("crossing", "tune", 7002, 3), ("crowd", "tune", 7003, 4),
    ("crossing", "tune", 7004, 4), ("two", "tune", 7005, 2), ("crowd", "tune", 7006, 3),
    ("crossing", "tune", 7007, 3), ("two", "tune", 7008, 2), ("crowd", "tune", 7009, 6),
    ("crossing", "report", 5001, 3), ("crowd", "report", 4711, 4), ("crowd", "report", 778, 3),
    ("two", "tune", 777, 2), ("crowd", "report", 90211, 3), ("crossing", "report", 5002, 3),
    ("crowd", "report", 777, 4), ("crossing", "tune", 7011, 2), ("crowd", "tune", 7012, 2),
    ("salsa", "tune", 7013, 2), ("crossing", "tune", 7014, 2),
)  # fmt: skip
"""Scene, split, seed, number of cameras. Seeds of `report` are those used during development; they
are needed because exchanged limbs are rare, and long ones did not occur with the seeds of
`tune`."""
FRAMES, FPS = 120, 30.0
FAR = 30.0
"""Squared Mahalanobis distance beyond which the loss grows only logarithmically."""
ROUND = 0.05
"""Width over which the kink of the quantile loss is smoothed."""
ALIKE = ("Nose Eye Ear", "Neck", "Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle", "Toe Heel")
"""Groups of joints with a common scale."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mocap", type=Path, required=True, help="file of recorded motions")
    parser.add_argument("--output", type=Path, required=True, help="JSON file to be written")
    arguments = parser.parse_args()
    mocap = Mocap.load(arguments.mocap)
    laws = list[NoiseLaw]()
    found = [pair for case in CASES for pair in errors(*case, mocap, laws)]
    content = fitted(found) | {"noise": mean_law(laws)}
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
) -> Iterator[tuple[CovarianceFeatures, np.ndarray]]:
    """For each window of a recording, the features of its joints, and their errors (N, J, 3),
    metres; NaN for false positives. Its noise law is appended to `laws`.
    """
    if name == "two":
        scene = built_in_scene(seed, people=2, cameras=cameras, frames=FRAMES, fps=FPS)
    else:
        config = replace(SEQUENCES[name], seed=seed)
        whole = sequence(name, split, mocap, cameras=cameras, until=FRAMES, fps=FPS, config=config)
        scene = whole.part(range(FRAMES))
    detections, seen = simulate(scene, seed=seed), []
    truly = Calibration.covariance
    with patch.object(
        Calibration, "covariance", lambda self, clues: seen.append(clues) or truly(self, clues)
    ):
        times = FrameTimes.from_fps(FPS, len(detections))
        people = reconstruct(detections, scene.rig, times=times, cuts=scene.cuts)
    laws.append(NoiseLaw.from_dict(people.run["noise_law"]))
    for clues in seen:
        found, true = (
            match_people(clues.frame, clues.joints, scene.keypoints),
            np.full(clues.joints.shape, np.nan),
        )
        true[found.row] = scene.keypoints[found.frame, found.person]
        yield clues, clues.joints - true


def fitted(found: list[tuple[CovarianceFeatures, np.ndarray]]) -> dict:
    """The fitted parameters, as the content of the output file."""
    names = BODY_25.joints
    group = np.array(
        [
            next(n for n, each in enumerate(ALIKE) if name.endswith(tuple(each.split())))
            for name in names
        ]
    )
    parts = []
    for clues, off in found:
        known = np.isfinite(off).all(-1) & np.isfinite(clues.covariance).all((-1, -2))
        added = (clues.association, clues.draft, clues.exchange)
        features = np.stack([np.log1p(clues.disagreement), np.log(clues.carried)], axis=-1)
        groups = np.broadcast_to(group, known.shape)
        person = np.broadcast_to(clues.person, known.shape)
        columns = (off, clues.covariance, features, groups, clues.views, person, *added)
        parts.append([column[known] for column in columns])
    off, covariance, features, which, views, person, *added = (
        torch.from_numpy(np.concatenate(column)) for column in zip(*parts, strict=True)
    )
    views, added = views.clamp(max=2), torch.stack(added)
    # Shares in the log score of joints that are seen by no view, by one view, and by two or
    # more.
    share = torch.tensor((0.5, 0.7, 1.0), dtype=off.dtype) / torch.bincount(
        views, minlength=3
    ).clamp(min=1)
    log_scale, powers, log_added = (
        torch.full((count,), value, dtype=off.dtype, requires_grad=True)
        for count, value in ((len(ALIKE), -0.5), (2, 0.5), (3, 0.0))
    )
    optimiser = torch.optim.LBFGS(
        [log_scale, powers, log_added], max_iter=100, line_search_fn="strong_wolfe"
    )

    def squares() -> tuple[torch.Tensor, torch.Tensor]:
        C = torch.exp(log_scale[which] + features @ powers)[:, None, None] * covariance
        root = torch.linalg.cholesky(C + (torch.exp(log_added)[:, None, None, None] * added).sum(0))
        return root, (torch.linalg.solve_triangular(root, off[..., None], upper=False) ** 2).sum(
            (-1, -2)
        )

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        root, squared = squares()
        squared = torch.where(
            squared > FAR, FAR * (1 + torch.log(squared.clamp(min=FAR) / FAR)), squared
        )
        lost = squared / 2 + torch.log(torch.diagonal(root, dim1=-2, dim2=-1)).sum(-1)
        total = (share[views] * lost).sum()
        total.backward()
        return total

    optimiser.step(loss)
    # Quantile regression: ratio of the 95 % quantile of squared distances to that of a Gaussian, as
    # a function of the uncertainty of a person.
    # 95 % quantile of chi-squared with 3 degrees of freedom (squared Mahalanobis distance).
    squared, wider = (
        torch.log(squares()[1].detach() / 7.815),
        torch.zeros(2, dtype=off.dtype, requires_grad=True),
    )
    optimiser = torch.optim.LBFGS([wider], max_iter=100, line_search_fn="strong_wolfe")

    def outside() -> torch.Tensor:
        optimiser.zero_grad()
        over = squared - wider[0] - wider[1] * person
        lost = 0.95 * over + ROUND * torch.nn.functional.softplus(-over / ROUND)
        total = (share[views] * lost).sum()
        total.backward()
        return total

    optimiser.step(outside)
    log_times, of_person = wider.tolist()
    times = np.exp(log_times)
    scale = (times * torch.exp(log_scale)).tolist()
    weights = (*powers.tolist(), *(times * torch.exp(log_added)).tolist(), of_person)
    return {
        "about": (
            f"scripts/fit_covariances.py: {len(off)} joints of simulated people, cases {CASES}"
        ),
        "scale": {name: round(scale[n], 3) for name, n in zip(names, group.tolist(), strict=True)},
        **{name: round(value, 3) for name, value in zip(WEIGHTS, weights, strict=True)},
    }


if __name__ == "__main__":
    main()
