"""Where the body puts a joint without its own target: the contract of `BodyFit.prior_xyz`, every
fitter.
"""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.energy import BodyEnergy
from shapepose_fg.body.fitting.evidence import weigh
from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.body.fitting.fitters import SmplFitter, evenly, make_fitter
from shapepose_fg.body.fitting.left_out import Passes, left_out_sets
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.target_skeletons import TARGET_SKELETONS
from shapepose_fg.core.skeleton import BODY_25
from tests.marks import slow

MODEL_SIGMA_M = 0.02
NOISE_M = 0.01
COUNT = 160
FITTERS = {"plain": SmplFitter, "learned": make_fitter}
"""Every fitter that ships."""


def draw(count: int, rows_each: int = 1) -> np.ndarray:
    """Joints (count * rows_each, 25, 3) of people of poses and shapes from the priors, in a z-up
    world.
    """
    rng, rows = np.random.default_rng(0), count * rows_each
    orient = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (rows, 1)))
    orient = (orient * Rotation.from_rotvec([np.pi / 2, 0, 0])).as_rotvec()
    poses, betas = (
        PosePrior.default().sample(rng, rows),
        np.repeat(rng.normal(size=(count, 10)), rows_each, axis=0),
    )
    parts = (betas, orient, poses, rng.uniform(-3, 3, (rows, 3)))
    return BodyModel.default().keypoints(BodyParameters(*(parts)))


@pytest.fixture(scope="module")
def people() -> tuple[np.ndarray, np.ndarray]:
    """Joints of bodies drawn from the priors as this detector sees them (COUNT, 25, 3), and with
    noise.
    """
    rng = np.random.default_rng(1)
    truth = draw(COUNT) + rng.normal(0, MODEL_SIGMA_M, (COUNT, 25, 3))
    return truth, truth + rng.normal(0, NOISE_M, truth.shape)


def make_targets(
    xyz: np.ndarray, without: Sequence[int] = (), sigma_m: float = NOISE_M
) -> JointTargets:
    information = np.broadcast_to(np.eye(3) / sigma_m**2, (*xyz.shape, 3)).copy()
    information[:, list(without)] = 0
    return JointTargets(xyz, information)


@pytest.fixture(scope="module", params=["learned", *slow("plain")])
def fitter(request) -> BodyFitter:
    return FITTERS[request.param]()


@pytest.fixture(scope="module")
def fit(fitter, people) -> BodyFit:
    return fitter.fit(make_targets(people[1]))


def mahalanobis(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...ij,...j->...", error, np.linalg.inv(covariance), error)


@pytest.mark.parametrize("name", ["RKnee", *slow("LElbow", "RWrist", "MidHip", "LBigToe")])
def test_a_joints_own_target_does_not_come_back_to_it(fitter, people, fit, name):
    joint = BODY_25.index(name)
    xyz = people[1].copy()
    xyz[:, joint] += [0.15, 0.0, 0.0]
    pushed = fitter.fit(make_targets(xyz))
    followed = np.linalg.norm((pushed.joints - fit.joints)[:, joint], axis=-1)
    assert np.median(followed) > 0.01  # the body goes along
    both = pushed.ok & fit.ok
    # Nothing by construction: only the row's origin moves, which rounds.
    assert np.abs(pushed.prior_xyz - fit.prior_xyz)[both, joint].max() < 1e-6
    np.testing.assert_allclose(
        pushed.prior_covariance[both, joint],
        fit.prior_covariance[both, joint],
        rtol=1e-3,
        atol=1e-9,
    )


def test_nor_does_it_by_way_of_the_shape_that_frames_share(fitter):
    people, rows, joint = 6, 8, BODY_25.index("LElbow")
    xyz = draw(people, rows) + np.random.default_rng(1).normal(0, NOISE_M, (people * rows, 25, 3))
    groups = np.arange(people * rows) // rows
    moved = xyz.copy()
    moved[:, joint] += [0.0, 0.0, 0.15]
    one, two = (fitter.fit(make_targets(each), groups=groups) for each in (xyz, moved))
    both = one.ok & two.ok
    assert both.mean() > 0.9
    assert np.abs(two.prior_xyz - one.prior_xyz)[both, joint].max() < 1e-6
    other = BODY_25.index("LWrist")
    assert (
        np.abs(two.prior_xyz - one.prior_xyz)[both, other].max() > 0.03
    )  # others are right to follow


def test_gain_on_own_noise_is_nothing(fitter, people, fit):
    truth, noisy = people
    noise, error = noisy - truth, fit.prior_xyz - truth
    for name in ("RKnee", "LKnee", "RElbow", "LElbow", "RWrist", "LWrist", "RAnkle", "Neck"):
        joint = BODY_25.index(name)
        x, y = noise[fit.ok, joint].ravel(), error[fit.ok, joint].ravel()
        gain = (x @ y) / (x @ x)
        # The regression's own error: (spread of the error) / (spread of the noise) / sqrt(480),
        # three of them.
        assert abs(gain) < 3 * y.std() / x.std() / np.sqrt(len(x)), name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "median_m"),
    [
        ("RKnee", 0.01),
        ("LWrist", 0.025),
        *slow(("LHip", 0.01), ("RAnkle", 0.01), ("RElbow", 0.01), ("Nose", 0.01)),
    ],
)
def test_the_prior_is_a_refit_without_the_joint(fitter, people, fit, name, median_m):
    """Others of its set are left out too: they are to tell little of it."""
    joint = BODY_25.index(name)
    refit = fitter.fit(make_targets(people[1], without=(joint,)))
    apart = np.linalg.norm(refit.joints[:, joint] - fit.prior_xyz[:, joint], axis=-1)[
        refit.ok & fit.ok
    ]
    assert np.median(apart) < median_m and np.quantile(apart, 0.9) < 0.1
    ours, theirs = (
        np.trace(each.prior_covariance[:, joint], axis1=-2, axis2=-1) for each in (fit, refit)
    )
    assert 0.99 < np.nanmedian(ours / theirs) < 1.1  # as unsure, or a little more


