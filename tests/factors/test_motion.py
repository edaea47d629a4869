"""Motion and lasting offsets: against a Kalman smoother written out in NumPy, numeric Jacobians,
and the truth.
"""

import gtsam
import numpy as np
import pytest

from factors import (
    assert_jacobian,
    assert_zero_at_truth,
    isotropic,
    joint_keys,
    lasting_difference_factors,
    lasting_prior_factors,
    motion_covariance,
    motion_factors,
    offset_factors,
    offset_keys,
    reported_keys,
    velocity_keys,
)

TIMES = np.array([0.0, 0.04, 0.08, 0.2, 0.24, 0.9, 0.94, 1.0])
"""Steps of 0.04 s, a gap and what follows."""
T = len(TIMES)
KEYS, SPEEDS, OFFSETS = (
    make(2, 4, np.arange(T)) for make in (joint_keys, velocity_keys, offset_keys)
)


def values_of(x, v=None, b=None) -> gtsam.Values:
    values = gtsam.Values()
    for keys, points in ((KEYS, x), (SPEEDS, v), (OFFSETS, b)):
        for key, point in zip(
            keys.tolist(), () if points is None else points, strict=points is not None
        ):
            values.insert(key, np.asarray(point, dtype=float))
    return values


def solved(factors, values) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph, gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()


def smoothed(transition, process, prior, observations):
    """Means and covariances (T, n), (T, n, n) of a linear Gaussian chain: Kalman filter and RTS
    smoother, in NumPy.

    `transition(i)`, `process(i)` lead from state i to i + 1; `prior` is the first state's (mean,
    covariance); `observations[i]` is (H, R, z), or None.
    """
    mean, cov = prior
    filtered, predicted = [], []
    for i, seen in enumerate(observations):
        if i > 0:
            A = transition(i - 1)
            mean, cov = A @ mean, A @ cov @ A.T + process(i - 1)
        predicted.append((mean, cov))
        if seen is not None:
            H, R, z = seen
            gain = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + R)
            mean, cov = mean + gain @ (z - H @ mean), cov - gain @ H @ cov
        filtered.append((mean, cov))
    means, covs = [filtered[-1][0]], [filtered[-1][1]]
    for i in range(len(observations) - 2, -1, -1):
        gain = filtered[i][1] @ transition(i).T @ np.linalg.inv(predicted[i + 1][1])
        means.insert(0, filtered[i][0] + gain @ (means[0] - predicted[i + 1][0]))
        covs.insert(0, filtered[i][1] + gain @ (covs[0] - predicted[i + 1][1]) @ gain.T)
    return np.array(means), np.array(covs)


def test_a_straight_flight_has_no_error():
    velocity = np.array([1.0, -2.0, 0.5])
    values = values_of(TIMES[:, None] * velocity, np.tile(velocity, (T, 1)))
    for factor in motion_factors(KEYS, SPEEDS, TIMES, 3.0):
        assert_zero_at_truth(factor, values)


def test_the_jacobian_is_the_numeric_one():
    rng = np.random.default_rng(0)
    values = values_of(rng.normal(size=(T, 3)), rng.normal(size=(T, 3)))
    for factor in motion_factors(KEYS, SPEEDS, TIMES, np.linspace(1, 4, T - 1)):
        assert_jacobian(factor, values)


def test_the_noise_is_that_of_white_acceleration():
    """Whitened, the factor's residual is that of the covariance written out, for steps of any
    length.
    """
    rng = np.random.default_rng(1)
    x, v = rng.normal(size=(T, 3)), rng.normal(size=(T, 3))
    values = values_of(x, v)
    for i, factor in enumerate(motion_factors(KEYS, SPEEDS, TIMES, 2.0)):
        dt = TIMES[i + 1] - TIMES[i]
        residual = np.concatenate([x[i + 1] - x[i] - dt * v[i], v[i + 1] - v[i]])
        expected = 0.5 * residual @ np.linalg.solve(motion_covariance(dt, 2.0), residual)
        assert factor.error(values) == pytest.approx(expected, rel=1e-9)


