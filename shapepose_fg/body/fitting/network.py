"""The update network of learned gradient descent."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.bounds import Settings
from shapepose_fg.core.compiled import kernel
from shapepose_fg.core.skeleton import SMPL_24

NUM_ROTATIONS = SMPL_24.index("left_hand")
"""Root and the 21 joints of SMPL that are not hands: the rotations that the network updates."""
NUM_PARAMETERS = 10 + 6 * NUM_ROTATIONS + 3
"""Number of parameters: betas, 6D rotations, translation."""
NUM_TANGENT = 10 + 3 * NUM_ROTATIONS + 3
"""Number of tangent parameters: betas, tangents of the rotations, translation."""
_NUM_POINTS = len(BODY_POINTS)
_NONE, _LITTLE, _ROOT_HALF, _HALF, _ONE, _FAR = map(
    np.float32, (0.0, 1e-5, 0.5**0.5, 0.5, 1.0, 3.9)
)


@dataclass(frozen=True)
class NetworkConfig(Settings):
    """The size of an `UpdateNetwork`."""

    width: Annotated[int, Interval(ge=1, le=8192)] = 384
    """Number of units of every layer."""
    blocks: Annotated[int, Interval(ge=1, le=64)] = 2
    """Number of residual blocks."""
    steps: Annotated[int, Interval(ge=1, le=14)] = 3
    """Number of updates; the step number is an input."""
    dropout: Annotated[float, Interval(ge=0, le=0.99)] = 0.1
    """Dropout rate in training."""
    half_precision: bool = True
    """Trains with bfloat16 products, twice as fast on processors that have them; fits are always in
    float32."""


class UpdateNetwork:
    """Predicts the next step of the parameters from gradient, parameters and targets.

    A multilayer perceptron with residual blocks: layer normalisation, linear layer, GELU, linear
    layer.
    """

    num_inputs = 7 * _NUM_POINTS + NUM_PARAMETERS + NUM_TANGENT

    def __init__(self, config: NetworkConfig, weights: Mapping[str, NDArray[np.floating]]):
        """`weights` by their names in training; raises ValueError if one is missing, unknown or of
        wrong shape.
        """
        self.config = config
        shapes = layer_shapes(config)
        found = {name: value.shape for name, value in weights.items()}
        if found != shapes:
            wrong = sorted(
                name for name in found.keys() | shapes if found.get(name) != shapes.get(name)
            )
            raise ValueError(
                f"the network's {wrong[0]} is {found.get(wrong[0])}, not {shapes.get(wrong[0])}"
            )
        self.weights = {
            name: np.ascontiguousarray(value, dtype=np.float32) for name, value in weights.items()
        }
        """Weights by name, float32."""
        self._enter = np.ascontiguousarray(self.weights["enter.weight"][:, : self.num_inputs])

    @property
    def gradient_scale(self) -> NDArray[np.float32]:
        """(79,) factors on the gradients."""
        return self.weights["gradient_scale"]

    def __call__(self, inputs: NDArray[np.float32], step: int) -> NDArray[np.float32]:
        """(B, `NUM_PARAMETERS`) change of the parameters in update `step`; inputs (B,
        `num_inputs`).
        """
        W = self.weights
        enter = W["enter.weight"]
        hidden = _applied(inputs, self._enter, W["enter.bias"] + enter[:, self.num_inputs + step])
        for block in range(self.config.blocks):
            scaling, one, two = ((W[f"{at}.weight"], W[f"{at}.bias"]) for at in _layers(block))
            x = np.empty_like(hidden)
            _normalised(hidden, *scaling, x)
            x = _applied(x, *one)
            _gelu(x.reshape(-1))
            hidden = hidden + _applied(x, *two)
        return _applied(hidden, W["leave.weight"], W["leave.bias"])


def _layers(block: int) -> list[str]:
    """Names of a block's normalisation and its two linear layers."""
    return [f"blocks.{block}.layers.{place}" for place in (0, 1, 4)]


