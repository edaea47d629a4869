"""Differentiable parts of training in torch: layers of the update network, its steps, and points of
a body.

The network's input is computed by the fitter's own code (`body/fitting/descent.py`), without a
gradient. Fits use the NumPy network (`body/fitting/network.py`); a test compares the two.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from shapepose_fg.body.fitting.descent import STEP, DescentState, NetworkInputs
from shapepose_fg.body.fitting.network import (
    NUM_PARAMETERS,
    NUM_ROTATIONS,
    NUM_TANGENT,
    NetworkConfig,
    UpdateNetwork,
)
from shapepose_fg.body.model.skinned_points import SkinnedPoints
from shapepose_fg.body.model.smpl_file import SMPL_PARENTS


class TrainedNetwork(nn.Module):
    """A trainable `UpdateNetwork`. Its last layer is initialised to zero, so that an untrained one
    makes no steps.
    """

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        self.enter = nn.Linear(UpdateNetwork.num_inputs + config.steps, config.width)
        self.blocks = nn.ModuleList(
            _Block(config.width, config.dropout) for _ in range(config.blocks)
        )
        self.leave = nn.Linear(config.width, NUM_PARAMETERS)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)
        self.gradient_scale: Tensor
        self.register_buffer("gradient_scale", torch.ones(NUM_TANGENT))

    @classmethod
    def of(cls, network: UpdateNetwork) -> "TrainedNetwork":
        """A trainable network with the weights of one of the fitter's."""
        found = cls(network.config)
        found.load_state_dict(
            {name: torch.from_numpy(value.copy()) for name, value in network.weights.items()}
        )
        return found

    def finished(self) -> UpdateNetwork:
        """Return this network in the fitter's form."""
        return UpdateNetwork(
            self.config, {name: value.cpu().numpy() for name, value in self.state_dict().items()}
        )

    def forward(self, inputs: Tensor, step: int) -> Tensor:
        """(B, `NUM_PARAMETERS`) change of the parameters in update `step`; inputs (B,
        `num_inputs`).
        """
        place, count = self.leave.weight.device, UpdateNetwork.num_inputs
        with torch.autocast(
            place.type, torch.bfloat16, enabled=self.training and self.config.half_precision
        ):
            weight, bias = self.enter.weight, self.enter.bias + self.enter.weight[:, count + step]
            hidden = nn.functional.linear(inputs.to(place), weight[:, :count], bias)
            for block in self.blocks:
                hidden = hidden + block(hidden)
            return self.leave(hidden).float().to(inputs.device)


class _Block(nn.Module):
    def __init__(self, width: int, dropout: float):
        super().__init__()
        self.layers = nn.Sequential(
            nn.LayerNorm(width),
            nn.Linear(width, width),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(width, width),
        )

    def forward(self, hidden: Tensor) -> Tensor:
        return self.layers(hidden)


@dataclass(frozen=True)
class DescentTargets:
    """Targets in the person's own frame."""

    xyz: Tensor
    """(B, K, 3) metres, finite."""
    information: Tensor
    """(B, K, 3, 3) information, 1/m², including the model's error; zero for an unseen joint."""


@dataclass(frozen=True)
class State:
    """A `DescentState` of tensors."""

    betas: Tensor
    """(B, 10) shape."""
    local: Tensor
    """(B, 24, 3, 3) rotations relative to the parent; for the root, to the person's frame."""
    transl: Tensor
    """(B, 3) translation, metres."""


def unroll(
    see: NetworkInputs, network: TrainedNetwork, state: State, targets: DescentTargets
) -> Iterator[State]:
    """Yield the state after each update, with network inputs from `see`; each starts from the last
    one detached.
    """
    xyz, information = (value.double().numpy() for value in (targets.xyz, targets.information))
    scale = network.gradient_scale.cpu().numpy()
    for step in range(network.config.steps):
        plain = DescentState(*(value.detach().double().numpy() for value in vars(state).values()))
        change = STEP * network(torch.from_numpy(see(plain, xyz, information, scale)), step)
        turned = _six_d(state.local[:, :NUM_ROTATIONS]) + change[:, 10:-3].unflatten(
            1, (NUM_ROTATIONS, 6)
        )
        local = torch.cat((_from_six_d(turned), state.local[:, NUM_ROTATIONS:]), 1)
        state = State(state.betas + 10 * change[:, :10], local, state.transl + change[:, -3:])
        yield state
        state = State(*(value.detach() for value in vars(state).values()))


def positions(points: SkinnedPoints, state: State) -> Tensor:
    """(B, K, 3) points of bodies, metres, in single precision."""
    offsets, by_shape, root, root_by_shape, share = (
        torch.from_numpy(np.ascontiguousarray(part)).float()
        for part in (
            points.offsets,
            points.offsets_shape,
            points.root,
            points.root_shape,
            points.translation,
        )
    )
    world = [state.local[:, 0]]
    for bone in range(1, len(SMPL_PARENTS)):  # parents first
        world.append(world[SMPL_PARENTS[bone]] @ state.local[:, bone])
    terms = offsets + torch.einsum("bn,nkyj->bkyj", state.betas, by_shape)
    if points.offsets_pose is not None:
        bent = (state.local[:, 1:] - torch.eye(3)).flatten(1)
        terms = terms + torch.einsum(
            "be,ekyj->bkyj", bent, torch.from_numpy(points.offsets_pose).float()
        )
    still = (
        root
        + torch.einsum("bn,nkx->bkx", state.betas, root_by_shape)
        + share[:, None] * state.transl[:, None]
    )
    return still + torch.einsum("bjxy,bkyj->bkx", torch.stack(world, 1), terms)


def inverse_3x3(matrix: Tensor) -> Tensor:
    """Inverses (..., 3, 3) by cross products of the rows; a singular matrix gives infinities, not
    an error.

    LAPACK would process a batch one by one.
    """
    a, b, c = matrix.unbind(-2)
    columns = torch.stack(
        (torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)), -1
    )
    determinant = (a * columns[..., 0]).sum(-1)
    return columns / determinant[..., None, None]


def _six_d(R: Tensor) -> Tensor:
    """The first two columns of rotation matrices (`body/fitting/descent.py`); (..., 3, 3) -> (...,
    6).
    """
    return R[..., :2].transpose(-1, -2).flatten(-2)


def _from_six_d(columns: Tensor) -> Tensor:
    """Rotation matrices from two columns (`body/fitting/descent.py`); (..., 6) -> (..., 3, 3)."""
    first, second = columns[..., :3], columns[..., 3:]
    x = first / torch.linalg.vector_norm(first, dim=-1, keepdim=True)
    across = second - (x * second).sum(-1, keepdim=True) * x
    y = across / torch.linalg.vector_norm(across, dim=-1, keepdim=True)
    return torch.stack((x, y, torch.linalg.cross(x, y)), -1)
