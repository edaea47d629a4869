"""Compiled kernels of stage II: measurements of views about joints, and joints as chains of states.

N are rows, T frames, J joints, V views, C chains. `cameras` (S, V, 3, 4) are K [R | t] of each
view; S is 1 for static cameras, else the number of rows.
"""

import math

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.compiled import kernel, part
from shapepose_fg.core.kernel_geometry import ROBUST, add_view, project, robust_weight, triangulated

_GEMAN_MCCLURE = ROBUST["geman_mcclure"]
_SINGULAR = 1e-11
"""Relative size of a pivot below which it is rounding: the state is undetermined."""


def ready(values: Array) -> Array:
    """Return an array as kernels require: another type or order, or a read-only array, would
    compile them again.
    """
    return np.require(values, np.float64, ("C", "W"))


@kernel("f4 f2 f4 f3 f0 f0 f0 f3")
def complete(cameras, focal, xy, confidence, scale_m, reach_m, least_depth, points):
    """Fill in `points` (N, J, 3) that are NaN if at least two views see and agree on them
    (`gated_views.triangulate`).
    """
    weight, x = np.empty(xy.shape[2]), np.empty(3)
    for n in range(len(points)):
        at = n if len(cameras) > 1 else 0
        for j in range(points.shape[1]):
            seen = 0
            for v in range(xy.shape[2]):
                if confidence[n, j, v] > 0.0:
                    seen += 1
            if seen < 2 or not math.isnan(points[n, j, 0] + points[n, j, 1] + points[n, j, 2]):
                continue
            agree = triangulated(
                cameras[at],
                focal[at],
                xy[n, j],
                confidence[n, j],
                scale_m,
                reach_m,
                least_depth,
                weight,
                x,
            )
            if agree >= 2:
                points[n, j, 0], points[n, j, 1], points[n, j, 2] = x[0], x[1], x[2]


@part
def add_detection(
    x, camera, focal, at, sigma, fixed_depth, least_depth, reach, by_reach, robust, width, H, g
):
    """Add the measurement of a detection `at` (2,), with `sigma` in pixels, to the information and
    gradient of a joint at `x`, if it is within `reach`; returns whether it is, and the residual,
    NaN for a joint too near to or behind the camera. With `by_reach` all are, under a Geman-McClure
    kernel of that width.
    """
    u, v, depth = project(camera, x)
    if not depth >= least_depth:
        return False, np.nan, np.nan
    to_u, to_v = u - at[0], v - at[1]
    far, reach_px = (
        to_u * to_u + to_v * to_v,
        reach * focal / (fixed_depth if fixed_depth > 0.0 else depth),
    )
    if not (by_reach or math.sqrt(far) < reach_px):
        return False, to_u, to_v
    weight = 1.0 / (sigma * sigma)
    if by_reach:
        weight *= robust_weight(_GEMAN_MCCLURE, far / (reach_px * reach_px))
    else:
        weight *= robust_weight(robust, far * weight / (width * width))
    add_view(camera, u, v, depth, to_u, to_v, weight, H, g)
    return True, to_u, to_v


@kernel("f3 f4 f2 f4 f3 f0 f0 f0 b0 i0 f0 b3 f4 f4 f3")
def gate_and_linearise(
    points, cameras, focal, xy, sigmas, fixed_depth, least_depth, reach, by_reach, robust, width,
    inlier, residual, information, gradient,
):  # fmt: skip
    """Kernel of `gated_views.linearise`; fills in the last four arrays, initially false, NaN, and
    zeros.

    `sigmas` (N, J, V) are 0 if not seen; `focal` (S, V) pixels. `reach` is that of the gate, or
    with `by_reach` of the Geman-McClure kernel, metres.
    """
    N, J, V = sigmas.shape
    for n in range(N):
        for j in range(J):
            x, H, g = points[n, j], information[n, j], gradient[n, j]
            for v in range(V):
                if sigmas[n, j, v] > 0.0:
                    camera = cameras[n if cameras.shape[0] > 1 else 0, v]
                    of_view = focal[n if focal.shape[0] > 1 else 0, v], xy[n, j, v], sigmas[n, j, v]
                    inlier[n, j, v], residual[n, j, v, 0], residual[n, j, v, 1] = add_detection(
                        x,
                        camera,
                        *of_view,
                        fixed_depth,
                        least_depth,
                        reach,
                        by_reach,
                        robust,
                        width,
                        H,
                        g,
                    )


