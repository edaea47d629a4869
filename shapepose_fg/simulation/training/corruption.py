"""Corrupts true joints like a detector with triangulation, to make training targets for a fitter.

Half of the people are seen by a few virtual cameras: each view hides some joints, misses some, and
reports the others with a confidence and an error drawn from the simulator's tables; the rays are
triangulated with the pipeline's weights. Errors are therefore larger in depth than across the view,
a joint may be known only along a ray, and some of the given covariances are wrong. The rest have
isotropic noise. Then whole limbs, sides and halves are removed, joints become outliers, and sides
are swapped.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from shapepose_fg.body.model.target_skeletons import BODY_POINTS, MIRROR
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation.detector_statistics import JOINT_GROUP, DetectorStatistics, measured
from shapepose_fg.simulation.training.differentiable import inverse_3x3

_NEAREST = {
    "Head": "Nose", "pelvis": "MidHip", "spine1": "MidHip", "spine2": "MidHip", "spine3": "Neck",
    "neck": "Neck", "head": "Nose", "collar": "Neck", "hip": "LHip", "knee": "LKnee",
    "ankle": "LAnkle", "foot": "LBigToe", "shoulder": "LShoulder", "elbow": "LElbow",
    "wrist": "LWrist", "hand": "LWrist",
}  # fmt: skip
"""Joint with statistics that is used for points without their own."""
_GROUP = torch.tensor(
    [
        int(
            JOINT_GROUP[
                BODY_25.index(name if name in BODY_25.joints else _NEAREST[name.split("_")[-1]])
            ]
        )
        for name in BODY_POINTS
    ]
)
"""(K,) row of each point in the statistics' tables."""


def _named(*parts: str) -> Tensor:
    """(K,) 1 for the points with one of `parts` in their name."""
    return torch.tensor([float(any(part in name for part in parts)) for name in BODY_POINTS])


_LEFT = torch.tensor([float(name.startswith(("L", "left"))) for name in BODY_POINTS])
_RIGHT = torch.tensor([float(name.startswith(("R", "right"))) for name in BODY_POINTS])
_FOOT = _named("Toe", "Heel", "foot")
_SHIN = _FOOT + _named("Ankle", "ankle")
_LEG = _SHIN + _named("Knee", "knee", "LHip", "RHip", "left_hip", "right_hip")
_HAND = _named("Wrist", "wrist", "left_hand", "right_hand")
_ARM = _HAND + _named("Elbow", "elbow", "Shoulder", "shoulder")
_FACE = _named("Nose", "Eye", "Ear", "Head") + torch.tensor(
    [float(name == "head") for name in BODY_POINTS]
)
_FOREARM = _ARM - _named("Shoulder", "shoulder")
_LIMBS = torch.stack(
    [part * side for part in (_ARM, _LEG, _SHIN, _FOREARM) for side in (_LEFT, _RIGHT)]
)
"""(8, K) masks of arms and legs, complete and without their first joint."""
_REGIONS = torch.stack([_LEFT, _RIGHT, _LEG, _ARM, _FACE, 1 - _LEG])
"""(6, K) masks: one side, everything below the hips, both arms, the head, everything
but the legs."""
_SWAPPED = torch.stack([_LEG, _SHIN, _ARM, _HAND, _LEG + _ARM])
_MIRROR = torch.tensor(MIRROR)


@dataclass(frozen=True)
class CorruptionConfig:
    """Probabilities of corruptions, per person unless stated otherwise."""

    triangulated: float = 0.5
    """Share of people with targets from virtual cameras; the others have isotropic noise."""
    clean: float = 0.3
    """Share of noise-free people among those with isotropic noise."""
    limb: float = 0.45
    """Probability that a limb is missing; two limbs with its square."""
    region: float = 0.08
    """Probability that a side, a half or the head is missing."""
    single: float = 0.5
    """Maximum share of joints that are missing individually."""
    complete: float = 0.25
    """Probability that no joint is removed."""
    outlier: float = 0.012
    """Share of joints with an error of 25 cm (sigma per axis) despite the stated information of a
    good joint."""
    swap: float = 0.04
    """Probability of a left-right swap of a limb."""


def corrupt(
    xyz: Tensor, offered: Tensor, generator: torch.Generator, config: CorruptionConfig | None = None
) -> tuple[Tensor, Tensor]:
    """Targets (B, K, 3), metres, and their information (B, K, 3, 3), 1/m², from true points `xyz`
    (B, K, 3).

    `offered` (B, K) is 1 for the points of each person's skeleton. y is up.
    """
    config = CorruptionConfig() if config is None else config
    draw = _Draw(generator)
    seen_xyz, seen_information = triangulated(xyz, draw, measured())
    noisy_xyz, noisy_information = _isotropic(xyz, draw, config.clean)
    by_views = draw.uniform(len(xyz), 1) < config.triangulated
    target = torch.where(by_views[..., None], seen_xyz, noisy_xyz)
    information = torch.where(by_views[..., None, None], seen_information, noisy_information)
    jump = draw.uniform(*xyz.shape[:2], 1) < config.outlier
    target = target + 0.25 * jump * draw.normal(*xyz.shape)
    swapped = (draw.uniform(len(xyz), 1) < config.swap) * _SWAPPED[
        draw.integers(len(_SWAPPED), len(xyz))
    ] > 0
    target = torch.where(swapped[..., None], target[:, _MIRROR], target)
    information = torch.where(swapped[..., None, None], information[:, _MIRROR], information)
    return target, information * (_kept(xyz, draw, config) * offered)[..., None, None]


class _Draw:
    """Random tensors from one generator."""

    def __init__(self, generator: torch.Generator):
        self.generator = generator

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator)

    def integers(self, high: int, *shape: int) -> Tensor:
        return torch.randint(high, shape, generator=self.generator)


