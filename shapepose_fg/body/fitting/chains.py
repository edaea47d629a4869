"""The motion prior between the bodies of a person in consecutive rows."""

import numpy as np

from factors import Motion
from shapepose_fg.body.fitting.energy import BodyEnergy
from shapepose_fg.body.fitting.priors import MotionPrior
from shapepose_fg.body.model.body_model import BodyParameters
from shapepose_fg.body.model.rotation import log_so3, right_jacobian_inverse
from shapepose_fg.core.arrays import Array, Index


class MotionChain:
    """`MotionPrior` along a chain of T rows with N parameters, as a part of a least-squares
    problem.

    A motion model of order n (`factors.Motion`) links n + 1 consecutive rows: it predicts the last
    derivative of the state, with derivatives as finite differences of rows. The root's rotation is
    updated in tangents of the world, exp(delta) R, in which its coupling is as diagonal as that of
    the other parameters, up to the rotation between frames; its gradient is exact.
    """

    diagonal: Array
    """(T, N) diagonal of half the Hessian; a parameter is only coupled with itself in
    other rows."""
    beyond: Array
    """(T, N, n) coupling of each row with the next n rows."""

    def __init__(self, law: Motion, acceleration: Array, velocity: Array, step_s: Array):
        """Spectral densities (N,) as in `MotionPrior`; `step_s` (T - 1,) time between rows,
        seconds, infinite beyond the end: T is at least n, and a single row has nothing after it.
        """
        real = np.isfinite(step_s)
        self._rate = np.where(real, 1 / step_s, 0.0)[:, None]
        self._slow = np.where(real, step_s, 0.0)[:, None] / velocity
        # The predicted derivative as a weighted sum of velocities v_k, v_k+1, ...
        gaps, weights = step_s, [np.ones((len(step_s), 1))]
        for order in range(2, law.order + 1):
            gaps = (gaps[1:] + gaps[:-1]) / 2
            gaps = np.where(np.isfinite(gaps), gaps, 1.0)
            last = order == law.order
            lasts = law.transition(gaps)[..., -1, -1] if last else 1.0 + 0 * gaps
            width = (1.0 + 0 * gaps if last else gaps)[..., None]
            none = 0 * weights[0]
            pairs = zip([*weights, none], [none, *weights], strict=True)
            weights = [(after[1:] - lasts[..., None] * now[:-1]) / width for now, after in pairs]
        self._weights, n = weights, law.order
        noise = law.noise(gaps[..., None], law.density(acceleration))[..., -1, -1]
        self._smooth = real[n - 1 :, None] / noise
        # In terms of velocities the prior is banded: slow v² + smooth (weights v)².
        self._bands = [self._slow.copy(), *(0 * self._slow[k:] for k in range(1, n))]
        for i in range(n - 1, -1, -1):
            for k in range(n - i):
                part = slice(i, i + len(self._smooth))
                self._bands[k][part] += self._smooth * weights[i] * weights[i + k]
        self.diagonal, *beyond = self._couplings()
        self.beyond = np.stack(beyond, -1)

    def at(self, root: Array, others: Array) -> tuple[float, Array]:
        """Energy in squared standard deviations, and half its gradient (T, N), at root rotations
        (T, 3, 3) and the other parameters (T, N - 3).
        """
        turn = log_so3(root[1:] @ root[:-1].swapaxes(1, 2))
        v = self._rate * np.concatenate((turn, others[1:] - others[:-1]), -1)
        K = len(self._smooth)
        change = sum(
            weight * v[i : i + K] for i, weight in reversed(list(enumerate(self._weights)))
        )
        energy = float((self._slow * v**2).sum() + (self._smooth * change**2).sum())
        force = self._bands[0] * v
        for k, band in enumerate(self._bands[1:], start=1):
            force[:-k] += band * v[k:]
            force[k:] += band * v[:-k]
        force = self._rate * force
        after, before = force.copy(), force.copy()
        inverse = right_jacobian_inverse(turn)
        # log(exp(d) R_t+1 R_tᵀ) = a + Jl^-1 d, and log(R_t+1 R_tᵀ exp(-d)) = a - Jr^-1 d.
        after[:, :3] = (inverse @ force[:, :3, None])[..., 0]
        before[:, :3] = (inverse.swapaxes(1, 2) @ force[:, :3, None])[..., 0]
        edge = np.zeros_like(v[:1])
        return energy, np.concatenate((edge, after)) - np.concatenate((before, edge))

    def linear(self, root: Array, others: Array) -> list[tuple[list[Array], Array]]:
        """Whitened parts of the prior around rotations of the root (T, 3, 3) and the other
        parameters (T, N - 3).

        A part is its K matrices, (S, N, N) each, of rows that follow each other, and its residuals
        (S, N).
        """
        turn, N = log_so3(root[1:] @ root[:-1].swapaxes(1, 2)), self._slow.shape[1]
        count = len(turn)
        rate, slow = self._rate[:count], self._slow[:count]
        v = rate * np.concatenate((turn, others[1:] - others[:-1]), -1)
        to, of = (np.tile(np.eye(N), (count, 1, 1)) for _ in range(2))
        inverse = right_jacobian_inverse(turn)
        to[:, :3, :3], of[:, :3, :3] = inverse.swapaxes(1, 2), inverse
        to, of = to * rate[..., None], -of * rate[..., None]
        found = [
            ([np.sqrt(slow)[..., None] * of, np.sqrt(slow)[..., None] * to], np.sqrt(slow) * v)
        ]
        K = count - len(self._weights) + 1
        if K <= 0:
            return found
        wide = np.sqrt(self._smooth[:K])[..., None]
        matrices = [np.zeros((K, N, N)) for _ in range(len(self._weights) + 1)]
        change = np.zeros((K, N))
        for i, weight in enumerate(self._weights):
            w = wide * weight[:K, :, None]
            matrices[i] += w * of[i : i + K]
            matrices[i + 1] += w * to[i : i + K]
            change += wide[..., 0] * weight[:K] * v[i : i + K]
        return [*found, (matrices, change)]

    def _couplings(self) -> list[Array]:
        """H = V^T M V with difference operator V and banded M; returns the diagonals (T, N), main
        diagonal first.
        """
        edge, rate = np.zeros_like(self._slow[:1]), self._rate
        found = [np.concatenate((edge, 0 * self._slow)) for _ in range(len(self._bands) + 1)]
        for k, band in enumerate(self._bands):  # v_i with v_i+k
            L = len(band)
            across = rate[:L] * rate[k:] * band
            found[k][1 : 1 + L] += across
            found[k][:L] += across
            found[k + 1][:L] -= across
            if k > 0:
                found[k - 1][1 : 1 + L] -= 2 * across if k == 1 else across
        return found