def test_nothing_jumps_where_information_goes_to_zero(fitter, people):
    joint = BODY_25.index("RWrist")
    xyz = people[1][:40].copy()
    xyz[:, joint] += [0.1, 0.1, 0.0]
    priors = []
    for sigma_m in (0.01, 0.04, 0.2, 1.0, 100.0, np.inf):
        targets = make_targets(xyz)
        targets.information[:, joint] = np.eye(3) / sigma_m**2
        priors.append(fitter.fit(targets).prior_xyz[:, joint])
    np.testing.assert_allclose(
        np.array(priors), np.broadcast_to(priors[0], np.shape(priors)), atol=1e-6
    )


def test_a_joint_that_no_pass_must_leave_out_is_where_the_body_has_it(fitter, people):
    """Where no joint of a set has a target, the pass with all targets has left them out already."""
    sets = fitter.sets
    alike = np.flatnonzero(sets == sets[BODY_25.index("LWrist")]).tolist()
    fit = fitter.fit(make_targets(people[1][:40], without=alike))
    np.testing.assert_array_equal(fit.prior_xyz[:, alike], fit.joints[:, alike])
    model_error = MODEL_SIGMA_M**2 * np.eye(3)
    np.testing.assert_allclose(
        fit.prior_covariance[:, alike],
        fit.covariance[:, alike] + model_error,
        rtol=1e-9,
        atol=1e-12,
    )


def test_few_joints_are_left_out_one_by_one(fitter, people):
    """Four joints are the fewest that make a row; three still say, roughly, where the fourth is."""
    kept = [BODY_25.index(name) for name in ("Neck", "RHip", "LKnee", "LShoulder")]
    without = tuple(np.setdiff1d(np.arange(25), kept))
    truth, noisy = people
    fit = fitter.fit(make_targets(noisy, without=without))
    assert fit.ok.mean() > 0.9 and np.isfinite(fit.prior_xyz[fit.ok]).all()
    moved = noisy.copy()
    moved[:, kept[0]] += [0.0, 0.1, 0.0]
    again = fitter.fit(make_targets(moved, without=without))
    both = fit.ok & again.ok
    assert np.abs(again.prior_xyz - fit.prior_xyz)[both, kept[0]].max() < 1e-6
    inside = (
        mahalanobis((fit.prior_xyz - truth)[fit.ok][:, kept], fit.prior_covariance[fit.ok][:, kept])
        < 7.81
    )
    # A row's four joints are right or wrong together: of 160 rows with 84 % three standard errors
    # are 9 %. With half the covariance it is 57 to 64 %.
    assert inside.mean() > 0.75


def test_a_long_window_s_shape_is_agreed_upon_by_rows_spread_over_it(fitter):
    people, rows = 2, 40
    xyz = draw(people, rows) + np.random.default_rng(1).normal(0, NOISE_M, (people * rows, 25, 3))
    groups = np.append(np.repeat([3, 1], rows)[:-1], 7)  # one row is alone
    voters = evenly(groups, 24)
    assert [voters[groups == number].sum() for number in (1, 3, 7)] == [24, 24, 1]
    assert np.diff(np.flatnonzero(voters[groups == 3])).max() == 2
    fit = fitter.fit(make_targets(xyz), groups=groups)
    for number in (1, 3):
        betas = fit.betas[(groups == number) & fit.ok]
        assert np.ptp(betas, axis=0).max() < 1e-3  # held by a precision of 1e6
    alone = fitter.fit(make_targets(xyz))
    error = [
        np.linalg.norm(f.joints - draw(people, rows), axis=-1)[fit.ok & alone.ok].mean()
        for f in (fit, alone)
    ]
    assert error[0] < error[1] + 0.001  # nobody is worse off


