"""Bodies row by row, compiled: points, their Jacobian, and the energy of `body/fitting/energy.py` around them.

A row's unknowns are betas 10, three for each rotation that has a column in `Limbs`, place 3; P in all.
"""

import math

from shapepose_fg.core.compiled import kernel, part


@part
def _copied(source, to):
    """A row of numbers; a slice that is assigned to takes seconds to compile."""
    for i in range(len(source)):
        to[i] = source[i]


@part
def _rotation(x, y, z, R, T):
    """R = exp of an axis-angle, and its right Jacobian T."""
    s = x * x + y * y + z * z
    if s < 1e-4:
        a, b, c = 1 - s / 6 * (1 - s / 20), 0.5 - s / 24 * (1 - s / 30), 1 / 6 - s / 120 * (1 - s / 42)
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
def _put(limbs, betas, place, jacobian, w):
    """World rotations and axes from `local` and `tangent`, points, and their Jacobian.

    An arm is what of a point a bone turns: turning it about an axis a moves the point by a x arm.
    """
    blend = len(limbs.by_pose) > 0
    for q in range(24):
        if q == 0:
            for x in range(3):
                _copied(w.local[0, x], w.world[0, x])
        else:
            _product(w.world[limbs.parent[q]], w.local[q], w.world[q])
        _product(w.world[q], w.tangent[q], w.axes[q])
    for k in range(len(limbs.root)):
        J, first, end, m = w.J[k], limbs.first[k], limbs.first[k + 1], len(betas)
        for x in range(3):
            for n in range(10):
                J[x, n] = limbs.root_by_shape[k, x, n]
            for e in range(207 if blend else 0):
                w.entry[x, e] = 0.0
            for p in range(first, end):
                w.arm[p, x] = 0.0
        for p in range(end - 1, first - 1, -1):  # a bone's arm is whole when its parent takes it
            R = w.world[limbs.bone[p]]
            for y in range(3):
                v = limbs.offset[p, y]
                for n in range(10):
                    v += betas[n] * limbs.by_shape[p, y, n]
                for e in range(207 if blend else 0):
                    bent = w.local[1 + e // 9, e % 9 // 3, e % 3] - (1.0 if e % 9 % 4 == 0 else 0.0)
                    v += limbs.by_pose[p, y, e] * bent
                for x in range(3):
                    w.arm[p, x] += R[x, y] * v
                    for n in range(10 if jacobian else 0):
                        J[x, n] += R[x, y] * limbs.by_shape[p, y, n]
                    for e in range(207 if blend and jacobian else 0):
                        w.entry[x, e] += R[x, y] * limbs.by_pose[p, y, e]
            if p > first:
                for x in range(3):
                    w.arm[limbs.before[p], x] += w.arm[p, x]
        for p in range(first, end):
            q, arm = limbs.bone[p], w.arm[p]
            A = w.axes[q]
            for c in range(3 if jacobian and limbs.column[q] >= 0 else 0):
                w.column[k, m] = limbs.column[q] + c
                J[0, m] = A[1, c] * arm[2] - A[2, c] * arm[1]
                J[1, m] = A[2, c] * arm[0] - A[0, c] * arm[2]
                J[2, m] = A[0, c] * arm[1] - A[1, c] * arm[0]
                if blend and q > 0:
                    _bend(J, m, w.entry, w.local[q], w.tangent[q], q, c)
                m += 1
        for x in range(3):
            w.xyz[k, x] = limbs.root[k, x] + limbs.share[k] * place[x] + w.arm[first, x]
            for n in range(10):
                w.xyz[k, x] += betas[n] * limbs.root_by_shape[k, x, n]
            for y in range(3):
                J[y, m + x] = limbs.share[k] if x == y else 0.0
            w.column[k, m + x] = len(w.gradient) - 3 + x
        for n in range(10):
            w.column[k, n] = n
        w.count[k] = m + 3


@part
def _bend(J, m, entry, L, T, q, c):
    """What turning joint q about its axis c does through the pose blend shapes, of slopes `entry` (3, 207)."""
    x, y, z = T[0, c], T[1, c], T[2, c]
    for i in range(3):
        turned = (L[i, 1] * z - L[i, 2] * y, L[i, 2] * x - L[i, 0] * z, L[i, 0] * y - L[i, 1] * x)
        for j in range(3):
            for a in range(3):
                J[a, m] += entry[a, 9 * q - 9 + 3 * i + j] * turned[j]


@part
def _pull(w, k, f0, f1, f2):
    """The gradient of a force on a point: its Jacobian, transposed, times it."""
    J, column = w.J[k], w.column[k]
    for i in range(w.count[k]):
        w.gradient[column[i]] += f0 * J[0, i] + f1 * J[1, i] + f2 * J[2, i]


@part
def _slope(limbs, priors, free, rows, b, scale, w):
    """The energy of row b, and half its gradient."""
    A, g, c2, energy = len(priors.mean), w.gradient, scale * scale, 0.0
    pose = w.entry[0]
    for q in range(24):
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
    _put(limbs, free[:10], free[13 + A :], len(w.J) > 0, w)
    for i in range(len(g)):
        g[i] = 0.0
    for n in range(10):
        away = free[n] - rows.betas[b, n]
        g[n] = rows.stiffness[b] * away
        energy += g[n] * away
    for i in range(A):
        for j in range(A):
            g[13 + i] += priors.precision[i, j] * (free[13 + j] - rows.angles[b, j])
        energy += g[13 + i] * (free[13 + i] - rows.angles[b, i])
    for k in range(len(w.xyz)):
        S, r0, r1, r2 = rows.root[b, k], w.xyz[k, 0], w.xyz[k, 1], w.xyz[k, 2]
        r0, r1, r2 = r0 - rows.xyz[b, k, 0], r1 - rows.xyz[b, k, 1], r2 - rows.xyz[b, k, 2]
        u0 = S[0, 0] * r0 + S[0, 1] * r1 + S[0, 2] * r2
        u1 = S[1, 0] * r0 + S[1, 1] * r1 + S[1, 2] * r2
        u2 = S[2, 0] * r0 + S[2, 1] * r1 + S[2, 2] * r2
        w.squared[k] = u0 * u0 + u1 * u1 + u2 * u2
        robust = c2 / (c2 + w.squared[k])
        energy += robust * w.squared[k]
        w.weight[k] = v = robust * robust
        if w.squared[k] != 0.0:
            f0 = v * (S[0, 0] * u0 + S[0, 1] * u1 + S[0, 2] * u2)
            f1 = v * (S[1, 0] * u0 + S[1, 1] * u1 + S[1, 2] * u2)
            _pull(w, k, f0, f1, v * (S[2, 0] * u0 + S[2, 1] * u1 + S[2, 2] * u2))
    return energy


@part
def _normal(priors, rows, b, H, w):
    """Half the Gauss-Newton Hessian where `_slope` was last, its lower triangle; below it the gradient and, where
    there is room, the Jacobian and the unit vectors of the betas.
    """
    M, P, A, K = w.entry, len(w.gradient), len(priors.mean), len(w.xyz)
    vectors = len(H) > P + 1
    for i in range(len(H)):
        for j in range(P):
            H[i, j] = 0.0
    for i in range(10):
        H[i, i] = rows.stiffness[b]
        if vectors:
            H[P + 1 + 3 * K + i, i] = 1.0
    for i in range(A):
        for j in range(i + 1):
            H[13 + i, 13 + j] = priors.precision[i, j]
    _copied(w.gradient, H[P])
    for k in range(K):
        S, J, column, m, at = rows.root[b, k], w.J[k], w.column[k], w.count[k], P + 1 + 3 * k
        for x in range(3):
            for y in range(3):
                M[x, y] = w.weight[k] * (S[x, 0] * S[0, y] + S[x, 1] * S[1, y] + S[x, 2] * S[2, y])
        seen = M[0, 0] + M[1, 1] + M[2, 2] > 0.0
        for i in range(m):
            for x in range(3 if vectors else 0):
                H[at + x, column[i]] = J[x, i]
            row = H[column[i]]
            t0 = M[0, 0] * J[0, i] + M[0, 1] * J[1, i] + M[0, 2] * J[2, i]
            t1 = M[1, 0] * J[0, i] + M[1, 1] * J[1, i] + M[1, 2] * J[2, i]
            t2 = M[2, 0] * J[0, i] + M[2, 1] * J[1, i] + M[2, 2] * J[2, i]
            for j in range(i + 1 if seen else 0):  # columns rise
                row[column[j]] += t0 * J[0, j] + t1 * J[1, j] + t2 * J[2, j]


@kernel
def linearised(limbs, priors, free, rows, scale, linear, w):
    """The energy of B rows around `free` (B, P), the robust kernel of each having this `scale` (B,)."""
    for b in range(len(free)):
        linear.energy[b] = _slope(limbs, priors, free[b], rows, b, scale[b], w)
        _copied(w.squared, linear.squared[b])
        _copied(w.gradient, linear.gradient[b])
        for k in range(len(w.xyz)):
            _copied(w.xyz[k], linear.xyz[b, k])
        if len(linear.system) > 0:
            _normal(priors, rows, b, linear.system[b], w)


@part
def _write_jacobian(w, k, jacobian):
    for x in range(3):
        for i in range(jacobian.shape[1]):
            jacobian[x, i] = 0.0
        for i in range(w.count[k]):
            jacobian[x, w.column[k, i]] = w.J[k, x, i]


@kernel
def placed(limbs, local, betas, place, target, information, scale, xyz, gradient, jacobian, w):
    """Points `xyz` (B, K, 3) of bodies with rotations `local` (B, 24, 3, 3), and half the `gradient` (B, P) of the
    robust energy of targets (B, K, 3), of which there may be none; `jacobian` (B, K, 3, P) or (0, K, 3, P).

    Rotations turn in the tangents of the scratch arrays `w`.
    """
    f, r = w.entry[0], w.entry[1]
    for b in range(len(xyz)):
        for q in range(24):
            for x in range(3):
                _copied(local[b, q, x], w.local[q, x])
        _put(limbs, betas[b], place[b], len(jacobian) > 0 or len(target) > 0, w)
        for i in range(len(w.gradient)):
            w.gradient[i] = 0.0
        for k in range(len(w.xyz)):
            _copied(w.xyz[k], xyz[b, k])
            if len(jacobian) > 0:
                _write_jacobian(w, k, jacobian[b, k])
            if len(target) > 0:
                M, squared = information[b, k], 0.0
                for x in range(3):
                    r[x] = w.xyz[k, x] - target[b, k, x]
                for x in range(3):
                    f[x] = M[x, 0] * r[0] + M[x, 1] * r[1] + M[x, 2] * r[2]
                    squared += f[x] * r[x]
                v = (scale * scale / (scale * scale + squared)) ** 2
                _pull(w, k, v * f[0], v * f[1], v * f[2])
        _copied(w.gradient, gradient[b])