def test_smoothing_is_the_kalman_smoother_s():
    """Positions seen with noise, two of them not at all; velocity at first 0 +- 2 m/s."""
    rng = np.random.default_rng(2)
    z, sigma, q = rng.normal(size=(T, 3)), 0.02, np.linspace(0.5, 5.0, T - 1)
    seen = np.array([True, True, False, True, True, False, True, True])
    factors = motion_factors(KEYS, SPEEDS, TIMES, q)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
    factors += [gtsam.PriorFactorPoint3(int(KEYS[i]), z[i], noise) for i in np.flatnonzero(seen)]
    factors.append(
        gtsam.PriorFactorPoint3(
            int(SPEEDS[0]), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 2.0)
        )
    )
    graph, solution = solved(factors, values_of(np.zeros((T, 3)), np.zeros((T, 3))))

    def transition(i):
        return np.block([[np.eye(3), np.diff(TIMES)[i] * np.eye(3)], [np.zeros((3, 3)), np.eye(3)]])

    H, far = np.eye(3, 6), 1e6
    means, covs = smoothed(
        transition,
        lambda i: motion_covariance(np.diff(TIMES)[i], q[i]),
        (np.zeros(6), np.diag([far] * 3 + [4.0] * 3)),
        [(H, sigma**2 * np.eye(3), z[i]) if seen[i] else None for i in range(T)],
    )
    marginals = gtsam.Marginals(graph, solution)
    for i in range(T):
        # The filter starts from a prior of 1 km, the graph from none: a relative 1e-9 of it.
        np.testing.assert_allclose(solution.atPoint3(int(KEYS[i])), means[i, :3], atol=1e-6)
        np.testing.assert_allclose(solution.atPoint3(int(SPEEDS[i])), means[i, 3:], atol=1e-5)
        np.testing.assert_allclose(
            marginals.marginalCovariance(int(KEYS[i])), covs[i, :3, :3], rtol=1e-4, atol=1e-9
        )
        np.testing.assert_allclose(
            marginals.marginalCovariance(int(SPEEDS[i])), covs[i, 3:, 3:], rtol=1e-4, atol=1e-7
        )


def test_an_offset_is_zero_where_the_message_is_right():
    truth = np.random.default_rng(3).normal(size=(T, 3))
    values = values_of(truth, b=np.zeros((T, 3)))
    factors = lasting_prior_factors(KEYS, OFFSETS, truth, np.tile(np.eye(3), (T, 1, 1)), 0.2)
    for factor in [*factors, *offset_factors(OFFSETS, TIMES, 0.5)]:
        assert factor.error(values) == pytest.approx(0.0, abs=1e-12)


