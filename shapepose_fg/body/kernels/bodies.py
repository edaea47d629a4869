"""Compiled kernels for bodies, row by row: points, their Jacobian, the energy of
`body/fitting/energy.py`, and the inputs of the update network.

The P unknowns of a row are 10 betas, three per rotation with a column in `Limbs`, and 3 for the
translation. Gradients are accumulated backwards from the points: a force on a point rotates every
bone above it, by the sum of the torques on the terms (`Limbs`) of that bone and its descendants.
"""

import math

from shapepose_fg.body.kernels.rows import Limbs, Linear, Own, Priors, Rows, Work
from shapepose_fg.core.compiled import kernel, part

REACH_M = 0.1
"""Standard deviation of the current body, m, against which the network weights targets."""
TRUST_M = 0.03
"""Standard deviation of a target that has weight one half, m."""
FAR_M = 0.5
"""Distance, m, above which residuals are compressed for the network."""
STEEP = 3.0
"""Limit of scaled gradients for the network."""


@part
def _copied(source, to):
    """Copy a row of numbers; slice assignment takes seconds to compile."""
    for i in range(len(source)):
        to[i] = source[i]


@part
def _rotation(x, y, z, R, T):
    """R = exp of an axis-angle, and its right Jacobian T."""
    s = x * x + y * y + z * z
    if s < 1e-4:
        a, b, c = (
            1 - s / 6 * (1 - s / 20),
            0.5 - s / 24 * (1 - s / 30),
            1 / 6 - s / 120 * (1 - s / 42),
        )
    else:
        t = math.sqrt(s)
        a, b = math.sin(t) / t, (1 - math.cos(t)) / s
        c = (1 - a) / s
    v = (x, y, z)
    for i in range(3):
        for j in range(3):
            R[i, j], T[i, j] = b * v[i] * v[j], c * v[i] * v[j]
        R[i, i] += 1 - b * s
        T[i, i] += 1 - c * s
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        R[k, j] += a * v[i]
        R[j, k] -= a * v[i]
        T[k, j] -= b * v[i]
        T[j, k] += b * v[i]


@part
def _product(A, B, C):
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@part
def _bent(slope, L, T, q, c):
    """Change of the energy by a rotation of joint q about its axis c, through the pose blend
    shapes; `slope` (207,) is the energy's gradient by the blend shapes' inputs.
    """
    x, y, z, at, total = T[0, c], T[1, c], T[2, c], 9 * q - 9, 0.0
    for i in range(3):
        total += slope[at + 3 * i] * (L[i, 1] * z - L[i, 2] * y)
        total += slope[at + 3 * i + 1] * (L[i, 2] * x - L[i, 0] * z)
        total += slope[at + 3 * i + 2] * (L[i, 0] * y - L[i, 1] * x)
    return total


@part
def _share(M, sigma_m, S):
    """S = I - (I + sigma² M)^-1 for a symmetric M (3, 3), by minors."""
    v = sigma_m * sigma_m
    a, b, c, d, e, f = (
        v * M[0, 0] + 1,
        v * M[0, 1],
        v * M[0, 2],
        v * M[1, 1] + 1,
        v * M[1, 2],
        v * M[2, 2] + 1,
    )
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1 / (a * p + b * q + c * r)
    S[0, 0], S[1, 1], S[2, 2] = (
        1 - scale * p,
        1 - scale * (a * f - c * c),
        1 - scale * (a * d - b * b),
    )
    S[0, 1] = S[1, 0] = -scale * q
    S[0, 2] = S[2, 0] = -scale * r
    S[1, 2] = S[2, 1] = -scale * (b * c - a * e)


