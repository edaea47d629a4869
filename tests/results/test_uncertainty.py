"""What is asked of joints with errors: blocks of joint marginals, probabilities of distances, named
failures.
"""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.special import chdtri, chndtr, fdtri

from shapepose_fg import reconstruct
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.errors import NotDetermined
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.results.solve_again import window_solutions
from shapepose_fg.results.uncertainty import (
    Distance,
    JointAt,
    correlation,
    distance,
    distances,
    error_tails,
    marginal,
    squared_radius,
    surface_distance,
)
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.viz.overlay.frames import surfaces

WRIST, ELBOW = BODY_25.index("RWrist"), BODY_25.index("RElbow")


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=2, cameras=4, frames=6)


@pytest.fixture(scope="module")
def people(scene) -> Reconstruction:
    return reconstruct(simulate(scene), scene.rig)


def test_blocks_are_what_is_reported(people):
    who = int(people.person[0])
    everything = [JointAt(who, name, frame) for frame in (1, 4) for name in BODY_25.joints]
    both = marginal(people, *everything)
    row = int(np.flatnonzero((people.person == who) & (people.frame == 4))[0])
    for joint in (0, WRIST, 24):
        np.testing.assert_allclose(
            both.block(25 + joint, 25 + joint), people.covariance[row, joint], atol=1e-12
        )
    assert np.linalg.eigvalsh(both.covariance).min() > 0  # 150 numbers that can be known together
    other = int(people.person[people.person != who][0])
    apart = marginal(people, JointAt(who, "Neck", 1), JointAt(other, "Neck", 1))
    assert not apart.block(0, 1).any()


def test_errors_of_fast_joints_last_less(people):
    """Where the covariance of a velocity says that errors at its two ends hardly correlate, those
    of neighbouring frames do not either; where it says nothing, or more than usual, they are as
    usual.
    """
    who = int(people.person[0])
    ends, ratio = (JointAt(who, "RWrist", 2), JointAt(who, "RWrist", 3)), []
    step_s = np.diff(np.unique(people.time_s)).min()
    for share in (np.nan, 0.0, 0.2, 1.0):
        # 2 (1 - rho) C = V dt², over the two frames between which a velocity is taken.
        speed = 2 * share * people.covariance / (2 * step_s) ** 2
        both = marginal(replace(people, velocity_covariance=speed), *ends)
        ratio.append(np.trace(both.block(0, 1)) / np.trace(both.block(0, 0)))
        assert np.linalg.eigvalsh(both.covariance).min() >= -1e-12
    assert ratio[0] == pytest.approx(ratio[1]) and ratio[0] > 0.9
    assert ratio[1] > ratio[2] > 0.8 > ratio[3] > -0.01


def test_correlation_is_the_product_along_the_limbs():
    rho = correlation(BODY_25.joints, BODY_25.joints)
    np.testing.assert_array_equal(np.diag(rho), 1)
    np.testing.assert_array_equal(rho, rho.T)
    assert np.linalg.eigvalsh(rho).min() > 0
    at = {name: n for n, name in enumerate(BODY_25.joints)}
    assert rho[at["RWrist"], at["RShoulder"]] == pytest.approx(0.39 * 0.23)
    assert rho[at["RHip"], at["LHip"]] == pytest.approx(0.85**2)
    assert correlation(["Tail"], ["Neck", "Tail"]).tolist() == [[0.0, 1.0]]


