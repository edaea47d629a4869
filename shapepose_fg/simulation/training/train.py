"""Training of the update network: samples people, corrupts joints, unrolls updates; calibration and
scores.
"""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.stats import chi2
from torch import Tensor

from shapepose_fg.body.fitting.descent import NetworkInputs
from shapepose_fg.body.fitting.fitter import BodyFitter, JointTargets
from shapepose_fg.body.fitting.fitters import SmplFitter
from shapepose_fg.body.fitting.network import NUM_ROTATIONS, NetworkConfig
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.weights import FitterWeights
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.rotation import exp_so3
from shapepose_fg.body.model.target_skeletons import BODY_POINTS, MIRROR, TARGET_SKELETONS, slots
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.simulation.training.corruption import CorruptionConfig, corrupt
from shapepose_fg.simulation.training.differentiable import (
    DescentTargets,
    State,
    TrainedNetwork,
    inverse_3x3,
    positions,
    unroll,
)
from shapepose_fg.simulation.training.motions import MIRROR_JOINTS, Motions

INSIDE = 0.9
"""Probability of the ellipsoids of the stated prior covariance for which the share of joints inside
is calibrated."""
_SKELETONS = ("SMPL_24", "HALPE_26", "BODY_25")
"""Skeletons for calibration; for a shared point the last one counts."""

_ALL = tuple(range(len(BODY_POINTS)))


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of training."""

    iterations: int = 18_000
    """Number of batches."""
    batch: int = 256
    """Number of people per batch."""
    learning_rate: float = 1.5e-3
    """Maximum learning rate, after a twentieth of the iterations; it decays to zero by a cosine."""
    weight_decay: float = 0.02
    """Weight decay of AdamW."""
    averaging: float = 0.999
    """Decay of the exponential moving average of the weights over iterations; the averaged weights
    are the result."""
    model_sigma_m: float = 0.02
    """Standard deviation added to every target, m, as in the fitter."""
    kernel_scale: float = 6.0
    """Width of the robust kernel of the energy that gives the network's gradient, in standard
    deviations."""
    shake_rad: float = 0.05
    """Standard deviation of noise on recorded angles, rad; bodies and recordings are inexact."""
    exchange: float = 0.15
    """Share of people with an arm or a leg from another person."""
    skeletons: tuple[float, ...] = (0.55, 0.15, 0.15, 0.15)
    """Shares of BODY_25, COCO_17, HALPE_26, SMPL_24."""
    rotation_m: float = 0.05
    """Weight of rotation errors in the loss, metres of a joint per radian."""
    shape_m: float = 0.01
    """Weight of beta errors in the loss, metres of a joint per standard deviation."""
    corruption: CorruptionConfig = field(default_factory=CorruptionConfig)
    """Settings of the corruption of targets."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Size of the network."""
    seed: int = 0
    """Seed of all random values."""


@dataclass(frozen=True)
class TrainingBodies:
    """True bodies, upright, without a camera: pelvis at the origin, any heading."""

    state: State
    """Shape and pose."""
    points: Tensor
    """(B, K, 3) all `BODY_POINTS`, metres."""


class PeopleSource:
    """Samples bodies: shapes from the model's own distribution, poses from recordings."""

    def __init__(
        self, motions: Motions, model: BodyModel, frame: PersonFrame, config: TrainingConfig
    ):
        self.config, self.model, self._frame = config, model, frame
        self._poses = torch.from_numpy(motions.poses)
        self._weight = torch.from_numpy(motions.weight).double().cumsum(0)
        self._mirror = torch.tensor(MIRROR_JOINTS)

    def draw(self, count: int, generator: torch.Generator) -> TrainingBodies:
        """Sample `count` people."""
        pose = self._pose(count, generator)
        other = self._pose(count, generator)
        exchanged = torch.rand(count, generator=generator) < self.config.exchange
        part = (
            _CHAINS[torch.randint(len(_CHAINS), (count,), generator=generator)] & exchanged[:, None]
        )
        pose = torch.where(part[..., None], other, pose)
        shake = self.config.shake_rad * torch.randn(count, 24, 3, generator=generator)
        shake[:, 0] = 0
        betas = torch.randn(count, 10, generator=generator).clamp(-3, 3)
        local = _tensor(exp_so3(pose.numpy()) @ exp_so3(shake.numpy()))
        state = State(betas, local, _tensor(self._frame.transl).expand(count, 3))
        return TrainingBodies(state, positions(self.model.points, state))

    def _pose(self, count: int, generator: torch.Generator) -> Tensor:
        """(count, 24, 3) axis-angle poses, half of them mirrored."""
        at = torch.rand(count, generator=generator, dtype=torch.float64) * self._weight[-1]
        pose = self._poses[torch.searchsorted(self._weight, at).clamp_max(len(self._poses) - 1)]
        flipped = pose[:, self._mirror] * torch.tensor([1.0, -1.0, -1.0])
        return torch.where(torch.rand(count, 1, 1, generator=generator) < 0.5, pose, flipped)