def linked(law: Motion, energy: BodyEnergy, times_s: Array, faster: Array) -> MotionChain:
    """The motion prior along T rows at `times_s` (T,). Where joints accelerate more than people on
    average, `faster` (T - 1, J) times, it is as much wider for the unknowns that move them.
    """
    acceleration, velocity = MotionPrior.default().part(energy.angles)
    T, n = len(times_s), law.order
    step, times = np.full(max(n, T) - 1, np.inf), np.ones((max(n, T) - 1, len(velocity)))
    step[: T - 1], times[: T - 1] = np.diff(times_s), faster[:, nearest_keypoint(energy)]
    fastest = times[: len(times) - n + 1].copy()  # of the steps that an acceleration links
    for k in range(1, n):
        fastest = np.maximum(fastest, times[k : k + len(fastest)])
    return MotionChain(law, acceleration * fastest, velocity * times, step)


def nearest_keypoint(energy: BodyEnergy) -> Index:
    """(N,) for every unknown of a pose the keypoint that it moves with the shortest lever, but for
    tiny ones.
    """
    still = BodyParameters(
        np.zeros((1, 10)), np.zeros((1, 3)), np.zeros((1, 23, 3)), np.zeros((1, 3))
    )
    _, slopes = energy.model.keypoints_with_jacobian(still)
    turns = slopes[0, :, :, 10:82].reshape(slopes.shape[1], 3, 24, 3)
    lever = np.sqrt((turns**2).sum(axis=(1, 3)) / 2)
    # A rotation that moves a keypoint by less per radian, metres, does not decide how fast that
    # keypoint is.
    lever = np.where(lever > 0.05, lever, np.inf)
    nearest = np.where(np.isfinite(lever).any(axis=0), lever.argmin(axis=0), lever[:, 0].argmin())
    return np.concatenate(
        [nearest[:1].repeat(3), (nearest[1:].repeat(3))[energy.angles], nearest[:1].repeat(3)]
    )
