"""Adapts the learned fitter to another body: converts the package's network to that body's shapes,
and trains it.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from shapepose_fg.body.fitting.descent import gradient_scale
from shapepose_fg.body.fitting.fitters import SmplFitter
from shapepose_fg.body.fitting.network import NUM_PARAMETERS
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.sizes import points_at_rest
from shapepose_fg.body.fitting.weights import FitterWeights, fingerprint
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.provenance import versions
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation.training.differentiable import TrainedNetwork
from shapepose_fg.simulation.training.motions import Motions
from shapepose_fg.simulation.training.train import (
    FitterScore,
    PeopleSource,
    Trainer,
    TrainingConfig,
    calibrated,
    compared,
)

TRAINED, PLAIN = "trained", "plain optimiser"
_SEEN = tuple(range(len(BODY_25)))


def adapted(
    body: BodyModel,
    motions: Motions,
    unseen: Motions,
    config: TrainingConfig,
    card: Mapping[str, str],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[FitterWeights, dict[str, FitterScore]]:
    """Train the package's weights on `motions` for `body`; also returns scores of these and of the
    plain optimiser on `unseen` motions.

    Covariances are calibrated on `unseen`. `card` describes the motions; `progress` is called with
    the number of finished iterations and of all.
    """
    shipped, frame = FitterWeights.default(), PersonFrame.of(body, motions.poses, motions.weight)
    # Learning rate relative to training from scratch, since only small changes are needed.
    rate = 0.2 * config.learning_rate
    config = replace(config, network=shipped.network.config, learning_rate=rate)
    torch.manual_seed(config.seed)
    # The network is on a GPU if available, the bodies on the CPU.
    network = translated(shipped, BodyModel.default(), body).to(
        "cuda" if torch.cuda.is_available() else "cpu"
    )
    trainer = Trainer(PeopleSource(motions, body, frame, config), frame, network, config)
    for done, _ in enumerate(trainer.run(config.iterations), start=1):
        progress(done, config.iterations)
    network = trainer.averaged.finished()
    source = PeopleSource(unseen, body, frame, replace(config, shake_rad=0.0, exchange=0.0))
    weights = FitterWeights(network, frame, fingerprint(body), shipped.spread)
    weights = calibrated(weights, source)
    scores = compared({TRAINED: SmplFitter(body, weights=weights), PLAIN: SmplFitter(body)}, source)
    about = {
        "training": (
            f"the shipped weights, {config.iterations} batches of {config.batch}, seed "
            f"{config.seed}"
        ),
        "validation": ", ".join(
            f"{name} {score.joints_mm:.1f} mm" for name, score in scores.items()
        ),
        "made with": json.dumps(versions()),
    }
    return replace(weights, card={**card, **about}), scores


def translated(weights: FitterWeights, trained_on: BodyModel, body: BodyModel) -> TrainedNetwork:
    """The network of `weights` for `body`: shapes are converted from those of `trained_on`, all
    else is kept.

    The same person has betas c = M b in the body that the network knows, and b = N c, by least
    squares over all points. So its input is M b and the gradient Nᵀ dE/db, and its step in b is N
    times its output.
    """
    network = TrainedNetwork.of(weights.network)
    if fingerprint(body) == weights.body:
        return network
    (_, old), (_, new) = points_at_rest(trained_on), points_at_rest(body)
    M, N = _solved(old, new), _solved(new, old)
    before = torch.from_numpy(weights.network.gradient_scale[:10])
    after = torch.from_numpy(gradient_scale(body.points, _SEEN)).float()
    betas = slice(7 * len(BODY_POINTS), 7 * len(BODY_POINTS) + 10)
    gradient = slice(betas.start + NUM_PARAMETERS, betas.stop + NUM_PARAMETERS)
    with torch.no_grad():
        network.gradient_scale.copy_(after)
        enter, leave = network.enter.weight, network.leave
        enter[:, betas] = enter[:, betas] @ M
        enter[:, gradient] = (enter[:, gradient] * before) @ N.T / after[:10]
        leave.weight[:10], leave.bias[:10] = N @ leave.weight[:10], N @ leave.bias[:10]
    return network


def _solved(by: Array, wanted: Array) -> Tensor:
    """Least-squares X (10, 10) with `by` X close to `wanted`."""
    # Displacement of points by a shape component, m, below which it is ignored in the other
    # body.
    return torch.from_numpy(
        np.linalg.solve(by.T @ by + 0.005**2 * np.eye(10), by.T @ wanted)
    ).float()
