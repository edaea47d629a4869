"""Compiled kernels for the normal equations of bodies: steps, covariances, and chains of rows.

A system (P + 1 + 3 N + 10, P) is in the form of `linearised` (`body/kernels/bodies.py`): the lower
triangle of a Hessian H, and vectors below it. It is reduced in place to the Cholesky factor L, H =
L Lᵀ, and L^-1 times the vectors, by scalar products of rows.
"""

import math

import numpy as np

from shapepose_fg.core.compiled import kernel, part

LIMB_M = 0.4
"""Radius of the path of a swinging limb's end, m, for the curvature that linearisation neglects.
Chosen so that hidden wrists, arms and legs of held-out motions lie within their covariances."""

_FIRST = np.intp(0)
"""A literal 0 would compile the functions again."""


@part
def _reduced(H, n, first, end):
    """Reduce the rows `first` to `end` of a system with n unknowns; returns False if H is not
    positive definite.
    """
    for i in range(first, end, 4):
        stop, begin = min(i + 4, end), 0
        if stop == i + 4:  # four rows and two columns at a time
            begin = min(i, n) // 2 * 2
            for j in range(0, begin, 2):
                a, b, c, d, e, f, g, h = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for p in range(j):
                    v, w = H[j, p], H[j + 1, p]
                    a += H[i, p] * v
                    b += H[i + 1, p] * v
                    c += H[i + 2, p] * v
                    d += H[i + 3, p] * v
                    e += H[i, p] * w
                    f += H[i + 1, p] * w
                    g += H[i + 2, p] * w
                    h += H[i + 3, p] * w
                v, w, scale = 1 / H[j, j], H[j + 1, j], 1 / H[j + 1, j + 1]
                a, b, c, d = (
                    (H[i, j] - a) * v,
                    (H[i + 1, j] - b) * v,
                    (H[i + 2, j] - c) * v,
                    (H[i + 3, j] - d) * v,
                )
                H[i, j], H[i + 1, j], H[i + 2, j], H[i + 3, j] = a, b, c, d
                H[i, j + 1] = (H[i, j + 1] - e - a * w) * scale
                H[i + 1, j + 1] = (H[i + 1, j + 1] - f - b * w) * scale
                H[i + 2, j + 1] = (H[i + 2, j + 1] - g - c * w) * scale
                H[i + 3, j + 1] = (H[i + 3, j + 1] - h - d * w) * scale
        for r in range(i, stop):
            for j in range(begin, min(r + 1, n)):
                total = H[r, j]
                for p in range(j):
                    total -= H[r, p] * H[j, p]
                if r > j:
                    H[r, j] = total / H[j, j]
                elif total > 0.0:
                    H[r, j] = math.sqrt(total)
                else:
                    return False
    return True


@part
def _back(H, n, row, step):
    """Set `step` = -L^-T times a row."""
    for k in range(n):
        step[k] = -H[row, k]
    for k in range(n - 1, -1, -1):
        step[k] /= H[k, k]
        for j in range(k):
            step[j] -= step[k] * H[k, j]


@part
def _products(Y, first, count, n, out):
    """Set `out` to the scalar products of `count` rows (n,) of Y, from `first` on."""
    for i in range(count):
        for j in range(i + 1):
            total = 0.0
            for p in range(n):
                total += Y[first + i, p] * Y[first + j, p]
            out[i, j] = out[j, i] = total


@kernel("f3")
def reduce_systems(system):
    """Reduce B systems (B, M, P) completely."""
    for b in range(len(system)):
        _reduced(system[b], system.shape[2], _FIRST, system.shape[1])


@kernel("f3 f1 f2 f1")
def solved(system, damping, step, promised):
    """Reduce the Hessians of B systems, with diagonals increased by the factor `damping` (B,), and
    their gradients; fill in the `step` (B, P) and the predicted decrease of the energy `promised`
    (B,), NaN if H is not positive definite. With negative damping the Hessian is reduced already
    and only the gradient is new.

    There is no prior on the root's rotation and position: for cases in which too few joints
    determine them, weak ones of one radian and one metre are added.
    """
    P = step.shape[1]
    for b in range(len(system)):
        H, lower, new = system[b], 0.0, damping[b] >= 0
        for i in range(P if new else 0):
            H[i, i] += damping[b] * H[i, i] + (1.0 if 10 <= i < 13 or i >= P - 3 else 0.0)
        if not _reduced(H, P, 0 if new else P, P + 1):
            lower = math.nan
        for i in range(P):
            lower += H[P, i] * H[P, i]
        _back(H, P, P, step[b])
        promised[b] = lower


@part
def _with_sag(C, at):
    """Add the neglected curvature to a covariance. To first order a swinging limb moves in a plane,
    in reality on a sphere: the sag tr(A) / (2 LIMB_M) of a joint's covariance A is added as a
    standard deviation along every axis, so that a hidden wrist is not a thin disc.
    """
    sag = (C[at, at] + C[at + 1, at + 1] + C[at + 2, at + 2]) / (2 * LIMB_M)
    for x in range(at, at + 3):
        C[x, x] += sag * sag