def _kept(xyz: Tensor, draw: _Draw, config: CorruptionConfig) -> Tensor:
    """(B, K) 0 for missing joints, 1 for the others."""
    B, K = xyz.shape[:2]
    missing = (draw.uniform(B, K) < config.single * draw.uniform(B, 1)).float()
    for _ in range(2):
        limb = _LIMBS[draw.integers(len(_LIMBS), B)]
        missing = torch.maximum(missing, (draw.uniform(B, 1) < config.limb) * limb)
    missing = torch.maximum(
        missing, (draw.uniform(B, 1) < config.region) * _REGIONS[draw.integers(len(_REGIONS), B)]
    )
    return 1 - missing * (draw.uniform(B, 1) >= config.complete)


def _isotropic(xyz: Tensor, draw: _Draw, clean: float) -> tuple[Tensor, Tensor]:
    """Targets with isotropic noise, 2 to 40 mm before a variation per joint, and their
    information.
    """
    B, K = xyz.shape[:2]
    base = torch.exp(
        torch.log(torch.tensor(0.002)) + draw.uniform(B, 1) * torch.log(torch.tensor(20.0))
    )
    base = base * (draw.uniform(B, 1) >= clean)
    sigma = base * torch.exp(0.4 * draw.normal(B, K) * (draw.uniform(B, 1) < 0.5))
    claimed = sigma.clamp_min(0.005) * torch.exp(
        0.3 * draw.normal(B, 1) * (draw.uniform(B, 1) < 0.3)
    )
    information = torch.eye(3) / claimed.square()[..., None, None]
    return xyz + sigma[..., None] * draw.normal(B, K, 3), information


def triangulated(xyz: Tensor, draw: _Draw, statistics: DetectorStatistics) -> tuple[Tensor, Tensor]:
    """Joints as triangulated by 2 to 8 virtual cameras around the person, distant enough for
    parallel rays.
    """
    B, K = xyz.shape[:2]
    target, information = torch.zeros(B, K, 3), torch.zeros(B, K, 3, 3)
    number = 2 + draw.integers(7, B, 1)
    across_first = None
    for view in range(8):
        direction, across = _camera(B, draw)
        across_first = direction if across_first is None else across_first
        state = _hidden(xyz, direction, across, draw)
        missed, sigma, claimed = _reports(state, draw, statistics)
        seen = (~missed & (view < number))[..., None, None]
        plane = torch.eye(3) - direction[:, None, :, None] * direction[:, None, None, :]
        weight = seen * plane / claimed.square()[..., None, None]
        error = sigma[..., None] * draw.normal(B, K, 3)
        information = information + weight
        target = target + (weight @ (xyz + error)[..., None]).squeeze(-1)
    # A single ray leaves the depth unobserved: triangulation gives an arbitrary position.
    anywhere = xyz + 0.4 * draw.normal(B, K, 3)
    little = 0.5
    solved = (
        inverse_3x3(information + little * torch.eye(3)) @ (target + little * anywhere)[..., None]
    )
    return solved.squeeze(-1), information


def _camera(B: int, draw: _Draw) -> tuple[Tensor, Tensor]:
    """Unit directions (B, 3) from the person to a camera, and unit vectors (B, 3) in the image's
    plane.
    """
    turn, rise = 2 * torch.pi * draw.uniform(B), torch.deg2rad(60 * draw.uniform(B) - 10)
    direction = torch.stack((rise.cos() * turn.cos(), rise.sin(), rise.cos() * turn.sin()), -1)
    tilt = 2 * torch.pi * draw.uniform(B)
    side = torch.stack((-turn.sin(), torch.zeros(B), turn.cos()), -1)
    up = torch.linalg.cross(side, direction)
    return direction, tilt.cos()[:, None] * side + tilt.sin()[:, None] * up


def _hidden(xyz: Tensor, direction: Tensor, across: Tensor, draw: _Draw) -> Tensor:
    """(B, K) 0 visible, 1 self-occluded, 2 occluded by another person with a straight edge in the
    image.
    """
    B, K = xyz.shape[:2]
    middle = xyz.mean(1, keepdim=True)
    behind = ((xyz - middle) @ direction[..., None]).squeeze(-1) < -0.05
    own = behind & (draw.uniform(B, K) < 0.45)
    place = ((xyz - middle) @ across[..., None]).squeeze(-1)
    other = (place > 0.35 * draw.normal(B, 1)) & (draw.uniform(B, 1) < 0.3)
    return torch.where(other, 2, own.long())


def _reports(
    state: Tensor, draw: _Draw, statistics: DetectorStatistics
) -> tuple[Tensor, Tensor, Tensor]:
    """Detections of one view for joints in `state` (B, K): missed or not, true sigma and stated
    sigma, metres.
    """
    (B, K), which, group = state.shape, state.numpy(), _GROUP.expand_as(state).numpy()
    missed = draw.uniform(B, K).numpy() < statistics.miss[group, which]
    table, rank = statistics.confidence[group, which], draw.uniform(B, K).numpy()
    confidence = statistics.quantile(table, rank).clip(0.05, 1.0)
    sigma, tail = (
        np.choose(which, [np.interp(confidence, statistics.knots, row) for row in rows])
        for rows in (statistics.sigma_m, statistics.tail)
    )
    sigma *= statistics.joint_scale.mean(axis=-1)[group] * np.exp(tail * draw.normal(B, K).numpy())
    # Standard deviation stated by the pipeline for a joint of confidence 1, m (see
    # `observations`).
    claimed = torch.from_numpy(0.013 / confidence).float()
    return torch.from_numpy(missed), torch.from_numpy(sigma).float().clamp_max(0.25), claimed