def test_sets_hold_joints_that_tell_little_of_each_other():
    prior = PosePrior.default()
    for skeleton, names in TARGET_SKELETONS.items():
        model = BodyModel.default().with_keypoints(names)
        sets = left_out_sets(BodyEnergy(model, prior), prior)
        assert sorted(set(sets)) == list(range(6)), skeleton
        place = {name: sets[row] for row, name in enumerate(names)}
        bones = (
            ["LHip LKnee", "LKnee LAnkle", "RShoulder RElbow", "RElbow RWrist", "LHip RHip"]
            if skeleton != "SMPL_24"
            else [
                "left_hip left_knee",
                "left_knee left_ankle",
                "right_elbow right_wrist",
                "pelvis spine1",
            ]
        )
        if skeleton in ("BODY_25", "HALPE_26"):  # the middle of two joints is told by them
            bones += [
                "LBigToe LSmallToe",
                "MidHip LHip",
                "MidHip RHip",
                "Neck LShoulder",
                "Neck RShoulder",
            ]
        for one, other in map(str.split, bones):
            assert place[one] != place[other], (skeleton, one, other)


def test_passes_are_what_rows_need(people):
    sets = np.arange(25) % 5
    targets = make_targets(people[1][:4])
    targets.information[0, sets == 2] = 0  # row 0 has nothing of set 2
    targets.information[1, sets == 2] = 0  # nor has row 1, of the same person
    few = np.setdiff1d(np.arange(25), [*np.flatnonzero(sets == 3)[:3].tolist(), 0, 1])
    targets.information[1, few] = 0  # row 1 would not do without set 3
    passes = Passes.of(weigh(targets, MODEL_SIGMA_M), sets, np.array([5, 5, 7, 8]))
    assert (
        passes.row[:4].tolist() == [0, 1, 2, 3]
        and not passes.without[:4].any()
        and passes.votes[:4].all()
    )
    left_out = {(row, number): [] for row in range(4) for number in range(5)}
    for row, without, votes in zip(
        passes.row[4:], passes.without[4:], passes.votes[4:], strict=True
    ):
        (number,) = set(sets[without].tolist())
        left_out[row, number].append((np.flatnonzero(without).tolist(), bool(votes)))
    for (row, number), found in left_out.items():
        joints = np.flatnonzero(sets == number).tolist()
        if number == 2 and row < 2:
            assert found == []
        elif (row, number) == (1, 3):
            assert sorted(found) == [([joint], False) for joint in joints]  # one by one
        else:
            assert found == [(joints, True)]
    # One group, one pool for each set; another group, another pool; nobody shares with the pass
    # that saw all.
    of_set = np.array(
        [-1] * 4 + [sets[np.flatnonzero(without)[0]] for without in passes.without[4:]]
    )
    pools = {
        (row, each): pool for row, each, pool in zip(passes.row, of_set, passes.pool, strict=True)
    }
    assert pools[0, 3] == pools[1, 3] and pools[0, 3] != pools[2, 3] != pools[3, 3]
    assert len({pools[0, each] for each in (-1, 0, 1, 3, 4)}) == 5
    part = np.array([4, 5])
    given, variance = passes.given(part)
    assert (
        not given.information[passes.without[part]].any()
        and np.isinf(variance[passes.without[part]]).all()
    )
    assert given.information[~passes.without[part]].any(axis=(1, 2)).mean() > 0.7


@pytest.mark.slow
def test_priors_are_calibrated_on_bodies_from_the_priors(people):
    """Squared Mahalanobis distances are chi-squared with 3 degrees of freedom: mean 3, median
    2.37.
    """
    fit = SmplFitter().fit(make_targets(people[1]))
    squared = mahalanobis(fit.prior_xyz - people[0], fit.prior_covariance)
    assert 2.3 < squared.mean() < 3.6
    assert 1.9 < np.median(squared) < 2.8
    by_joint = np.median(squared, axis=0)
    # Wrists are given twice the variance that these bodies, whose angles are Gaussian, would need:
    # 1.18, three standard errors of 160 rows are 0.32; with twice as much again 0.6.
    assert (by_joint > 0.8).all() and (by_joint < 4.0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "hidden", [("RWrist",), ("LElbow", "LWrist"), ("RAnkle", "RBigToe", "RSmallToe", "RHeel")]
)
def test_priors_are_calibrated_for_hidden_joints(fitter, people, hidden):
    joints = tuple(BODY_25.index(name) for name in hidden)
    fit = fitter.fit(make_targets(people[1], without=joints))
    index = list(joints)
    squared = mahalanobis(
        (fit.prior_xyz - people[0])[fit.ok][:, index], fit.prior_covariance[fit.ok][:, index]
    )
    assert 0.8 < np.median(squared) < 3.5
    assert squared.mean() < 6  # swinging limbs are not Gaussian: the tail is heavier


def test_covariances_are_symmetric_and_positive(fit):
    for covariance in (fit.covariance[fit.ok], fit.prior_covariance[fit.ok]):
        np.testing.assert_allclose(covariance, covariance.swapaxes(-1, -2), atol=1e-9)
        assert np.linalg.eigvalsh(covariance).min() > 0