@part
def _factored(H, below, Z):
    """Block Cholesky of a chain, in place: H_t = L_t L_t^T, Z_t = L_t^-1 B_t^T. Returns False if it
    is singular.
    """
    T, d = H.shape[:2]
    for t in range(T):
        L = H[t]
        for k in range(d):
            pivot = L[k, k]
            for a in range(k):
                pivot -= L[k, a] * L[k, a]
            if not pivot > _SINGULAR * L[k, k]:
                return False
            L[k, k] = math.sqrt(pivot)
            for b in range(k + 1, d):
                total = L[b, k]
                for a in range(k):
                    total -= L[b, a] * L[k, a]
                L[b, k] = total / L[k, k]
        if t + 1 < T:
            after = Z[t]
            for k in range(d):
                for b in range(d):
                    after[k, b] = below[t, b, k]
                for a in range(k):
                    for b in range(d):
                        after[k, b] -= L[k, a] * after[a, b]
                for b in range(d):
                    after[k, b] /= L[k, k]
            for k in range(d):
                for a in range(d):
                    for b in range(a + 1):
                        H[t + 1, a, b] -= after[k, a] * after[k, b]
    return True


@part
def _solve(H, Z, g, x):
    """Solve with blocks of `_factored` and the right side `g` (T + 1, d), overwritten, and store
    the solution in `x` (T, d).
    """
    T, d = x.shape
    for t in range(T):
        for k in range(d):
            total = g[t, k]
            for a in range(d):
                total -= Z[t - 1, a, k] * g[t - 1, a]
            for a in range(k):
                total -= H[t, k, a] * g[t, a]
            g[t, k] = total / H[t, k, k]
    for t in range(T - 1, -1, -1):
        for k in range(d - 1, -1, -1):
            total = g[t, k]
            for a in range(d):
                total -= Z[t, k, a] * g[t + 1, a]
            for a in range(k + 1, d):
                total -= H[t, a, k] * g[t, a]
            x[t, k] = g[t, k] = total / H[t, k, k]


@part
def _marginals(H, Z, M, G, S, covariance):
    """Diagonal blocks of the inverse after `_factored`, `covariance` (T, d, d), by backward
    recursion.
    """
    T, d = H.shape[:2]
    for t in range(T - 1, -1, -1):
        for k in range(d):  # M = L^-T, upper
            for b in range(k, d):
                total = 1.0 if b == k else 0.0
                for a in range(k, b):
                    total -= H[t, b, a] * M[k, a]
                M[k, b] = total / H[t, b, b]
        for a in range(d):
            for b in range(d):
                G[0, a, b] = 0.0
                for k in range(a, d):
                    G[0, a, b] += M[a, k] * Z[t, k, b]
            for b in range(d):
                G[1, a, b] = 0.0
                for k in range(d):
                    G[1, a, b] += G[0, a, k] * S[k, b]
        for a in range(d):
            for b in range(a + 1):
                total = 0.0
                for k in range(d):
                    total += G[1, a, k] * G[0, b, k]
                for k in range(a, d):
                    total += M[a, k] * M[b, k]
                S[a, b] = S[b, a] = total
        for a in range(d):
            for b in range(d):
                covariance[t, a, b] = S[a, b]


@kernel("f4 f4 f4 f4 f4")
def solve_chains(diagonal, below, right, states, covariance):
    """The `states` (A, C, T, d) of C independent chains, the same along each of A axes, and their
    marginal `covariance` (C, T, d, d); NaN for singular chains.

    A chain's cost is x^T H x / 2 - right^T x, with H block tridiagonal of `diagonal` (C, T, d, d)
    and `below` (C, T - 1, d, d), and `right` (A, C, T, d).
    """
    A, C, T, d = states.shape
    # Zeros at the end of Z and g stand for the missing neighbours of the first and last state.
    H, Z, g = np.empty((T, d, d)), np.zeros((T, d, d)), np.zeros((T + 1, d))
    M, G, S = np.empty((d, d)), np.empty((2, d, d)), np.zeros((d, d))
    for c in range(C):
        for t in range(T):
            for a in range(d):
                for b in range(d):
                    H[t, a, b] = diagonal[c, t, a, b]
        if not _factored(H, below[c], Z):
            states[:, c, :, :] = np.nan
            covariance[c, :, :, :] = np.nan
            continue
        for axis in range(A):
            for t in range(T):
                for a in range(d):
                    g[t, a] = right[axis, c, t, a]
            _solve(H, Z, g, states[axis, c])
        _marginals(H, Z, M, G, S, covariance[c])