@kernel("f3 f4 f3")
def known(system, covariance, shape):
    """From B systems with reduced Hessians: the `covariance` (B, N, 3, 3) of their joints
    (Laplace), m², including `_with_sag`, and that of the betas, `shape` (B, 10, 10). Reduces the
    rest of the systems.
    """
    for b in range(len(system)):
        H, P, K = system[b], system.shape[2], covariance.shape[1]
        _reduced(H, P, P + 1, len(H))
        for k in range(K):
            C = covariance[b, k]
            _products(H, P + 1 + 3 * k, len(C), P, C)
            _with_sag(C, len(C) - 3)
        _products(H, P + 1 + 3 * K, shape.shape[1], P, shape[b])


@kernel("f3 f3 f2 f3 f2 f0 f3 f2")
def eliminated(system, turn, diagonal, beyond, pull, damping, kept, front):
    """Eliminate the rows of a chain in order, each with N unknowns besides the common betas.

    `system` (T, P + 1, P) are the rows' Hessians and gradients, for the root in its own tangents,
    which `turn` (T, 3, 3) rotates to those of the world. Links add a `diagonal` (T, N), couplings
    `beyond` (T, N, n) with the next n rows, of each unknown with itself only, and the gradient
    `pull` (T, N). All diagonals are increased by the factor `damping`. `front` (M, M), initially
    zero, is the frontal matrix: the current row, the n rows after it, and 11 right-hand sides, the
    gradient and the couplings with the betas. In the end its last rows have the system of the
    betas, with all poses eliminated. `kept` (T, M, N) is the factor, for `put_back`.
    """
    (T, N, n), M = beyond.shape, len(front)
    P, rhs, last = N + 10, M - 11, M - 11 - N
    for t in range(T):
        H, K, R = system[t], kept[t], turn[t]
        for i in range(N):
            for j in range(i + 1):
                K[i, j] = H[10 + i, 10 + j]
        for j in range(N):
            K[rhs, j] = H[P, 10 + j]
            for m in range(10):
                K[rhs + 1 + m, j] = H[10 + j, m]
        K[0, 1], K[0, 2], K[1, 2] = K[1, 0], K[2, 0], K[2, 1]
        for i in range(M):
            if i < N or i >= rhs:
                a, b, c = K[i, 0], K[i, 1], K[i, 2]
                for x in range(3):
                    K[i, x] = R[x, 0] * a + R[x, 1] * b + R[x, 2] * c
        for j in range(3):
            a, b, c = K[0, j], K[1, j], K[2, j]
            for x in range(3):
                K[x, j] = R[x, 0] * a + R[x, 1] * b + R[x, 2] * c
        for i in range(N):
            K[i, i] = (K[i, i] + diagonal[t, i]) * (1 + damping)
            K[rhs, i] += pull[t, i]
        for i in range(M):
            for j in range(min(i + 1, N)):
                K[i, j] = front[i, j] + (0.0 if N <= i < rhs else K[i, j])
        for b in range(min(n, T - 1 - t)):
            for j in range(N):
                K[N + b * N + j, j] += beyond[t, j, b]
        for m in range(10):
            front[rhs + 1 + m, rhs] += H[P, m]
            for j in range(m + 1):
                front[rhs + 1 + m, rhs + 1 + j] += H[m, j]
        if not _reduced(K, N, _FIRST, M):
            front[M - 1, M - 1] = math.nan  # spreads to all that follows
        for i in range(N, M, 4):
            stop = min(i + 4, M)
            even = N + (i - N) // 2 * 2 if stop == i + 4 else N
            for j in range(N, even, 2):
                a, b, c, d, e, f, g, h = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for p in range(K.shape[1]):
                    v, w = K[j, p], K[j + 1, p]
                    a += K[i, p] * v
                    b += K[i + 1, p] * v
                    c += K[i + 2, p] * v
                    d += K[i + 3, p] * v
                    e += K[i, p] * w
                    f += K[i + 1, p] * w
                    g += K[i + 2, p] * w
                    h += K[i + 3, p] * w
                front[i, j] -= a
                front[i + 1, j] -= b
                front[i + 2, j] -= c
                front[i + 3, j] -= d
                front[i, j + 1] -= e
                front[i + 1, j + 1] -= f
                front[i + 2, j + 1] -= g
                front[i + 3, j + 1] -= h
            for r in range(i, stop):
                for j in range(even, r + 1):
                    a = 0.0
                    for p in range(N):
                        a += K[r, p] * K[j, p]
                    front[r, j] -= a
        for i in range(N, M):  # shift to the next row
            to = i if i >= rhs else i - N
            for j in range(N, min(i + 1, rhs)):
                front[to, j - N] = front[i, j]
        for i in range(last, M):
            for j in range(last if i >= rhs else 0, rhs):
                front[i, j] = 0.0


@kernel("f3 f1 f2")
def put_back(kept, coefficients, step):
    """Back-substitution after `eliminated`: the `step` (T, N), with right-hand sides weighted by
    `coefficients` (11,).
    """
    (T, N), M = step.shape, kept.shape[1]
    for t in range(T - 1, -1, -1):
        K, s, rhs = kept[t], step[t], M - 11
        for p in range(N):
            s[p] = 0.0
        for i in range(N, M):
            after = t + i // N
            v = coefficients[i - rhs] if i >= rhs else (step[after, i % N] if after < T else 0.0)
            for p in range(N):
                s[p] -= v * K[i, p]
        for k in range(N - 1, -1, -1):
            s[k] /= K[k, k]
            for j in range(k):
                s[j] -= s[k] * K[k, j]