@part
def _laid(limbs, betas, place, w):
    """Compute world rotations and axes, and the terms of all points, from `local` and `tangent`;
    clear all forces.
    """
    d, v, xyz = w.inside, w.term, w.xyz
    for q in range(len(w.local)):
        if q == 0:
            for x in range(3):
                _copied(w.local[0, x], w.world[0, x])
        else:
            _product(w.world[limbs.parent[q]], w.local[q], w.world[q])
        _product(w.world[q], w.tangent[q], w.axes[q])
        for x in range(3):
            w.torque[q, x] = 0.0
    for i in range(len(d)):
        d[i] = limbs.offset[i]
        w.force[i] = 0.0
    for i in range(len(xyz)):
        xyz[i], w.push[i] = limbs.root[i], 0.0
    for n in range(len(limbs.by_shape)):
        for i in range(len(d)):
            d[i] += betas[n] * limbs.by_shape[n, i]
        for i in range(len(xyz)):
            xyz[i] += betas[n] * limbs.root_by_shape[n, i]
    if len(limbs.by_pose) > 0:
        for e in range(207):
            w.entry[0, e] = w.local[1 + e // 9, e % 9 // 3, e % 3] - (
                1.0 if e % 9 % 4 == 0 else 0.0
            )
        for i in range(len(d)):
            for e in range(207):
                d[i] += limbs.by_pose[i, e] * w.entry[0, e]
    for k in range(len(limbs.share)):
        x, y, z = limbs.share[k] * place[0], limbs.share[k] * place[1], limbs.share[k] * place[2]
        for p in range(limbs.first[k], limbs.first[k + 1]):
            R, i = w.world[limbs.bone[p]], 3 * p
            v[i] = R[0, 0] * d[i] + R[0, 1] * d[i + 1] + R[0, 2] * d[i + 2]
            v[i + 1] = R[1, 0] * d[i] + R[1, 1] * d[i + 1] + R[1, 2] * d[i + 2]
            v[i + 2] = R[2, 0] * d[i] + R[2, 1] * d[i + 1] + R[2, 2] * d[i + 2]
            x += v[i]
            y += v[i + 1]
            z += v[i + 2]
        xyz[3 * k] += x
        xyz[3 * k + 1] += y
        xyz[3 * k + 2] += z


@part
def _pulled(limbs, k, f0, f1, f2, w):
    """Distribute a force on point k to torques and forces on its terms, and to the translation."""
    v, u, at = w.term, w.force, len(w.gradient) - 3
    for p in range(limbs.first[k], limbs.first[k + 1]):
        R, T, i = w.world[limbs.bone[p]], w.torque[limbs.bone[p]], 3 * p
        T[0] += v[i + 1] * f2 - v[i + 2] * f1
        T[1] += v[i + 2] * f0 - v[i] * f2
        T[2] += v[i] * f1 - v[i + 1] * f0
        u[i] = R[0, 0] * f0 + R[1, 0] * f1 + R[2, 0] * f2
        u[i + 1] = R[0, 1] * f0 + R[1, 1] * f1 + R[2, 1] * f2
        u[i + 2] = R[0, 2] * f0 + R[1, 2] * f1 + R[2, 2] * f2
    w.push[3 * k], w.push[3 * k + 1], w.push[3 * k + 2] = f0, f1, f2
    w.gradient[at] += limbs.share[k] * f0
    w.gradient[at + 1] += limbs.share[k] * f1
    w.gradient[at + 2] += limbs.share[k] * f2


@part
def _gathered(limbs, w):
    """Accumulate the gradient of betas and rotations from the forces on all points."""
    u, g = w.force, w.gradient
    for n in range(len(limbs.by_shape)):
        total = 0.0
        for i in range(len(u)):
            total += limbs.by_shape[n, i] * u[i]
        for i in range(len(w.push)):
            total += limbs.root_by_shape[n, i] * w.push[i]
        g[n] += total
    if len(limbs.by_pose) > 0:
        for e in range(207):
            w.entry[0, e] = 0.0
        for i in range(len(u)):
            for e in range(207):
                w.entry[0, e] += limbs.by_pose[i, e] * u[i]
    for q in range(23, -1, -1):
        A, T, at = w.axes[q], w.torque[q], limbs.column[q]
        for c in range(3 if at >= 0 else 0):
            g[at + c] += A[0, c] * T[0] + A[1, c] * T[1] + A[2, c] * T[2]
            if len(limbs.by_pose) > 0 and q > 0:
                g[at + c] += _bent(w.entry[0], w.local[q], w.tangent[q], q, c)
        for x in range(3 if q > 0 else 0):
            w.torque[limbs.parent[q], x] += T[x]


