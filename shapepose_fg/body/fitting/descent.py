"""Learned gradient descent: a body moves towards its targets, one step of the update network after the other.

    Theta <- Theta + N_w(dE_shape/dTheta, Theta, X)              (Eq. 5 of the paper; Song et al., ECCV 2020)

in the person's own frame: pelvis near the origin, upright, facing +z (see `PersonFrame`). E_shape is the data term
of `BodyEnergy`, its gradient analytic. Training (`simulation/training/differentiable.py`) sees the very same
inputs, and has the network's layers and the bodies' points once more, differentiable.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.network import NUM_ROTATIONS, UpdateNetwork
from shapepose_fg.body.model.body_model import accumulate
from shapepose_fg.body.model.rotation import from_six_d, six_d
from shapepose_fg.body.model.skinned_points import SkinnedPoints
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.arrays import Array, Index

_REACH_M = 0.1
"""A target is believed against where the body is now as if that were known to this, metres."""
_TRUST_M = 0.03
"""Sigma of a target that is half trusted, metres."""
_FAR_M = 0.5
"""Residuals above this are seen by the network compressed, metres."""
_TANGENT = np.append(np.arange(10 + 3 * NUM_ROTATIONS), np.arange(10 + 72, 10 + 75))
"""Columns of the body's Jacobian that the network is told: all but the hands'."""
_SEEN_M, _TURN_RAD = 0.02, 0.3
"""Sigma of a joint well seen, and of an angle that no joint tells: for the size of gradients only."""
STEP = 0.1
"""What the network's output of 1 means, in betas' tenths, entries of rotations, metres."""


@dataclass(frozen=True)
class BodyState:
    """Shape and pose of B bodies, rotations as matrices."""

    betas: Array
    """(B, 10) shape."""
    local: Array
    """(B, 24, 3, 3) rotations relative to the parent, the root's to the person's frame."""
    transl: Array
    """(B, 3) metres."""


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
        """`points` are the targets' (K), `slots` (K,) their places among `BODY_POINTS`.

        `others`: the rest of the body's points (50 - K), in order, to be given where there are any.
        `offsets`: what a detector's keypoint offsets add to the points (K, 3), in the frames of which bones (K,).
        """
        self.network, self._see = network, Sight(points, slots, kernel_scale, others, offsets)

    def unroll(self, state: BodyState, xyz: Array, information: Array) -> Iterator[BodyState]:
        """The states after each update, given targets (B, K, 3) in the person's own frame, metres, finite, and
        their information (B, K, 3, 3), 1/m², the model's error included; zero for a joint never seen.
        """
        trusted = believed(information)
        for step in range(self.network.config.steps):
            inputs = self._see(state, xyz, information, trusted, self.network.gradient_scale)
            state = _moved(state, self.network(inputs, step))
            yield state


class Sight:
    """What the network sees of bodies and their targets; parameters as in `LearnedDescent`."""

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
            raise ValueError(f"others must be the {len(rest)} points of the body that are not among the targets")
        self._points, self._others, self._offsets = points, others, offsets
        self._slots, self._rest, self._kernel_scale = list(slots), list(rest), kernel_scale

    def __call__(
        self, state: BodyState, target: Array, information: Array, trusted: tuple[Array, Array], scale: Any
    ) -> NDArray[np.float32]:
        """(B, `UpdateNetwork.num_inputs`); `trusted` is `believed(information)`, gradients are multiplied by
        `scale`.
        """
        local, betas, transl, B = state.local, state.betas, state.transl, len(state.betas)
        matrix, trust = trusted
        xyz, _, gradient = self._points.pulled(local, betas, transl, target, information, self._kernel_scale)
        shrunk = (matrix @ (target - xyz)[..., None])[..., 0]
        shrunk = shrunk / (1 + np.sqrt(np.square(shrunk).sum(-1, keepdims=True)) / _FAR_M)
        if self._offsets is not None:  # the network knows the body's own points
            xyz = xyz - (accumulate(local)[:, self._offsets[1]] @ self._offsets[0][..., None])[..., 0]
        seen = np.zeros((B, len(BODY_POINTS), 7))
        seen[:, self._slots] = np.concatenate((xyz + shrunk, 5 * shrunk, trust[..., None]), -1)
        if self._others is not None:  # as those whose targets are missing
            seen[:, self._rest, :3] = self._others.positions(local, betas, transl)
        rotations = six_d(local[:, :NUM_ROTATIONS]).reshape(B, -1)
        slope = np.clip(-gradient[:, _TANGENT] * scale, -3, 3)
        parts = (seen.reshape(B, -1), betas / 3, rotations, transl, slope)
        return np.concatenate(parts, 1, dtype=np.float32)


def _moved(state: BodyState, change: NDArray[np.float32]) -> BodyState:
    """The state after a change (B, `NUM_PARAMETERS`) of betas, 6D rotations, translation."""
    step, local = STEP * change.astype(np.float64), state.local.copy()
    turned = six_d(local[:, :NUM_ROTATIONS]) + step[:, 10:-3].reshape(-1, NUM_ROTATIONS, 6)
    local[:, :NUM_ROTATIONS] = from_six_d(turned)
    return BodyState(state.betas + 10 * step[:, :10], local, state.transl + step[:, -3:])


def believed(information: Array) -> tuple[Array, Array]:
    """How far each target is believed: as a matrix (B, K, 3, 3) for its residual, and a number (B, K), 0 to 1."""
    share = _share(information, _TRUST_M)
    return _share(information, _REACH_M), np.trace(share, axis1=-2, axis2=-1) / 3


def _share(information: Array, sigma_m: float) -> Array:
    """L (L + I / sigma²)^-1 = I - (I + sigma² L)^-1 of symmetric L (..., 3, 3), by its minors."""
    M = np.eye(3) + sigma_m**2 * information
    a, b, c, d, e, f = (M[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
    minors = np.stack((p, q, r, q, s, t, r, t, u), -1).reshape(M.shape)
    return np.eye(3) - minors / (a * p + b * q + c * r)[..., None, None]


def gradient_scale(points: SkinnedPoints, slots: tuple[int, ...]) -> Array:
    """(P,) what turns a gradient into about a step: the inverse of the Hessian's diagonal in T-pose."""
    eye = np.tile(np.eye(3), (1, 24, 1, 1))
    _, jacobian = points.positions_with_jacobian(eye, np.zeros((1, 10)), np.zeros((1, 3)))
    slope = np.square(jacobian[0, list(slots)]).sum((0, 1))[_TANGENT] / _SEEN_M**2
    prior = np.concatenate((np.ones(10), np.full(3 * NUM_ROTATIONS, _TURN_RAD**-2), np.zeros(3)))
    return np.asarray(1 / (slope + prior))
