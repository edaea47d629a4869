import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting import evidence
from shapepose_fg.body.fitting.energy import (
    BodyEnergy,
    EnergyTargets,
    Held,
    robust_weight,
    visible_joints,
)
from shapepose_fg.body.fitting.evidence import determine_pose, weigh
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.skeleton import BODY_25, SMPL_24

ROWS = 3


@pytest.fixture(scope="module")
def model() -> BodyModel:
    return BodyModel.default()


@pytest.fixture(scope="module")
def energy(model) -> BodyEnergy:
    return BodyEnergy(model, PosePrior.default())


@pytest.fixture(scope="module")
def apart() -> PosePrior:
    """A broad Gaussian with hands that go with the arms, unlike the default's."""
    rng = np.random.default_rng(0)
    A = 0.3 * rng.normal(size=(69, 69)) / np.sqrt(69)
    free = np.full(69, np.inf)
    return PosePrior(rng.normal(0, 0.1, 69), 0.2 * np.eye(69) + A @ A.T, -free, free, "test")


@pytest.fixture
def free(energy) -> np.ndarray:
    """Free parameters (ROWS, P) of people in poses from the prior, turned any way."""
    rng = np.random.default_rng(0)
    angles = PosePrior.default().sample(rng, ROWS).reshape(ROWS, 69)[:, energy.angles]
    orient = Rotation.random(ROWS, random_state=0).as_rotvec()
    parts = [rng.normal(size=(ROWS, 10)), orient, angles, rng.normal(size=(ROWS, 3))]
    return np.concatenate(parts, axis=1)


@pytest.fixture
def targets(energy, free) -> EnergyTargets:
    """Targets some centimetres off, with full, ray-like and no information."""
    rng = np.random.default_rng(1)
    xyz = energy.model.keypoints(energy.complete(free))
    root = rng.normal(size=(ROWS, 25, 3, 3)) * 20
    root = root + root.swapaxes(-1, -2)
    root[:, 3] = np.diag([40.0, 40.0, 0.0])
    root[1, 7] = 0
    return EnergyTargets(xyz + rng.normal(0, 0.03, xyz.shape), root @ root)


def test_gradient_is_the_slope_of_the_energy(energy, free, targets):
    held, step = energy.held_by_priors(ROWS), 1e-5
    gradient = energy.linearise(free, targets, 6.0, held).gradient
    for column in range(energy.num_free):
        delta = np.zeros_like(free)
        delta[:, column] = step
        ahead, behind = (
            energy.linearise(energy.retract(free, sign * delta), targets, 6.0, held).energy
            for sign in (1, -1)
        )
        # Half the slope, for the energy has no factor 1/2; central differences leave step² and
        # rounding.
        np.testing.assert_allclose(
            (ahead - behind) / (4 * step), gradient[:, column], rtol=1e-5, atol=1e-3
        )


def test_jacobian_of_the_free_parameters_is_the_numeric_one(energy, free, targets):
    jacobian = energy.linearise(free, targets, 6.0, energy.held_by_priors(ROWS)).jacobian
    step = 1e-6
    for column in range(energy.num_free):
        delta = np.zeros_like(free)
        delta[:, column] = step
        ahead, behind = (
            energy.model.keypoints(energy.complete(energy.retract(free, sign * delta)))
            for sign in (1, -1)
        )
        numeric = ((ahead - behind) / (2 * step)).reshape(ROWS, -1)
        np.testing.assert_allclose(jacobian[:, :, column], numeric, rtol=1e-6, atol=1e-7)


def test_hessian_is_information_and_priors(energy, free, targets):
    found = energy.linearise(free, targets, 1e6, energy.held_by_priors(ROWS))
    information = targets.information
    J = found.jacobian.reshape(ROWS, 25, 3, -1)
    expected = np.einsum("bkip,bkij,bkjq->bpq", J, information, J)
    expected[:, :10, :10] += np.eye(10)
    expected[:, 13:-3, 13:-3] += PosePrior.default().marginal_precision(energy.angles)
    np.testing.assert_allclose(found.hessian, expected, rtol=1e-6, atol=1e-6)


def test_weight_is_the_slope_of_geman_mcclure_s_cost():
    squared, step = np.linspace(0, 400, 9), 1e-4
    behind, ahead = (36 * each / (36 + each) for each in (squared - step, squared + step))
    np.testing.assert_allclose(
        (ahead - behind) / (2 * step), robust_weight(squared, 6.0), rtol=1e-6
    )
    assert robust_weight(np.array(36.0), 6.0) == pytest.approx(0.25)


def test_hands_are_invisible_and_limbs_are_not(model):
    names = {SMPL_24[1:][index] for index in visible_joints(model, PosePrior.default())}
    assert not names & {"left_hand", "right_hand"}
    assert {
        "left_hip",
        "right_knee",
        "left_ankle",
        "right_shoulder",
        "left_elbow",
        "neck",
        "spine2",
    } <= names