@part
def _slopes(limbs, w):
    """Jacobian of all points. An arm is the part of a point that a bone rotates: rotation about an
    axis a moves the point by a x arm. Arms overwrite the terms.
    """
    blend = len(limbs.by_pose) > 0
    for k in range(len(limbs.share)):
        J, first, end, m = w.J[k], limbs.first[k], limbs.first[k + 1], 10
        for n in range(len(limbs.by_shape)):
            w.column[k, n] = n
            for x in range(3):
                J[x, n] = limbs.root_by_shape[n, 3 * k + x]
        for e in range(207 if blend else 0):
            w.entry[0, e] = w.entry[1, e] = w.entry[2, e] = 0.0
        for p in range(end - 1, first - 1, -1):  # children before parents
            R, S = w.world[limbs.bone[p]], limbs.shape[p]
            for x in range(len(R)):  # loops of constant length compile slowly
                a, b, c = R[x, 0], R[x, 1], R[x, 2]
                for n in range(S.shape[1]):
                    J[x, n] += a * S[0, n] + b * S[1, n] + c * S[2, n]
                for e in range(207 if blend else 0):
                    B = limbs.by_pose
                    w.entry[x, e] += a * B[3 * p, e] + b * B[3 * p + 1, e] + c * B[3 * p + 2, e]
                if p > first:
                    w.term[3 * limbs.before[p] + x] += w.term[3 * p + x]
        for p in range(first, end):
            q = limbs.bone[p]
            A, a, b, c = w.axes[q], w.term[3 * p], w.term[3 * p + 1], w.term[3 * p + 2]
            for x in range(3 if limbs.column[q] >= 0 else 0):
                w.column[k, m] = limbs.column[q] + x
                J[0, m] = A[1, x] * c - A[2, x] * b
                J[1, m] = A[2, x] * a - A[0, x] * c
                J[2, m] = A[0, x] * b - A[1, x] * a
                for y in range(3 if blend and q > 0 else 0):
                    J[y, m] += _bent(w.entry[y], w.local[q], w.tangent[q], q, x)
                m += 1
        for x in range(3):
            for y in range(3):
                J[y, m + x] = limbs.share[k] if x == y else 0.0
            w.column[k, m + x] = len(w.gradient) - 3 + x
        w.count[k] = m + 3