def test_errors_that_last_are_filtered_as_such():
    """A joint that stands still, a message with a lasting error: state (x, offset), against the
    smoother in NumPy.

    The last two messages are missing, and the joint itself is seen at the first three times only.
    """
    rng = np.random.default_rng(4)
    m, share, tau, sigma = rng.normal(size=(T, 3)), 0.2, 0.4, 0.01
    root = np.linalg.cholesky(np.array([[9.0, 2, 1], [2, 8, 0], [1, 0, 6]]))
    root = root @ root.T  # symmetric, 1/m
    roots = np.array([root * (1 + 0.1 * i) for i in range(T)])
    told = T - 2
    factors = lasting_prior_factors(KEYS[:told], OFFSETS[:told], m[:told], roots[:told], share)
    factors += offset_factors(OFFSETS, TIMES, tau)
    hold = gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)
    factors += [
        gtsam.BetweenFactorPoint3(a, b, np.zeros(3), hold)
        for a, b in zip(KEYS[:-1].tolist(), KEYS[1:].tolist(), strict=True)
    ]
    seen = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
    factors += [gtsam.PriorFactorPoint3(int(KEYS[i]), np.zeros(3), seen) for i in range(3)]
    factors.append(
        gtsam.PriorFactorPoint3(int(KEYS[0]), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1.0))
    )
    graph, solution = solved(factors, values_of(np.zeros((T, 3)), b=np.zeros((T, 3))))
    kept = np.exp(-np.diff(TIMES) / tau)
    eye, zero = np.eye(3), np.zeros((3, 3))

    def observation(i):
        # r = R (x - m) - sqrt(1 - w) b ~ N(0, w): R m seen through [R, -sqrt(1 - w)].
        rows = (
            [(np.hstack([roots[i], -np.sqrt(1 - share) * eye]), share * eye, roots[i] @ m[i])]
            if i < told
            else []
        )
        rows += [(np.hstack([eye, zero]), sigma**2 * eye, np.zeros(3))] if i < 3 else []
        if len(rows) == 0:
            return None
        H, z = np.vstack([row[0] for row in rows]), np.concatenate([row[2] for row in rows])
        R = np.zeros((len(z), len(z)))
        for n, row in enumerate(rows):
            R[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] = row[1]
        return H, R, z

    means, covs = smoothed(
        lambda i: np.block([[eye, zero], [zero, kept[i] * eye]]),
        lambda i: np.block([[1e-8 * eye, zero], [zero, (1 - kept[i] ** 2) * eye]]),
        (np.zeros(6), np.eye(6)),
        [observation(i) for i in range(T)],
    )
    marginals = gtsam.Marginals(graph, solution)
    for i in range(T):
        np.testing.assert_allclose(solution.atPoint3(int(KEYS[i])), means[i, :3], atol=1e-7)
        np.testing.assert_allclose(solution.atPoint3(int(OFFSETS[i])), means[i, 3:], atol=1e-6)
        for key, block in ((KEYS[i], slice(0, 3)), (OFFSETS[i], slice(3, 6))):
            found = marginals.marginalCovariance(int(key))
            np.testing.assert_allclose(found, covs[i, block, block], rtol=1e-5, atol=1e-9)


def test_a_message_told_often_is_no_surer_than_told_once():
    """A hundred times in a hundred milliseconds, with an error that lasts for seconds: about the
    lasting share.
    """
    times = np.linspace(0, 0.1, 100)
    keys, offsets = joint_keys(0, 0, np.arange(100)), offset_keys(0, 0, np.arange(100))
    roots = np.tile(np.eye(3) / 0.1, (100, 1, 1))
    factors = lasting_prior_factors(keys, offsets, np.zeros((100, 3)), roots, 0.2)
    factors += offset_factors(offsets, times, 5.0)
    hold = gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)
    ends = zip(keys[:-1].tolist(), keys[1:].tolist(), strict=True)
    factors += [gtsam.BetweenFactorPoint3(a, b, np.zeros(3), hold) for a, b in ends]
    values = gtsam.Values()
    for key in [*keys.tolist(), *offsets.tolist()]:
        values.insert(key, np.zeros(3))
    graph, solution = solved(factors, values)
    sigma = np.sqrt(gtsam.Marginals(graph, solution).marginalCovariance(int(keys[50]))[0, 0])
    # sqrt(0.8) of 10 cm lasts; of the 20 % that do not, a hundredth is left.
    assert sigma == pytest.approx(0.1 * np.sqrt(0.8 + 0.2 / 100), rel=0.02)


def test_two_messages_about_one_joint_both_count():
    """At 0 and at 1 m, the second twice as sure: at 0.8 m, known as five messages are."""
    means, roots = [[0, 0, 0], [1, 1, 1]], np.stack([np.eye(3), 2 * np.eye(3)]) / 0.1
    factors = lasting_prior_factors(KEYS[[0, 0]], OFFSETS[[0, 1]], means, roots, 0.4)
    unit = gtsam.noiseModel.Unit.Create(3)
    factors += [gtsam.PriorFactorPoint3(key, np.zeros(3), unit) for key in OFFSETS[:2].tolist()]
    values = gtsam.Values()
    for key in [KEYS[0], *OFFSETS[:2]]:
        values.insert(int(key), np.zeros(3))
    graph, solution = solved(factors, values)
    np.testing.assert_allclose(solution.atPoint3(int(KEYS[0])), [0.8, 0.8, 0.8], atol=1e-9)
    np.testing.assert_allclose(
        gtsam.Marginals(graph, solution).marginalCovariance(int(KEYS[0])),
        0.1**2 / 5 * np.eye(3),
        atol=1e-12,
    )