def _tensor(values: Array) -> Tensor:
    """A tensor in single precision, as used in training."""
    return torch.from_numpy(values).float()


_CHAINS = torch.tensor(
    [
        [name.startswith(side) and name.endswith(chain) for name in SMPL_24]
        for chain in (("collar", "shoulder", "elbow", "wrist"), ("hip", "knee", "ankle", "foot"))
        for side in ("left", "right")
    ]
)
"""(4, 24) arms and legs."""


class Trainer:
    """One run of training."""

    def __init__(
        self,
        source: PeopleSource,
        frame: PersonFrame,
        network: TrainedNetwork,
        config: TrainingConfig,
    ):
        self.source, self.frame, self.config = source, frame, config
        self.network = network
        self.averaged = TrainedNetwork(config.network).to(network.gradient_scale.device)
        self.averaged.load_state_dict(network.state_dict())
        self.optimiser = torch.optim.AdamW(
            network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        self.iteration = 0

    def run(self, iterations: int) -> Iterator[list[float]]:
        """Run some `iterations`; yields the mean joint error of every update in mm."""
        for _ in range(iterations):
            yield self._iterate()

    def _iterate(self) -> list[float]:
        config = self.config
        # All random values depend on seed and iteration.
        generator = torch.Generator().manual_seed(config.seed * 10_000_019 + self.iteration)
        torch.manual_seed(config.seed * 10_000_019 + self.iteration)  # dropout
        for group in self.optimiser.param_groups:
            group["lr"] = _learning_rate(config, self.iteration)
        people = self.source.draw(config.batch, generator)
        targets, state, truth, true_points = prepared(people, self.frame, config, generator)
        self.network.train()
        see = NetworkInputs(self.source.model.points, _ALL, config.kernel_scale)
        self.optimiser.zero_grad()
        errors = []
        for iterate in unroll(see, self.network, state, targets):
            error, loss = _judge(self.source.model, iterate, truth, true_points, config)
            loss.backward()
            errors.append(1000 * float(error))
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.iteration += 1
        self._average()
        return errors

    @torch.no_grad()
    def _average(self) -> None:
        share = min(self.config.averaging, 1 - 1 / (self.iteration + 1))
        for mean, new in zip(self.averaged.parameters(), self.network.parameters(), strict=True):
            mean.lerp_(new, 1 - share)


def _learning_rate(config: TrainingConfig, iteration: int) -> float:
    done = iteration / config.iterations
    warm = (
        min(1.0, done / 0.05)
        if done < 0.05
        else 0.5 * (1 + float(torch.cos(torch.tensor(torch.pi * done))))
    )
    return config.learning_rate * max(warm, 1e-4)


@torch.no_grad()
def prepared(
    people: TrainingBodies, frame: PersonFrame, config: TrainingConfig, generator: torch.Generator
) -> tuple[DescentTargets, State, State, Tensor]:
    """Corrupted targets, initial state, true state and true points, all in the person's estimated
    frame.
    """
    B = len(people.points)
    offered = _OFFERED[
        torch.multinomial(torch.tensor(config.skeletons), B, True, generator=generator)
    ]
    xyz, information = corrupt(people.points, offered, generator, config.corruption)
    information = information @ inverse_3x3(torch.eye(3) + config.model_sigma_m**2 * information)
    xyz = torch.where((information != 0).any(-1).any(-1)[..., None], xyz, 0.0)
    variance = mean_variance(information)
    enough = torch.isfinite(variance).sum(1) >= 4
    xyz, information, variance, points = (
        value[enough] for value in (xyz, information, variance, people.points)
    )
    local, betas = people.state.local[enough], people.state.betas[enough]
    placed = frame.place(xyz.double().numpy(), variance.double().numpy(), _ALL)
    rotation, origin = map(_tensor, placed)
    inside = lambda places: (places - origin[:, None]) @ rotation  # noqa: E731
    turned = rotation.mT[:, None] @ information @ rotation[:, None]
    true_local = torch.cat((rotation.mT[:, None] @ local[:, :1], local[:, 1:]), 1)
    truth = State(betas, true_local, torch.zeros(len(xyz), 3))
    local, transl = (
        _tensor(frame.local).expand(len(xyz), 24, 3, 3),
        _tensor(frame.transl).expand(len(xyz), 3),
    )
    start = State(torch.zeros(len(xyz), 10), local, transl)
    return DescentTargets(inside(xyz), turned), start, truth, inside(points)


def mean_variance(information: Tensor) -> Tensor:
    """(B, K) mean variance over the axes, m²; infinite above `_SEEN_M` squared, e.g. for a ray."""
    variance = torch.diagonal(inverse_3x3(information + 0.1 * torch.eye(3)), dim1=-2, dim2=-1).mean(
        -1
    )
    return torch.where(variance < _SEEN_M**2, variance, torch.inf)


_SEEN_M = 0.2
"""Standard deviation, m, above which joints are ignored for a person's position."""
_OFFERED = torch.zeros(len(TARGET_SKELETONS), len(BODY_POINTS))
for _row, _names in enumerate(TARGET_SKELETONS.values()):
    _OFFERED[_row, list(slots(_names))] = 1


def _judge(
    model: BodyModel, state: State, truth: State, true_points: Tensor, config: TrainingConfig
) -> tuple[Tensor, Tensor]:
    """Mean joint error in metres, and the loss: joints, rotations, shape."""
    distance = torch.linalg.vector_norm(positions(model.points, state) - true_points, dim=-1)
    turn = (state.local[:, :NUM_ROTATIONS] - truth.local[:, :NUM_ROTATIONS]).square().sum((-1, -2))
    turn = (turn / 2 + 1e-4).sqrt().mean()
    shape = (state.betas - truth.betas).abs().mean()
    error = distance.mean()
    return error.detach(), error + config.rotation_m * turn + config.shape_m * shape


def calibrated(weights: FitterWeights, source: PeopleSource, count: int = 4096) -> FitterWeights:
    """Return the weights with `spread` measured on `count` people of `source` for each skeleton.

    The stated covariance of joints without a target is scaled so that regions of probability
    `INSIDE` contain this share of them. Left and right are pooled.
    """
    plain = replace(weights, spread=np.ones(len(BODY_POINTS)))
    spread = np.ones(len(BODY_POINTS))
    generator = torch.Generator().manual_seed(2)
    for name in _SKELETONS:
        places = slots(TARGET_SKELETONS[name])
        squared = left_out_squared(plain, source, places, count, generator)
        for place in places:
            both = np.concatenate(
                [squared.get(place, np.zeros(0)), squared.get(MIRROR[place], np.zeros(0))]
            )
            # Minimum number of joints for a calibration.
            if len(both) >= 50:
                spread[place] = np.quantile(both, INSIDE) / chi2.ppf(INSIDE, 3)
    return replace(weights, spread=spread)


def left_out_squared(
    weights: FitterWeights,
    source: PeopleSource,
    places: tuple[int, ...],
    count: int,
    generator: torch.Generator,
) -> dict[int, Array]:
    """Squared Mahalanobis distances of true joints from predictions without their
    target, by point.
    """
    model = source.model.with_keypoints(tuple(BODY_POINTS[place] for place in places))
    fitter = SmplFitter(model, weights=weights)
    truth, targets = _corrupted(source, places, count, generator)
    rows, found = np.arange(count), dict[int, list[Array]]()
    for first in range(0, len(places), 5):  # each person lacks one joint, which is predicted
        joint, information = (rows + first) % len(places), targets.information.copy()
        information[rows, joint] = 0.0
        fit = fitter.fit(JointTargets(targets.xyz, information))
        error, covariance = (fit.joints - truth)[rows, joint], fit.covariance[rows, joint]
        squared = (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(axis=-1)
        for row, place in enumerate(places):
            found.setdefault(place, []).append(squared[(joint == row) & fit.ok])
    return {place: np.concatenate(parts) for place, parts in found.items()}


def _corrupted(
    source: PeopleSource, places: tuple[int, ...], count: int, generator: torch.Generator
) -> tuple[Array, JointTargets]:
    """True joints (count, J, 3) at `places` in `BODY_POINTS`, and their targets from `corrupt`."""
    points, chosen = source.draw(count, generator).points, list(places)
    target, information = corrupt(points, torch.ones(count, len(BODY_POINTS)), generator)
    truth, *given = (values[:, chosen].double().numpy() for values in (points, target, information))
    return truth, JointTargets(*given)


@dataclass(frozen=True)
class FitterScore:
    """Scores of a fitter."""

    joints_mm: float
    """Mean error of all joints, with or without a target, mm."""
    ms: float
    """Processor time of a fit, ms."""


def compared(
    fitters: Mapping[str, BodyFitter], source: PeopleSource, count: int = 512
) -> dict[str, FitterScore]:
    """Scores of `fitters` for BODY_25's joints on the same people, over the rows that all of them
    fit.
    """
    places = slots(TARGET_SKELETONS["BODY_25"])
    truth, targets = _corrupted(source, places, count, torch.Generator().manual_seed(3))
    error, spent = dict[str, Array](), dict[str, float]()
    for name, fitter in fitters.items():
        begin = time.process_time()
        error[name] = 1000 * np.linalg.norm(fitter.fit(targets).joints - truth, axis=-1).mean(
            axis=1
        )
        spent[name] = 1000 * (time.process_time() - begin) / count
    done = np.isfinite(list(error.values())).all(axis=0)
    return {
        name: FitterScore(float(each[done].mean()), spent[name]) for name, each in error.items()
    }
