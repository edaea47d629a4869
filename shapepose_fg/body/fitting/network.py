"""The update network N_w of learned gradient descent (Eq. 5 of the paper; Song et al., ECCV 2020)."""

from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor, nn

from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.bounds import Settings

NUM_ROTATIONS = 22
"""Root and the 21 joints of SMPL that are not hands: what the network turns."""
NUM_PARAMETERS = 10 + 6 * NUM_ROTATIONS + 3
"""betas, rotations as 6D, translation."""
_NUM_TANGENT = 10 + 3 * NUM_ROTATIONS + 3
_NUM_POINTS = len(BODY_POINTS)


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


@torch.no_grad()
def num_weights(network: nn.Module) -> int:
    """Count of trained numbers."""
    return sum(weight.numel() for weight in network.parameters())