def test_invisible_joints_are_where_the_prior_expects_them(model, apart):
    energy = BodyEnergy(model, apart)
    free = np.random.default_rng(0).normal(size=(ROWS, energy.num_free)) * 0.3
    pose = energy.complete(free).body_pose.reshape(ROWS, 69)
    hidden = np.setdiff1d(np.arange(69), energy.angles)
    assert len(hidden) > 0
    np.testing.assert_allclose(pose[:, energy.angles], free[:, 13:-3])
    seen, S, mean = energy.angles, apart.covariance, apart.mean
    pull = np.linalg.solve(S[np.ix_(seen, seen)], (free[:, 13:-3] - mean[seen]).T)
    np.testing.assert_allclose(
        pose[:, hidden], mean[hidden] + (S[np.ix_(hidden, seen)] @ pull).T, atol=1e-9
    )


def test_pose_energy_is_the_squared_distance_of_the_visible_angles(model, apart):
    energy = BodyEnergy(model, apart)
    error = np.random.default_rng(0).normal(0, 0.4, (4, energy.num_angles))
    P = np.linalg.inv(apart.covariance[np.ix_(energy.angles, energy.angles)])
    nothing = EnergyTargets(np.zeros((4, 25, 3)), np.zeros((4, 25, 3, 3)))
    anchor = np.tile(apart.mean[energy.angles] + 1.0, (4, 1))
    for around, held in (
        (apart.mean[energy.angles], energy.held_by_priors(4)),
        (anchor, Held(np.zeros((4, 10)), np.ones(4), anchor)),
    ):
        free = np.zeros((4, energy.num_free))
        free[:, 13:-3] = around + error
        here = energy.linearise(free, nothing, 1.0, held)
        np.testing.assert_allclose(here.energy, np.einsum("bi,ij,bj->b", error, P, error))
        np.testing.assert_allclose(here.gradient[:, 13:-3], error @ P, atol=1e-9)
        np.testing.assert_allclose(here.hessian[:, 13:-3, 13:-3], np.broadcast_to(P, (4, *P.shape)))


def test_orientation_moves_on_the_sphere_of_rotations(energy, free):
    step = np.zeros_like(free)
    step[:, 10:13] = np.array([0.3, -0.2, 0.1])
    moved = Rotation.from_rotvec(energy.retract(free, step)[:, 10:13])
    expected = Rotation.from_rotvec(free[:, 10:13]) * Rotation.from_rotvec([0.3, -0.2, 0.1])
    assert (moved * expected.inv()).magnitude().max() < 1e-9


@pytest.mark.parametrize("seen", ["all", "trunk", "legs"])
def test_alignment_of_the_mean_pose_is_exact(model, seen):
    prior = PosePrior.default()
    rotation, transl = (
        Rotation.random(4, random_state=0),
        np.random.default_rng(0).normal(size=(4, 3)),
    )
    pose = np.tile(prior.mean.reshape(1, 23, 3), (4, 1, 1))
    parts = (np.zeros((4, 10)), rotation.as_rotvec(), pose, transl)
    xyz = model.keypoints(BodyParameters(*(parts)))
    names = {
        "all": BODY_25.joints,
        "trunk": ("RShoulder", "LShoulder", "RHip", "LHip"),
        "legs": ("RHip", "LHip", "RAnkle", "LKnee"),
    }[seen]
    variance = np.full((4, 25), np.inf)
    variance[:, [BODY_25.index(name) for name in names]] = 1e-4
    frame = PersonFrame.of_angles(model, prior.mean, prior.covariance)
    targets = np.where(np.isinf(variance)[..., None], 0.0, xyz)
    R, pelvis = frame.place(targets, variance, tuple(range(25)))
    # Angles come from squares: they are exact to the root of a double's precision, 1.5e-8.
    np.testing.assert_allclose(R, rotation.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(pelvis + frame.transl, transl, atol=1e-6)


def test_model_error_is_added_to_covariances_and_rays_stay_rays():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(1, 25, 3, 3))
    covariance = 1e-4 * (A @ A.swapaxes(-1, -2) + np.eye(3))
    information = np.linalg.inv(covariance)
    information = (information + information.swapaxes(-1, -2)) / 2
    information[0, 5] = np.diag([1e4, 1e4, 0.0])
    information[0, 6] = 0
    weighed = weigh(JointTargets(rng.normal(size=(1, 25, 3)), information), 0.02).information
    full = np.setdiff1d(np.arange(25), [5, 6])
    expected = np.linalg.inv(covariance[0, full] + 0.02**2 * np.eye(3))
    np.testing.assert_allclose(weighed[0, full], expected, rtol=1e-7)
    np.testing.assert_allclose(
        weighed[0, 5], np.diag([2000.0, 2000.0, 0.0]), atol=1e-8
    )  # 1 / (1e-4 + 4e-4)
    assert not weighed[0, 6].any()


def test_joints_on_a_line_do_not_determine_a_pose(monkeypatch):
    line = np.arange(-2.0, 3.0)[:, None] * np.array([0.3, 0.4, 0.0])
    side = np.array([0.1, -0.1, 0.0, -0.1, 0.1])[:, None] * np.array([0.0, 0.0, 1.0])
    xyz, used = np.stack([line, line + side, line + side, line + 4]), np.ones((4, 5), dtype=bool)
    used[2, 1:3] = False
    xyz[2, 1] = 100.0  # is not looked at
    off = 0.1 * np.sqrt(4 / 5)  # root mean square distance from the line of the second
    for least, expected in ((off - 1e-6, [False, True, False, False]), (off + 1e-6, [False] * 4)):
        monkeypatch.setattr(evidence, "MIN_SPREAD_M", least)
        assert determine_pose(xyz, used).tolist() == expected
