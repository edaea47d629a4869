"""Learned gradient descent: a body moves towards its targets, one step of the update network after the other.

    Theta <- Theta + N_w(dE_shape/dTheta, Theta, X)              (Eq. 5 of the paper; Song et al., ECCV 2020)

in the person's own frame: pelvis near the origin, upright, facing +z (see `PersonFrame`). E_shape is the data term
of `BodyEnergy`, its gradient analytic. Training unrolls the very same code.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor, nn

from shapepose_fg.body.fitting.energy import robust_weight
from shapepose_fg.body.model.body_model import accumulate
from shapepose_fg.body.model.rotation import from_six_d, inverse_3x3, six_d
from shapepose_fg.body.model.skinned_points import SkinnedPoints
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.bounds import Settings

NUM_ROTATIONS = 22
"""Root and the 21 joints of SMPL that are not hands: what the network turns."""
NUM_PARAMETERS = 10 + 6 * NUM_ROTATIONS + 3
"""betas, rotations as 6D, translation."""
_NUM_TANGENT = 10 + 3 * NUM_ROTATIONS + 3
_NUM_POINTS = len(BODY_POINTS)
_REACH_M = 0.1
"""A target is believed against where the body is now as if that were known to this, metres."""
_TRUST_M = 0.03
"""Sigma of a target that is half trusted, metres."""
_FAR_M = 0.5
"""Residuals above this are seen by the network compressed, metres."""
_TANGENT = torch.cat((torch.arange(10 + 3 * NUM_ROTATIONS), torch.arange(10 + 72, 10 + 75)))
"""Columns of the body's Jacobian that the network is told: all but the hands'."""
_SEEN_M, _TURN_RAD = 0.02, 0.3
"""Sigma of a joint well seen, and of an angle that no joint tells: for the size of gradients only."""
_STEP = 0.1
"""What the network's output of 1 means, in betas' tenths, entries of rotations, metres."""


@dataclass(frozen=True)
class NetworkConfig(Settings):
    """The size of an `UpdateNetwork`."""

    width: Annotated[int, Interval(ge=1, le=8192)] = 384
    """Units of every layer."""
    blocks: Annotated[int, Interval(ge=1, le=64)] = 2
    """Residual blocks."""
    steps: Annotated[int, Interval(ge=1, le=14)] = 3
    """Updates that it is made for; each knows its number."""
    dropout: Annotated[float, Interval(ge=0, le=0.99)] = 0.1
    """Share of the units that are left out in training."""
    half_precision: bool = True
    """Trains with bfloat16 products, twice as fast on processors that have them; fits are always in float32."""


class UpdateNetwork(nn.Module):
    """From gradient, parameters and targets to the next step of the parameters.

    A multilayer perceptron with residual blocks; its last layer starts at zero, so an untrained one stands still.
    """

    num_inputs = 7 * _NUM_POINTS + NUM_PARAMETERS + _NUM_TANGENT

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        self.enter = nn.Linear(self.num_inputs + config.steps, config.width)
        self.blocks = nn.ModuleList(_Block(config.width, config.dropout) for _ in range(config.blocks))
        self.leave = nn.Linear(config.width, NUM_PARAMETERS)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)
        self.gradient_scale: Tensor
        self.register_buffer("gradient_scale", torch.ones(_NUM_TANGENT))

    def forward(self, inputs: Tensor, step: int) -> Tensor:
        """(B, `NUM_PARAMETERS`) the change of the parameters in update number `step`; inputs (B, `num_inputs`)."""
        place = self.leave.weight.device
        with torch.autocast(place.type, torch.bfloat16, enabled=self.training and self.config.half_precision):
            weight, bias = self.enter.weight, self.enter.bias + self.enter.weight[:, self.num_inputs + step]
            hidden = nn.functional.linear(inputs.to(place), weight[:, : self.num_inputs], bias)
            for block in self.blocks:
                hidden = hidden + block(hidden)
            return self.leave(hidden).float().to(inputs.device)


class _Block(nn.Module):
    def __init__(self, width: int, dropout: float):
        super().__init__()
        self.layers = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), nn.Dropout(dropout), nn.Linear(width, width)
        )

    def forward(self, hidden: Tensor) -> Tensor:
        return self.layers(hidden)


@dataclass(frozen=True)
class DescentTargets:
    """Targets in the person's own frame."""

    xyz: Tensor
    """(B, K, 3) metres, finite."""
    information: Tensor
    """(B, K, 3, 3) 1/m², the model's error included; zero for a joint never seen."""


@dataclass(frozen=True)
class BodyState:
    """Shape and pose of B bodies, rotations as matrices."""

    betas: Tensor
    """(B, 10) shape."""
    local: Tensor
    """(B, 24, 3, 3) rotations relative to the parent, the root's to the person's frame."""
    transl: Tensor
    """(B, 3) metres."""

    def detached(self) -> "BodyState":
        """The same, without a past to differentiate."""
        return BodyState(self.betas.detach(), self.local.detach(), self.transl.detach())