def test_a_ray_leaves_its_direction_open():
    """A singular message: nothing along z, so that the joint stays where the prior has it."""
    roots = np.diag([100.0, 100.0, 0.0])[None]
    factors = lasting_prior_factors(KEYS[:1], OFFSETS[:1], [[1.0, 2.0, 3.0]], roots, 0.5)
    factors += offset_factors(OFFSETS[:1], TIMES[:1], 1.0)
    factors.append(
        gtsam.PriorFactorPoint3(
            int(KEYS[0]), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 10.0)
        )
    )
    values = gtsam.Values()
    values.insert(int(KEYS[0]), np.zeros(3))
    values.insert(int(OFFSETS[0]), np.zeros(3))
    _, solution = solved(factors, values)
    # 1 cm against 10 m: a millionth of the way is left.
    np.testing.assert_allclose(solution.atPoint3(int(KEYS[0])), [1.0, 2.0, 0.0], atol=1e-5)


def covariance_beside_rays(rays: int, direction) -> np.ndarray:
    """(3, 3) covariance of a joint that one full message of 20 mm is of, `rays` frames with rays
    along `direction` after it; each ray's own joint is anywhere within 10 m.
    """
    frames = np.arange(rays + 1)
    keys, offsets = joint_keys(0, 0, frames), offset_keys(0, 0, frames)
    along = np.asarray(direction) / np.linalg.norm(direction)
    roots = np.tile((np.eye(3) - np.outer(along, along)) / 0.02, (rays + 1, 1, 1))
    roots[0] = np.eye(3) / 0.02
    factors = lasting_prior_factors(keys, offsets, np.zeros((rays + 1, 3)), roots, 0.3)
    factors += offset_factors(offsets, 0.04 * frames, 1.0)
    anywhere = gtsam.noiseModel.Isotropic.Sigma(3, 10.0)
    factors += [gtsam.PriorFactorPoint3(key, np.zeros(3), anywhere) for key in keys[1:].tolist()]
    values = gtsam.Values()
    for key in [*keys.tolist(), *offsets.tolist()]:
        values.insert(key, np.zeros(3))
    graph, solution = solved(factors, values)
    return gtsam.Marginals(graph, solution).marginalCovariance(int(keys[0]))


@pytest.mark.parametrize("direction", [(0, 0, 1), (1, 2, 3)])
@pytest.mark.parametrize("rays", [1, 5, 20])
def test_a_ray_tells_nothing_of_the_offset_along_itself(rays, direction):
    """One message of 20 mm stays one of 20 mm, however many rays follow; an offset said to be 0
    made it 13 mm.
    """
    # Across the ray the joints of the other frames are known to 10 m: two millionths of the
    # variance.
    np.testing.assert_allclose(
        covariance_beside_rays(rays, direction), 0.02**2 * np.eye(3), rtol=1e-4, atol=1e-8
    )


