"""Learned gradient descent: the update network moves a body towards its targets, step by step.

    Theta <- Theta + N_w(dE_shape/dTheta, Theta, X)    (Eq. 5 of the paper; Song et al., ECCV 2020)

in the person's own frame: pelvis near the origin, upright, facing +z (see `PersonFrame`). E_shape
is the data term of `BodyEnergy`, with an analytic gradient. Training
(`simulation/training/differentiable.py`) uses the same inputs, with differentiable versions of the
network's layers and the body's points.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.network import NUM_ROTATIONS, UpdateNetwork
from shapepose_fg.body.kernels.bodies import seen
from shapepose_fg.body.kernels.rows import Own, Work
from shapepose_fg.body.model.skinned_points import NUM_COLUMNS, SkinnedPoints
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.compiled import kernel

_TANGENT = np.append(np.arange(10 + 3 * NUM_ROTATIONS), np.arange(10 + 72, 10 + 75))
"""Columns of the body's Jacobian that are inputs of the network: all but the hands'."""
_SEEN_M, _TURN_RAD = 0.02, 0.3
"""Standard deviations of a well observed joint, m, and of an unobserved angle, rad; they only scale
gradients."""
STEP = 0.1
"""Scale of the network's output: an output of 1 is 0.1 in entries of rotations and metres, and 1 in
betas."""


@dataclass(frozen=True)
class DescentState:
    """Shape and pose of B bodies, rotations as matrices."""

    betas: Array
    """(B, 10) shape."""
    local: Array
    """(B, 24, 3, 3) rotations relative to the parent; for the root, to the person's frame."""
    transl: Array
    """(B, 3) translation, metres."""


class LearnedDescent:
    """Unrolls the update network on the points of one body model."""

    def __init__(
        self,
        points: SkinnedPoints,
        slots: tuple[int, ...],
        network: UpdateNetwork,
        kernel_scale: float,
        others: SkinnedPoints | None = None,
        offsets: tuple[Array, Index] | None = None,
    ):
        """`points` are the targets' points (K), `slots` (K,) their indices in `BODY_POINTS`.

        `others`: the remaining points of the body (50 - K), in order; required if there are any.
        `offsets`: the detector's keypoint offsets (K, 3), in the frames of the bones (K,).
        """
        self.network, self._inputs = (
            network,
            NetworkInputs(points, slots, kernel_scale, others, offsets),
        )

    def unroll(self, state: DescentState, xyz: Array, information: Array) -> Iterator[DescentState]:
        """Yield the state after each update, given targets (B, K, 3) in the person's own frame,
        metres, finite, and their information (B, K, 3, 3), 1/m², including the model's error; zero
        for an unseen joint.
        """
        for step in range(self.network.config.steps):
            inputs = self._inputs(state, xyz, information, self.network.gradient_scale)
            state = DescentState(*(np.array(part, order="C") for part in vars(state).values()))
            moved(self.network(inputs, step), STEP, state.betas, state.local, state.transl)
            yield state


class NetworkInputs:
    """Computes the network's inputs from bodies and targets; parameters as in `LearnedDescent`."""

    def __init__(
        self,
        points: SkinnedPoints,
        slots: tuple[int, ...],
        kernel_scale: float,
        others: SkinnedPoints | None = None,
        offsets: tuple[Array, Index] | None = None,
    ):
        rest = tuple(sorted(set(range(len(BODY_POINTS))) - set(slots)))
        if len(rest) != (0 if others is None else len(others.root)):
            raise ValueError(
                f"others must be the {len(rest)} points of the body that are not among the targets"
            )
        every = (points if others is None else points.joined(others)).part(
            np.argsort(slots + rest, kind="stable").tolist()
        )
        own = Own(np.full(len(BODY_POINTS), -1), np.zeros((50, 3)), np.zeros(50, dtype=np.intp))
        own.target[list(slots)] = np.arange(len(slots))
        if offsets is not None:  # the network uses the body's own points
            own.offset[list(slots)], own.bone[list(slots)] = offsets
        self._own, self._limbs, self._kernel_scale = own, every.limbs(), kernel_scale

    def __call__(
        self, state: DescentState, target: Array, information: Array, scale: Any
    ) -> NDArray[np.float32]:
        """(B, `UpdateNetwork.num_inputs`) network inputs; gradients are multiplied by `scale`
        (79,).
        """
        given = (state.betas, state.local, state.transl, target, information)
        betas, local, transl, xyz, known = (np.require(each, float, ["C", "W"]) for each in given)
        inputs = np.empty((len(state.betas), UpdateNetwork.num_inputs), dtype=np.float32)
        seen(
            self._limbs, self._own, betas, local, transl, xyz, known, self._kernel_scale,
            np.asarray(scale, dtype=np.float64), inputs, Work.of(self._limbs, NUM_COLUMNS),
        )  # fmt: skip
        return inputs


@kernel("s2 f0 f2 f4 f2")
def moved(change, size, betas, local, transl):
    """Update B bodies in place by `size` times a `change` (B, 145): betas scaled by 10, the first
    two columns of 22 rotations, orthogonalised again (Gram-Schmidt; NaN if parallel), and the
    translation. For rotations as six numbers see Zhou et al., "On the Continuity of Rotation
    Representations in Neural Networks", CVPR 2019.
    """
    for b in range(len(change)):
        for n in range(10):
            betas[b, n] += 10 * size * change[b, n]
        for x in range(3):
            transl[b, x] += size * change[b, 142 + x]
        for q in range(22):
            R, c, at = local[b, q], change[b], 10 + 6 * q
            a0, a1, a2 = (
                R[0, 0] + size * c[at],
                R[1, 0] + size * c[at + 1],
                R[2, 0] + size * c[at + 2],
            )
            b0, b1, b2 = (
                R[0, 1] + size * c[at + 3],
                R[1, 1] + size * c[at + 4],
                R[2, 1] + size * c[at + 5],
            )
            v = 1 / math.sqrt(a0 * a0 + a1 * a1 + a2 * a2)
            a0, a1, a2 = v * a0, v * a1, v * a2
            v = a0 * b0 + a1 * b1 + a2 * b2
            b0, b1, b2 = b0 - v * a0, b1 - v * a1, b2 - v * a2
            v = 1 / math.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
            b0, b1, b2 = v * b0, v * b1, v * b2
            R[0, 0], R[1, 0], R[2, 0], R[0, 1], R[1, 1], R[2, 1] = a0, a1, a2, b0, b1, b2
            R[0, 2], R[1, 2], R[2, 2] = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


def gradient_scale(points: SkinnedPoints, slots: tuple[int, ...]) -> Array:
    """(P,) factors from gradient to approximate step: the inverse diagonal of the Hessian in
    T-pose.
    """
    eye = np.tile(np.eye(3), (1, 24, 1, 1))
    _, jacobian = points.positions_with_jacobian(eye, np.zeros((1, 10)), np.zeros((1, 3)))
    slope = np.square(jacobian[0, list(slots)]).sum((0, 1))[_TANGENT] / _SEEN_M**2
    prior = np.concatenate((np.ones(10), np.full(3 * NUM_ROTATIONS, _TURN_RAD**-2), np.zeros(3)))
    return np.asarray(1 / (slope + prior))