def layer_shapes(config: NetworkConfig) -> dict[str, tuple[int, ...]]:
    """The shapes of a network's weights by name."""
    width, shapes = config.width, {"gradient_scale": (NUM_TANGENT,)}
    sizes = {
        "enter": (width, UpdateNetwork.num_inputs + config.steps),
        "leave": (NUM_PARAMETERS, width),
    }
    for block in range(config.blocks):
        sizes |= dict(zip(_layers(block), ((width,), (width, width), (width, width)), strict=True))
    for name, size in sizes.items():
        shapes |= {f"{name}.weight": size, f"{name}.bias": size[:1]}
    return shapes


def _applied(
    x: NDArray[np.float32], weight: NDArray[np.float32], bias: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(B, m) output of a linear layer; independent of the number of threads."""
    y = np.empty((len(x), len(weight)), dtype=np.float32)
    _layer(x, weight, bias, y)
    return y


@kernel("s2 s2 s1 s2")
def _layer(x, weight, bias, y):
    """Fill y with x weightᵀ + bias, in cache-sized blocks."""
    (B, count), outputs = x.shape, len(weight)
    for start in range(0, outputs, 16):
        for i in range(0, B, 4):
            j, k, m = min(i + 1, B - 1), min(i + 2, B - 1), min(i + 3, B - 1)
            for o in range(start, min(start + 16, outputs), 2):
                q = min(o + 1, outputs - 1)
                a, b, c, d, e, f, g, h = (
                    bias[o],
                    bias[o],
                    bias[o],
                    bias[o],
                    bias[q],
                    bias[q],
                    bias[q],
                    bias[q],
                )
                for p in range(count):
                    v, w = weight[o, p], weight[q, p]
                    a += x[i, p] * v
                    b += x[j, p] * v
                    c += x[k, p] * v
                    d += x[m, p] * v
                    e += x[i, p] * w
                    f += x[j, p] * w
                    g += x[k, p] * w
                    h += x[m, p] * w
                y[i, o], y[j, o], y[k, o], y[m, o] = a, b, c, d
                y[i, q], y[j, q], y[k, q], y[m, q] = e, f, g, h


@kernel("s2 s1 s1 s2")
def _normalised(x, weight, bias, y):
    """Fill y with the layer normalisation of x."""
    B, count = x.shape
    for i in range(B):
        mean, square = _NONE, _NONE
        for p in range(count):
            mean += x[i, p]
        mean /= np.float32(count)
        for p in range(count):
            square += (x[i, p] - mean) * (x[i, p] - mean)
        scale = _ONE / math.sqrt(square / np.float32(count) + _LITTLE)
        for p in range(count):
            y[i, p] = (x[i, p] - mean) * scale * weight[p] + bias[p]


_ABOVE = tuple(np.float32(value) for value in (
    -2.72614225801306e-10, 2.77068142495902e-08, -2.10102402082508e-06, -5.69250639462346e-05,
    -7.34990630326855e-04, -2.95459980854025e-03, -1.60960333262415e-02))  # fmt: skip
_BELOW = tuple(np.float32(value) for value in (
    -1.45660718464996e-05, -2.13374055278905e-04, -1.68282697438203e-03, -7.37332916720468e-03,
    -1.42647390514189e-02))  # fmt: skip


@kernel("s1")
def _gelu(x):
    """Replace each x by x (1 + erf(x / sqrt(2))) / 2, with a rational approximation of
    erf to 2e-7.
    """
    for i in range(len(x)):
        v = min(max(x[i] * _ROOT_HALF, -_FAR), _FAR)
        s = v * v
        above = (
            ((((_ABOVE[0] * s + _ABOVE[1]) * s + _ABOVE[2]) * s + _ABOVE[3]) * s + _ABOVE[4]) * s
            + _ABOVE[5]
        ) * s
        below = (((_BELOW[0] * s + _BELOW[1]) * s + _BELOW[2]) * s + _BELOW[3]) * s + _BELOW[4]
        x[i] = _HALF * x[i] * (_ONE + v * (above + _ABOVE[6]) / below)