def test_a_message_of_full_rank_is_split_as_it_is_written():
    """The factor's error at any point is half the square of (R (x - m) - sqrt(1 - w) b) /
    sqrt(w).
    """
    rng = np.random.default_rng(5)
    root = rng.normal(size=(3, 3))
    root = root @ root.T + 1e-3 * np.eye(3)
    x, m, b = rng.normal(size=(3, 3))
    values = gtsam.Values()
    values.insert(int(KEYS[0]), x)
    values.insert(int(OFFSETS[0]), b)
    (factor,) = lasting_prior_factors(KEYS[:1], OFFSETS[:1], m[None], root[None], 0.2)
    residual = (root @ (x - m) - np.sqrt(0.8) * b) / np.sqrt(0.2)
    assert factor.error(values) == pytest.approx(0.5 * residual @ residual, rel=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: motion_factors(KEYS, SPEEDS, TIMES[::-1], 1.0), "must be finite and rise"),
        (
            lambda: motion_factors(KEYS[:2], SPEEDS[:2], [0.0, np.inf], 1.0),
            "must be finite and rise",
        ),
        (lambda: motion_factors(KEYS[:1], SPEEDS[:1], [np.nan], 1.0), "must be finite and rise"),
        (lambda: motion_factors(KEYS, SPEEDS, TIMES, 0.0), "psd must be positive"),
        (lambda: motion_factors(KEYS[:2], SPEEDS, TIMES, 1.0), r"must be \(T,\)"),
        (lambda: offset_factors(OFFSETS, TIMES, 0.0), "correlation_s must be positive"),
        (lambda: offset_factors(OFFSETS, TIMES[::-1], 1.0), "times finite and rising"),
        (lambda: offset_factors(OFFSETS[:2], [0.0, np.inf], 1.0), "times finite and rising"),
        (
            lambda: lasting_prior_factors(
                KEYS[:1], OFFSETS[:1], [[0, 0, np.nan]], np.eye(3)[None], 0.5
            ),
            "not finite",
        ),
        (
            lambda: lasting_prior_factors(KEYS[:1], OFFSETS[:1], [[0, 0, 0]], np.eye(3)[None], 1.0),
            "white_share",
        ),
        (
            lambda: lasting_prior_factors(KEYS[:1], OFFSETS[:1], [[0, 0]], np.eye(3)[None], 0.5),
            r"means \(D, 3\)",
        ),
    ],
)
def test_refuses_what_makes_no_sense(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_difference_whose_error_lasts_is_in_the_marginals_with_all_of_it():
    """y = x + d + e, with e of covariance D_t that lasts: Var(y) = Var(x) + D, and so on over
    time.
    """
    rng, times, T, w, tau = np.random.default_rng(3), np.array([0.0, 0.1, 0.15, 0.4]), 4, 0.3, 0.5
    keys, of, offsets = (
        reported_keys(2, 7, np.arange(T)),
        joint_keys(2, 7, np.arange(T)),
        offset_keys(2, 7, np.arange(T), 2),
    )
    roots = rng.normal(0, 0.02, (T, 3, 3))
    D = roots @ roots.mT + 1e-6 * np.eye(3)
    difference = rng.normal(0, 0.1, (T, 3))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for n in range(T):
        graph.push_back(gtsam.PriorFactorPoint3(int(of[n]), np.zeros(3), isotropic(3, 0.05)))
        for key, at in ((of[n], np.zeros(3)), (keys[n], difference[n]), (offsets[n], np.zeros(3))):
            values.insert(int(key), at)
    factors = lasting_difference_factors(keys, of, offsets, difference, D, w)
    for factor in [*factors, *offset_factors(offsets, times, tau)]:
        graph.push_back(factor)
    assert graph.error(values) == pytest.approx(0.0, abs=1e-18)
    found = gtsam.Marginals(graph, values)
    for n in range(T):
        np.testing.assert_allclose(
            found.marginalCovariance(int(keys[n])), 0.05**2 * np.eye(3) + D[n], rtol=1e-9
        )
    both = found.jointMarginalCovariance(gtsam.KeyVector(keys[:2].tolist())).at(
        int(keys[0]), int(keys[1])
    )
    values_0, vectors_0 = np.linalg.eigh(D[0])
    values_1, vectors_1 = np.linalg.eigh(D[1])
    root_0, root_1 = (
        v * np.sqrt(e) @ v.T for e, v in ((values_0, vectors_0), (values_1, vectors_1))
    )
    np.testing.assert_allclose(both, (1 - w) * np.exp(-0.1 / tau) * root_0 @ root_1, atol=1e-9)


@pytest.mark.parametrize("wrong", ["keys", "covariance", "share"])
def test_a_difference_that_makes_no_sense_is_refused(wrong):
    keys = joint_keys(0, 0, np.arange(2 if wrong == "keys" else 1))
    covariance = np.zeros((1, 3, 3)) if wrong == "covariance" else np.eye(3)[None]
    with pytest.raises(ValueError, match=r"must be|positive definite"):
        lasting_difference_factors(
            keys,
            joint_keys(0, 1, [0]),
            offset_keys(0, 0, [0]),
            np.zeros((1, 3)),
            covariance,
            1.0 if wrong == "share" else 0.5,
        )