@part
def _turned(priors, free, w):
    """Rotations and tangents of a row's joints from its unknowns; the root is updated in its own
    tangent.
    """
    A, pose = len(priors.mean), w.entry[0]
    for q in range(len(w.local)):
        for x in range(3):
            i = x - 3 if q == 0 else priors.place[3 * q - 3 + x]
            if q == 0 or i >= 0:
                pose[x] = free[13 + i]
            else:
                pose[x] = priors.at_zero[-1 - i]
                for j in range(A):
                    pose[x] += priors.gain[-1 - i, j] * free[13 + j]
        _rotation(pose[0], pose[1], pose[2], w.local[q], w.tangent[q])
    for i in range(9):
        w.tangent[0, i // 3, i % 3] = 1.0 if i % 4 == 0 else 0.0


@part
def _normal(priors, rows, b, keypoints, H, w):
    """Lower triangle of half the Gauss-Newton Hessian at the last `_slopes`, followed by the
    gradient, the Jacobian of the `keypoints`, and the unit vectors of the betas.
    """
    M, P, A, K, N = w.entry, len(w.gradient), len(priors.mean), len(w.squared), len(keypoints)
    for i in range(len(H)):
        for j in range(P):
            H[i, j] = 0.0
    for i in range(10):
        H[i, i] = rows.stiffness[b]
        H[P + 1 + 3 * N + i, i] = 1.0
    for i in range(A):
        for j in range(i + 1):
            H[13 + i, 13 + j] = priors.precision[i, j]
    _copied(w.gradient, H[P])
    for n in range(N):
        J, column = w.J[keypoints[n]], w.column[keypoints[n]]
        for i in range(w.count[keypoints[n]]):
            for j in range(3):
                H[P + 1 + 3 * n + j, column[i]] = J[j, i]
    for k in range(K):
        J, column, m = w.J[k], w.column[k], w.count[k]
        for i in range(3):
            for j in range(3):
                M[i, j] = w.weight[k] * rows.information[b, k, i, j]
        for i in range(m if M[0, 0] + M[1, 1] + M[2, 2] > 0.0 else 0):
            row, x, y, z = H[column[i]], J[0, i], J[1, i], J[2, i]
            t0 = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z
            t1 = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z
            t2 = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z
            for j in range(10):
                row[j] += t0 * J[0, j] + t1 * J[1, j] + t2 * J[2, j]
            for j in range(10, i + 1, 3):  # after the betas, columns ascend in threes
                at = column[j]
                row[at] += t0 * J[0, j] + t1 * J[1, j] + t2 * J[2, j]
                row[at + 1] += t0 * J[0, j + 1] + t1 * J[1, j + 1] + t2 * J[2, j + 1]
                row[at + 2] += t0 * J[0, j + 2] + t1 * J[1, j + 2] + t2 * J[2, j + 2]


@kernel(Limbs, Priors, "f2", Rows, "f1 i2", Linear, Work)
def linearised(limbs, priors, free, rows, scale, keypoints, linear, w):
    """Linearise the energy of B rows at `free` (B, P), with a scale of the robust kernel per row,
    `scale` (B,); systems include the Jacobians of the `keypoints` (B, N).
    """
    A, g, pose = len(priors.mean), w.gradient, w.entry[0]
    for b in range(len(free)):
        x, energy, c2 = free[b], 0.0, scale[b] * scale[b]
        _turned(priors, x, w)
        _laid(limbs, x, x[13 + A :], w)
        for i in range(len(g)):
            g[i] = 0.0
        for i in range(A):
            pose[i] = x[13 + i] - rows.angles[b, i]
        for i in range(A):
            pull = 0.0
            for j in range(A):
                pull += priors.precision[i, j] * pose[j]
            g[13 + i] = pull
            energy += pull * pose[i]
        for n in range(len(limbs.by_shape)):
            deviation = x[n] - rows.betas[b, n]
            g[n] = rows.stiffness[b] * deviation
            energy += g[n] * deviation
        for k in range(len(w.squared)):
            M, r0, r1, r2 = rows.information[b, k], w.xyz[3 * k], w.xyz[3 * k + 1], w.xyz[3 * k + 2]
            r0, r1, r2 = r0 - rows.xyz[b, k, 0], r1 - rows.xyz[b, k, 1], r2 - rows.xyz[b, k, 2]
            f0 = M[0, 0] * r0 + M[0, 1] * r1 + M[0, 2] * r2
            f1 = M[1, 0] * r0 + M[1, 1] * r1 + M[1, 2] * r2
            f2 = M[2, 0] * r0 + M[2, 1] * r1 + M[2, 2] * r2
            w.squared[k] = r0 * f0 + r1 * f1 + r2 * f2
            robust = c2 / (c2 + w.squared[k])
            energy += robust * w.squared[k]
            w.weight[k] = v = robust * robust
            if w.squared[k] != 0.0:
                _pulled(limbs, k, v * f0, v * f1, v * f2, w)
        _gathered(limbs, w)
        linear.energy[b] = energy
        _copied(w.squared, linear.squared[b])
        _copied(g, linear.gradient[b])
        for i in range(len(w.xyz)):
            linear.xyz[b, i // 3, i % 3] = w.xyz[i]
        if len(linear.system) > 0:
            _slopes(limbs, w)
            _normal(priors, rows, b, keypoints[b], linear.system[b], w)


@kernel(Limbs, "f4 f2 f2 f3 f4", Work)
def placed(limbs, local, betas, place, xyz, jacobian, w):
    """Compute points `xyz` (B, K, 3) of bodies with rotations `local` (B, 24, 3, 3), and their
    `jacobian` (B, K, 3, P), or none if it is (0, K, 3, P). Rotations are updated in the tangents of
    the workspace `w`.
    """
    for b in range(len(xyz)):
        for q in range(len(w.local)):
            for x in range(3):
                _copied(local[b, q, x], w.local[q, x])
        _laid(limbs, betas[b], place[b], w)
        for i in range(len(w.xyz)):
            xyz[b, i // 3, i % 3] = w.xyz[i]
        if len(jacobian) > 0:
            _slopes(limbs, w)
            for k in range(len(limbs.share)):
                for x in range(jacobian.shape[2]):
                    for i in range(jacobian.shape[3]):
                        jacobian[b, k, x, i] = 0.0
                    for i in range(w.count[k]):
                        jacobian[b, k, x, w.column[k, i]] = w.J[k, x, i]


@kernel(Limbs, Own, "f2 f4 f2 f3 f4 f0 f1 s2", Work)
def seen(limbs, own, betas, local, place, target, information, kernel_scale, steepness, inputs, w):
    """Fill in the network's `inputs` (B, 574) for B bodies, `betas` (B, 10), `local` (B, 24, 3, 3)
    rotations and `place` (B, 3), with targets (B, N, 3) of `information` (B, N, 3, 3). Gradients of
    the targets' robust energy are multiplied by `steepness` (79,). `own` assigns targets to points,
    with the offsets of the detector's points.
    """
    S, K, g = w.entry, len(limbs.share), w.gradient
    for b in range(len(betas)):
        row = inputs[b]
        for q in range(len(w.local)):
            for x in range(3):
                _copied(local[b, q, x], w.local[q, x])
        _laid(limbs, betas[b], place[b], w)
        for i in range(len(g)):
            g[i] = 0.0
        for k in range(K):
            t, at, R, o = own.target[k], 7 * k, w.world[own.bone[k]], own.offset[k]
            for y in range(3):
                row[at + y] = w.xyz[3 * k + y] - R[y, 0] * o[0] - R[y, 1] * o[1] - R[y, 2] * o[2]
                row[at + 3 + y] = 0.0
            row[at + 6] = 0.0
            if t >= 0:
                M = information[b, t]
                a0, a1, a2 = w.xyz[3 * k], w.xyz[3 * k + 1], w.xyz[3 * k + 2]
                a0, a1, a2 = target[b, t, 0] - a0, target[b, t, 1] - a1, target[b, t, 2] - a2
                _share(M, TRUST_M, S)
                row[at + 6] = (S[0, 0] + S[1, 1] + S[2, 2]) / 3
                _share(M, REACH_M, S)
                s0 = S[0, 0] * a0 + S[0, 1] * a1 + S[0, 2] * a2
                s1 = S[1, 0] * a0 + S[1, 1] * a1 + S[1, 2] * a2
                s2 = S[2, 0] * a0 + S[2, 1] * a1 + S[2, 2] * a2
                near = 1 / (1 + math.sqrt(s0 * s0 + s1 * s1 + s2 * s2) / FAR_M)
                row[at] += near * s0
                row[at + 1] += near * s1
                row[at + 2] += near * s2
                row[at + 3], row[at + 4], row[at + 5] = 5 * near * s0, 5 * near * s1, 5 * near * s2
                f0 = M[0, 0] * a0 + M[0, 1] * a1 + M[0, 2] * a2
                f1 = M[1, 0] * a0 + M[1, 1] * a1 + M[1, 2] * a2
                f2 = M[2, 0] * a0 + M[2, 1] * a1 + M[2, 2] * a2
                squared = a0 * f0 + a1 * f1 + a2 * f2
                v = kernel_scale * kernel_scale / (kernel_scale * kernel_scale + squared)
                if squared != 0.0:
                    _pulled(limbs, k, v * v * f0, v * v * f1, v * v * f2, w)
        _gathered(limbs, w)
        at = 7 * K
        for n in range(betas.shape[1]):
            row[at + n] = betas[b, n] / 3
        for q in range(22):
            for x in range(3):
                row[at + 10 + 6 * q + x], row[at + 13 + 6 * q + x] = (
                    local[b, q, x, 0],
                    local[b, q, x, 1],
                )
        for x in range(3):
            row[at + 142 + x] = place[b, x]
        for i in range(79):  # descent direction, without the hands
            row[at + 145 + i] = min(max(g[i if i < 76 else i + 6] * steepness[i], -STEEP), STEEP)
