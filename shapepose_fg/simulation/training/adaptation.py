"""Weights of the learned fitter for any body: from nothing, or from those that ship; and how good they are."""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from shapepose_fg.body.fitting.descent import NUM_PARAMETERS, UpdateNetwork, gradient_scale
from shapepose_fg.body.fitting.fitter import BodyFitter, JointTargets
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.sizes import points_at_rest
from shapepose_fg.body.fitting.weights import FitterWeights, fingerprint
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.provenance import versions
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation.training.motions import (
    ACKNOWLEDGEMENT,
    TEST_SUBJECTS,
    VALIDATION_SUBJECTS,
    Motions,
)
from shapepose_fg.simulation.training.train import (
    PeopleSource,
    Trainer,
    TrainingConfig,
    Validation,
    calibrated,
)

_RIDGE_M = 0.005
"""What of a shape moves points by less than this says nothing of which shape it is in the other body."""
_BATCH = 64
"""People who are fitted at a time."""
_VALIDATION_PEOPLE, _CALIBRATION_PEOPLE = 2048, 4096
_SEEN = tuple(range(len(BODY_25)))


def trained(
    body: BodyModel,
    motions: Motions,
    validation: Motions,
    config: TrainingConfig,
    about: str,
    *,
    from_scratch: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> FitterWeights:
    """Weights for `body`, trained on `motions`, with covariances that hold on `validation`.

    They begin as the shipped ones, unless `from_scratch`. `about` says what the motions are, for the card;
    `progress` is told how many iterations of how many are done.
    """
    shipped = FitterWeights.default()
    still = replace(config, shake_rad=0.0, exchange=0.0)
    torch.manual_seed(config.seed)
    if from_scratch:
        network, frame = UpdateNetwork(config.network), PersonFrame.of(body, motions.poses, motions.weight)
        network.gradient_scale.copy_(gradient_scale(body.points, _SEEN))
    else:
        config = replace(config, network=shipped.network.config)
        network, frame = translated(shipped, BodyModel.default(), body, motions)
    # The network lives on a GPU where there is one, the bodies on the CPU.
    network.to("cuda" if torch.cuda.is_available() else "cpu")
    trainer = Trainer(PeopleSource(motions, body, frame, config), frame, network, config)
    for done, _ in enumerate(trainer.run(config.iterations), start=1):
        progress(done, config.iterations)
    network = trainer.averaged.requires_grad_(False).eval().cpu()
    unseen = PeopleSource(validation, body, frame, still)
    errors = Validation(unseen, frame, still, _VALIDATION_PEOPLE).errors_mm(network)
    card = {
        "data": f"{about}: {len(motions)} frames of {len(set(motions.subject.tolist()))} subjects for training",
        "not seen": f"subjects {' '.join(VALIDATION_SUBJECTS)} (validation), {' '.join(TEST_SUBJECTS)} (test)",
        "begun from": "nothing" if from_scratch else "the shipped weights",
        "training": f"{config.iterations} iterations of {config.batch} people, seed {config.seed}",
        "validation": "mean joint error after each step, mm: " + ", ".join(f"{error:.1f}" for error in errors),
        "acknowledgement": ACKNOWLEDGEMENT,
        "made with": json.dumps(versions()),
    }
    weights = FitterWeights(network, frame, fingerprint(body), shipped.spread, card)
    return calibrated(weights, unseen, body, _CALIBRATION_PEOPLE)


def translated(
    weights: FitterWeights, trained_on: BodyModel, body: BodyModel, motions: Motions
) -> tuple[UpdateNetwork, PersonFrame]:
    """Network and frame of `weights` for `body`: shapes are those of `trained_on` in other words, all else stays.

    With betas c = M b of the body that it knows, the same person has b = N c: by least squares of all points. So
    it is told M b and the gradient Nᵀ dE/db, and steps by N times what it says.
    """
    network = UpdateNetwork(weights.network.config)
    network.load_state_dict(weights.network.state_dict())
    if fingerprint(body) == weights.body:
        return network, weights.frame
    (_, old), (_, new) = points_at_rest(trained_on), points_at_rest(body)
    M, N = _solved(old, new), _solved(new, old)
    before, after = weights.network.gradient_scale[:10], gradient_scale(body.points, _SEEN)
    betas = slice(7 * len(BODY_POINTS), 7 * len(BODY_POINTS) + 10)
    gradient = slice(betas.start + NUM_PARAMETERS, betas.stop + NUM_PARAMETERS)
    with torch.no_grad():
        network.gradient_scale.copy_(after)
        enter, leave = network.enter.weight, network.leave
        enter[:, betas] = enter[:, betas] @ M
        enter[:, gradient] = (enter[:, gradient] * before) @ N.T / after[:10]
        leave.weight[:10], leave.bias[:10] = N @ leave.weight[:10], N @ leave.bias[:10]
    return network, PersonFrame.of(body, motions.poses, motions.weight)


def _solved(by: Array, wanted: Array) -> Tensor:
    """X (10, 10) with `by` X next to `wanted`."""
    return torch.from_numpy(np.linalg.solve(by.T @ by + _RIDGE_M**2 * np.eye(10), by.T @ wanted)).float()


@dataclass(frozen=True)
class Score:
    """How a fitter does on bodies that it has not seen."""

    joints_mm: float
    """Mean error of all joints."""
    missing_mm: float
    """The same of joints without a target; NaN where there are none."""
    ms: float
    """Processor time of a fit, leave-one-out passes included."""


def compared(
    fitters: Mapping[str, BodyFitter], source: PeopleSource, sigma_m: float, missing: float, count: int = 256
) -> dict[str, Score]:
    """Scores of `fitters` on the same `count` people: noise of `sigma_m`, a share of the joints `missing`.

    Rows that some fitter does not finish count for none.
    """
    generator = torch.Generator().manual_seed(3)
    truth = source.draw(count, generator).points[:, list(_SEEN)].double().numpy()
    rng = np.random.default_rng(3)
    targets = truth + rng.normal(0, sigma_m, truth.shape)
    gone = rng.random(truth.shape[:2]) < missing
    information = np.where(gone[..., None, None], 0.0, np.eye(3) / sigma_m**2)
    error, spent = dict[str, np.ndarray](), dict[str, float]()
    for name, fitter in fitters.items():
        begin, found = time.process_time(), []
        for at in range(0, count, _BATCH):
            part = slice(at, at + _BATCH)
            found.append(fitter.fit(JointTargets(targets[part], information[part])).joints)
        spent[name] = 1000 * (time.process_time() - begin) / count
        error[name] = 1000 * np.linalg.norm(np.concatenate(found) - truth, axis=-1)
    done = np.all([np.isfinite(each).all(axis=1) for each in error.values()], axis=0)
    hidden = gone & done[:, None]
    return {
        name: Score(each[done].mean(), each[hidden].mean() if hidden.any() else np.nan, spent[name])
        for name, each in error.items()
    }