@pytest.mark.slow
def test_what_one_robot_sees_errs_with_it(scene):
    """A robot carries all cameras: joints of two people, and of two frames, share the error of its
    pose, and as they turn with it their distance is known as well as if it stood still.
    """
    rng = np.random.default_rng(3)
    root = rng.normal(0, [0.01] * 3 + [0.05] * 3, (6, 6))
    pose, covariance = np.eye(4), root.T @ root / 6
    pose[:3, 3] = 0.5, 0.2, 0.0
    path = Trajectory(
        "robot",
        np.linspace(0, 0.4, 3),
        np.stack([pose] * 3),
        np.stack([covariance] * 3),
        refined=True,
    )
    cameras = [
        replace(each, carrier="robot", bTc=np.linalg.inv(pose) @ each.wTc)
        for each in scene.rig.cameras
    ]
    rig = replace(scene.rig, cameras=tuple(cameras), trajectories=(path,))
    people = reconstruct(simulate(scene), rig)
    one, other = (JointAt(int(who), "Neck", 2) for who in np.unique(people.person)[:2])
    both, apart = marginal(people, one, other, rig=rig), marginal(people, one, other)
    ways = []
    for n in range(2):
        H = np.zeros((3, 6), order="F")
        gtsam.Pose3(pose).transformFrom(both.mean[n] - pose[:3, 3], H, np.zeros((3, 3), order="F"))
        ways.append(H)
        np.testing.assert_allclose(both.block(n, n), apart.block(n, n), atol=1e-9)
    # Of a pose known to 5 cm nearly all is theirs: what the cameras add, 1 cm, makes no difference
    # to a tenth.
    expected = ways[0] @ covariance @ ways[1].T
    np.testing.assert_allclose(both.block(0, 1), expected, atol=0.1 * np.trace(expected))
    assert not apart.block(0, 1).any()
    sigma = [float(distance(people, one, other, rig=each).sigma_m) for each in (rig, None)]
    assert sigma[0] < 0.6 * sigma[1]
    later = JointAt(other.person, "RAnkle", 5)
    fades = np.exp(
        -float(people.time_s[people.frame == 5][0] - people.time_s[people.frame == 2][0]) / 3
    )
    shared = marginal(people, one, later, rig=rig).block(0, 1)
    same = marginal(people, one, replace(later, frame=2), rig=rig).block(0, 1)
    np.testing.assert_allclose(shared, fades * same, atol=0.1 * np.abs(same).max())
    assert np.linalg.eigvalsh(both.covariance).min() > 0


def test_a_ball_around_nothing_is_a_noncentral_chi_square():
    """Alike in all directions a distance has a known distribution, far into the tails."""
    for mean, sigma, limit in (
        ([0.1, 0.2, 0.05], 0.02, 0.2),
        ([0, 0, 0], 0.03, 0.05),
        ([0.5, 0, 0], 0.02, 0.4),
    ):
        apart = np.array(mean, dtype=float)
        true = chndtr((limit / sigma) ** 2, 3, max(apart @ apart / sigma**2, 1e-12))
        assert float(Distance(apart, sigma**2 * np.eye(3)).below(limit)) == pytest.approx(
            true, rel=1e-3
        )


def test_any_ellipsoid_is_as_drawn():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(3, 3)) * [0.01, 0.03, 0.06]
    apart, covariance = np.array([0.05, 0.02, -0.03]), A @ A.T
    drawn = np.linalg.norm(
        rng.multivariate_normal(apart, covariance, 200_000, method="cholesky"), axis=1
    )
    found = Distance(apart, covariance)
    for limit in (0.01, 0.05, 0.1, 0.2):
        assert float(found.below(limit)) == pytest.approx(
            (drawn < limit).mean(), abs=4e-3
        )  # drawn to 1e-3
    assert float(found.mean_m) == pytest.approx(drawn.mean(), rel=0.01)
    assert float(found.sigma_m) == pytest.approx(drawn.std(), rel=0.02)
    assert float(found.quantile(0.9)) == pytest.approx(np.quantile(drawn, 0.9), rel=0.02)


def test_errors_with_heavier_tails_have_the_same_95_percent_region():
    """Student's t: 50 % regions are smaller than a Gaussian's, 99 % regions larger."""
    rng, tails = np.random.default_rng(0), error_tails()
    shape = np.diag([0.01, 0.02, 0.03]) ** 2
    quoted = 3 * fdtri(3, tails, 0.95) / chdtri(3, 0.05) * shape
    error = rng.multivariate_normal(np.zeros(3), shape, 200_000, method="cholesky")
    error *= np.sqrt(tails / rng.chisquare(tails, len(error)))[:, None]
    squared = np.square(error / np.sqrt(np.diag(quoted))).sum(axis=1)
    for share in (0.5, 0.95, 0.99):
        inside = (squared < squared_radius(share)).mean()
        assert inside == pytest.approx(share, abs=0.004)
    assert squared_radius(0.5) < chdtri(3, 0.5) and squared_radius(0.99) > chdtri(3, 0.01)
    apart = np.array([0.02, 0.03, 0.0])
    found, drawn = Distance(apart, quoted, tails), np.linalg.norm(apart + error, axis=1)
    for limit in (0.02, 0.05, 0.1):
        assert float(found.below(limit)) == pytest.approx((drawn < limit).mean(), abs=0.01)
    assert float(found.sigma_m) == pytest.approx(drawn.std(), rel=0.1)
    low, high = found.interval(0.95)
    assert low < np.linalg.norm(apart) < high