class LearnedDescent:
    """Unrolls the update network on the points of one body model."""

    def __init__(
        self,
        points: SkinnedPoints,
        slots: tuple[int, ...],
        network: UpdateNetwork,
        kernel_scale: float,
        others: SkinnedPoints | None = None,
        offsets: tuple[Tensor, Tensor] | None = None,
    ):
        """`points` are the targets' (K), `slots` (K,) their places among `BODY_POINTS`.

        `others`: the rest of the body's points (50 - K), in order, to be given where there are any.
        `offsets`: what a detector's keypoint offsets add to the points (K, 3), in the frames of which bones (K,).
        """
        rest = tuple(sorted(set(range(len(BODY_POINTS))) - set(slots)))
        if len(rest) != (0 if others is None else len(others.root)):
            raise ValueError(f"others must be the {len(rest)} points of the body that are not among the targets")
        self._gradient_scale = network.gradient_scale.cpu()
        self.points, self.network, self._others, self._offsets = points, network, others, offsets
        self._slots, self._rest = torch.tensor(slots), torch.tensor(rest, dtype=torch.long)
        self._kernel_scale = torch.tensor(kernel_scale)

    def unroll(self, state: BodyState, targets: DescentTargets) -> Iterator[BodyState]:
        """The states after each update. Each starts from the last one detached."""
        believed, trust = _believed(targets.information)
        for step in range(self.network.config.steps):
            inputs = self._inputs(state, targets, believed, trust)
            state = _moved(state, self.network(inputs, step))
            yield state
            state = state.detached()

    @torch.no_grad()
    def _inputs(self, state: BodyState, targets: DescentTargets, believed: Tensor, trust: Tensor) -> Tensor:
        """(B, `UpdateNetwork.num_inputs`) what the network sees."""
        rotations = accumulate(state.local)
        feature = self.points.feature(state.local)
        xyz, arms = self.points.positions_with_arms(rotations, state.betas, state.transl, feature)
        residual = targets.xyz - xyz
        pull = (targets.information @ residual[..., None]).squeeze(-1)
        squared = (pull * residual).sum(-1)
        forces = robust_weight(squared, self._kernel_scale)[..., None] * pull
        gradient = self.points.pull_back(forces, arms, rotations, state.local)[:, _TANGENT]
        shrunk = (believed @ residual[..., None]).squeeze(-1)
        shrunk = shrunk / (1 + torch.linalg.vector_norm(shrunk, dim=-1, keepdim=True) / _FAR_M)
        if self._offsets is not None:  # the network knows the body's own points
            xyz = xyz - (rotations[:, self._offsets[1]] @ self._offsets[0][..., None]).squeeze(-1)
        seen = xyz.new_zeros(len(xyz), len(BODY_POINTS), 7)
        seen[:, self._slots] = torch.cat((xyz + shrunk, 5 * shrunk, trust[..., None]), -1)
        if self._others is not None:  # as those whose targets are missing
            seen[:, self._rest, :3] = self._others.positions(rotations, state.betas, state.transl, feature)
        return torch.cat(
            (
                seen.flatten(1),
                state.betas / 3,
                six_d(state.local[:, :NUM_ROTATIONS]).flatten(1),
                state.transl,
                (gradient * self._gradient_scale).clamp(-3, 3),
            ),
            1,
        )


def _moved(state: BodyState, change: Tensor) -> BodyState:
    """The state after a change (B, `NUM_PARAMETERS`) of betas, 6D rotations, translation."""
    change = _STEP * change
    turned = from_six_d(six_d(state.local[:, :NUM_ROTATIONS]) + change[:, 10:-3].unflatten(1, (NUM_ROTATIONS, 6)))
    local = torch.cat((turned, state.local[:, NUM_ROTATIONS:]), 1)
    return BodyState(state.betas + 10 * change[:, :10], local, state.transl + change[:, -3:])


def _believed(information: Tensor) -> tuple[Tensor, Tensor]:
    """How far each target is believed: as a matrix (B, K, 3, 3) for its residual, and a number (B, K), 0 to 1."""
    eye = torch.eye(3)
    believed = information @ inverse_3x3(information + eye / _REACH_M**2)
    share = information @ inverse_3x3(information + eye / _TRUST_M**2)
    return believed, torch.diagonal(share, dim1=-2, dim2=-1).mean(-1)


def gradient_scale(points: SkinnedPoints, slots: tuple[int, ...]) -> Tensor:
    """(P,) what turns a gradient into about a step: the inverse of the Hessian's diagonal in T-pose."""
    eye = torch.eye(3).expand(1, 24, 3, 3)
    still = torch.zeros(1, 10), torch.zeros(1, 3)
    _, jacobian = points.positions_with_jacobian(eye, *still, eye, points.feature(eye))
    slope = jacobian[0, list(slots)].flatten(0, 1).square().sum(0)[_TANGENT] / _SEEN_M**2
    prior = torch.cat((torch.ones(10), torch.full((3 * NUM_ROTATIONS,), _TURN_RAD**-2), torch.zeros(3)))
    return 1 / (slope + prior)