@pytest.mark.slow
def test_an_interval_holds_the_truth_at_any_distance():
    """300 measurements of each distance, from contact on: 1.3 in 100 more or less are chance, of
    all 0.6.
    """
    rng = np.random.default_rng(1)
    covariance, held = np.diag([0.01, 0.02, 0.015]) ** 2, list[float]()
    for true in (0.0, 0.01, 0.05, 0.5):
        error = rng.multivariate_normal(np.zeros(3), covariance, 300, method="cholesky")
        measured = np.array([0, true, 0]) + error
        low, high = Distance(measured, np.broadcast_to(covariance, (300, 3, 3))).interval(0.95)
        held.append(float(((low <= true) & (true <= high)).mean()))
    assert min(held) > 0.90 and np.mean(held) > 0.93
    assert held[-1] < 0.99  # near 0 one side is left
    shortest = Distance(np.zeros(3), covariance).interval()
    assert float(shortest[1]) > 0.03  # shorter than errors let it be: it is no 0


def test_joints_that_err_together_are_nearer_known_apart(people):
    """Hips err alike: the way between them is known better than if each erred by itself."""
    row = int(people.person[0]), int(people.frame[0])
    hips = [JointAt(row[0], name, row[1]) for name in ("RHip", "LHip")]
    together = distance(people, *hips)
    alone = sum(marginal(people, each).covariance for each in hips)
    assert np.trace(together.covariance) < 0.5 * np.trace(alone)
    assert float(together.mean_m) == pytest.approx(np.linalg.norm(together.displacement), rel=0.05)


def test_every_joint_has_its_distance_to_a_point(people):
    """From where a wrist is said to be it is as far as its Gaussian says: 10,000 draws are right to
    0.01.
    """
    near = distances(people, people.joints[:, WRIST]).below(0.1)
    assert near.shape == people.joints.shape[:2]
    drawn = np.random.default_rng(0).normal(size=(10_000, 3))
    for row, covariance in enumerate(people.covariance[:, WRIST]):
        off = np.linalg.norm(drawn @ np.linalg.cholesky(covariance).T, axis=1)
        assert near[row, WRIST] == pytest.approx((off < 0.1).mean(), abs=0.02)


def test_a_point_before_a_chest(people):
    body = BodyModel.default()
    vertices, rows = surfaces(people, body)
    nose = people.joints[rows[0], BODY_25.index("Nose")]
    vertex = int(np.linalg.norm(vertices[0] - nose, axis=1).argmin())
    centre = vertices[0].mean(axis=0)
    out = (vertices[0][vertex] - centre) * [1, 1, 0]
    out /= np.linalg.norm(out)
    who = int(people.person[rows[0]]), int(people.frame[rows[0]])
    for away in (0.2, 1.0):
        found = surface_distance(people, body, *who, vertices[0][vertex] + away * out)
        true = np.linalg.norm(vertices[0] - vertices[0][vertex] - away * out, axis=1).min()
        assert found.signed_m == pytest.approx(true, abs=0.01)
        assert found.below(found.signed_m) == pytest.approx(0.5)
    assert (
        surface_distance(
            people, body, *who, people.joints[rows[0], BODY_25.index("MidHip")]
        ).signed_m
        < 0
    )


def test_what_has_no_place_is_named(people):
    joints = people.joints.copy()
    joints[0, WRIST] = np.nan
    lost = replace(people, joints=joints)
    who = int(people.person[0]), int(people.frame[0])
    with pytest.raises(
        NotDetermined, match=f"RWrist of person {who[0]} in frame {who[1]} .* is not determined"
    ):
        distance(lost, JointAt(who[0], "RWrist", who[1]), [0, 0, 0])
    with pytest.raises(ValueError, match="person 99 is not in frame 0"):
        marginal(people, JointAt(99, "RWrist", 0))


def test_a_failure_of_gtsam_is_named(people, scene):
    """A distance alone does not place a wrist: GTSAM tells a number, the graph whose it is and
    when.
    """
    solution = next(window_solutions(people, scene.rig))
    wrist, elbow = (int(solution.keys[2, joint]) for joint in (WRIST, ELBOW))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(
        gtsam.RangeFactor3(wrist, elbow, 0.25, gtsam.noiseModel.Isotropic.Sigma(1, 0.01))
    )
    for key in (wrist, elbow):
        values.insert(key, solution.values.atPoint3(key))
    with pytest.raises(RuntimeError) as told:
        gtsam.Marginals(graph, values)
    named = solution.not_determined(told.value, people.joint_names.tolist())
    assert named is not None
    assert named.joint in ("RWrist", "RElbow")
    assert (named.person, named.frame) == (solution.person, int(solution.frames[2]))
    assert "saw it" in str(named)
    assert solution.not_determined(RuntimeError("no such key"), people.joint_names.tolist()) is None
