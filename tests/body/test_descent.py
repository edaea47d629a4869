"""Learned descent: its frame, its steps, and what the network is shown."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.descent import (
    DescentState,
    LearnedDescent,
    NetworkInputs,
    gradient_scale,
    moved,
)
from shapepose_fg.body.fitting.network import (
    NUM_PARAMETERS,
    NetworkConfig,
    UpdateNetwork,
    layer_shapes,
)
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.rotation import exp_so3
from shapepose_fg.body.model.target_skeletons import BODY_POINTS, TARGET_SKELETONS, slots
from tests.body.mirrored_offsets import symmetric

ALL = tuple(range(len(BODY_POINTS)))
ROWS = 6


@pytest.fixture(scope="module")
def model() -> BodyModel:
    return BodyModel.default()


@pytest.fixture(scope="module")
def frame(model) -> PersonFrame:
    poses = PosePrior.default().sample(np.random.default_rng(0), 300)
    poses = np.concatenate((np.zeros((300, 1, 3)), poses), axis=1)
    return PersonFrame.of(model, poses, np.ones(300))


def network(random: bool) -> UpdateNetwork:
    """A network that stands still, or one that makes random steps of some centimetres."""
    config, rng = NetworkConfig(width=32, blocks=1, steps=3), np.random.default_rng(0)
    weights = {name: 0.1 * rng.normal(size=shape) for name, shape in layer_shapes(config).items()}
    weights["gradient_scale"] = gradient_scale(BodyModel.default().points, tuple(range(25)))
    weights["leave.weight"] *= 0.5 * random
    weights["leave.bias"] *= random
    return UpdateNetwork(config, weights)


def states(count: int = ROWS) -> DescentState:
    rng = np.random.default_rng(0)
    turns, place = 0.4 * rng.normal(size=(count, 24, 3)), 0.1 * rng.normal(size=(count, 3))
    return DescentState(rng.normal(size=(count, 10)), exp_so3(turns), place)


def targets_of(places: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Random targets: those of `places` known to 1 to 10 cm, along some directions better than
    along others.
    """
    rng = np.random.default_rng(0)
    root = rng.uniform(-60, 60, (ROWS, 50, 3, 3))
    information = np.zeros((ROWS, 50, 3, 3))
    information[:, list(places)] = (root @ root.swapaxes(-1, -2))[:, list(places)]
    return rng.normal(0, 0.4, (ROWS, 50, 3)), information


def assert_same(one: DescentState, other: DescentState, atol: float) -> None:
    for name, value in vars(one).items():
        np.testing.assert_allclose(value, getattr(other, name), atol=atol, err_msg=name)


def test_the_frame_undoes_a_rigid_motion_whatever_the_weights_are(frame):
    R = Rotation.random(ROWS, random_state=0).as_matrix()
    t = np.random.default_rng(0).uniform(-1, 1, (ROWS, 3))
    variance = np.random.default_rng(1).uniform(0, 0.01, (ROWS, 50))
    variance[:, 3:20] = np.inf  # not to be used
    xyz = np.einsum("bxy,ky->bkx", R, frame.rest_xyz) + t[:, None]
    xyz[:, 3:20] = 7.0
    rotation, pelvis = frame.place(xyz, variance, ALL)
    np.testing.assert_allclose(rotation, R, atol=1e-5)  # single precision, points within a metre
    np.testing.assert_allclose(pelvis, t, atol=1e-5)
    some = slots(TARGET_SKELETONS["COCO_17"])
    rotation, pelvis = frame.place(xyz[:, list(some)], np.zeros((ROWS, 17)), some)
    assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-5)


def test_a_mirrored_person_is_turned_and_not_mirrored(frame):
    mirrored = frame.rest_xyz * np.array([-1.0, 1.0, 1.0])
    rotation, _ = frame.place(mirrored[None], np.zeros((1, 50)), ALL)
    assert float(np.linalg.det(rotation[0])) == pytest.approx(1, abs=1e-5)


def test_the_frame_has_the_pelvis_at_its_origin_and_trusts_the_trunk(frame):
    assert np.linalg.norm(frame.rest_xyz[BODY_POINTS.index("pelvis")]) < 1e-6
    variance = dict(zip(BODY_POINTS, frame.rest_variance.tolist(), strict=True))
    assert (
        variance["spine1"]
        < variance["left_shoulder"]
        < variance["left_elbow"]
        < variance["left_wrist"]
    )
    assert variance["left_hip"] < variance["left_knee"] < variance["left_ankle"]
    # Wrists go about half a metre to all sides; the pelvis is where it is but for the shape.
    assert 0.1 < np.sqrt(variance["left_wrist"]) < 0.5


def test_an_untrained_network_stands_still(model):
    start = states()
    descent = LearnedDescent(model.points, ALL, network(random=False), 6.0)
    arrived = list(descent.unroll(start, *targets_of(ALL)))
    assert len(arrived) == 3
    for state in arrived:
        assert_same(state, start, atol=1e-6)


@pytest.mark.parametrize("name", TARGET_SKELETONS)
def test_a_skeleton_is_shown_to_the_network_as_all_points_without_the_rest(model, name):
    """What it was trained with: all points of the body, of which some have no target."""
    places = slots(TARGET_SKELETONS[name])
    rest = [place for place in ALL if place not in places]
    everything, (xyz, information), update = model.points, targets_of(places), network(random=True)
    whole = LearnedDescent(everything, ALL, update, 6.0).unroll(states(), xyz, information)
    own = model.with_keypoints(TARGET_SKELETONS[name]).keypoint_points
    part = LearnedDescent(own, places, update, 6.0, others=everything.part(rest))
    seen = xyz[:, list(places)], information[:, list(places)]
    for one, other in zip(part.unroll(states(), *seen), whole, strict=True):
        assert_same(one, other, atol=1e-4)  # single precision through three steps
    moved = np.linalg.norm(one.transl - states().transl, axis=1)
    assert float(moved.mean()) > 0.01


def test_points_that_are_no_targets_must_be_given(model):
    with pytest.raises(ValueError, match="others must be the 25 points"):
        LearnedDescent(model.keypoint_points, tuple(range(25)), network(random=False), 6.0)


def test_targets_without_information_change_nothing(model):
    places = slots(TARGET_SKELETONS["BODY_25"])
    (xyz, information), descent = (
        targets_of(places),
        LearnedDescent(model.points, ALL, network(random=True), 6.0),
    )
    elsewhere = xyz.copy()
    elsewhere[:, 25:] += 100.0
    *_, one = descent.unroll(states(), xyz, information)
    *_, other = descent.unroll(states(), elsewhere, information)
    assert_same(one, other, atol=0)
    *_, seen = descent.unroll(states(), *targets_of(ALL))
    assert np.abs(seen.transl - one.transl).max() > 1e-3  # those that have some do


def test_rows_are_independent_and_steps_are_rotations(model):
    (xyz, information), descent = (
        targets_of(ALL),
        LearnedDescent(model.points, ALL, network(random=True), 6.0),
    )
    *_, all_rows = descent.unroll(states(), xyz, information)
    row = slice(2, 3)
    alone = DescentState(*(value[row] for value in vars(states()).values()))
    *_, one = descent.unroll(alone, xyz[row], information[row])
    assert_same(one, DescentState(*(value[row] for value in vars(all_rows).values())), atol=1e-5)
    eye = np.broadcast_to(np.eye(3), (ROWS, 24, 3, 3))
    np.testing.assert_allclose((all_rows.local.swapaxes(-1, -2) @ all_rows.local), eye, atol=1e-5)


def test_networks_know_their_step_and_refuse_nonsense():
    made, inputs = network(random=True), np.ones((4, UpdateNetwork.num_inputs), np.float32)
    assert made(inputs, 0).shape == (4, NUM_PARAMETERS)
    assert np.abs(made(inputs, 0) - made(inputs, 1)).max() > 1e-4
    for change in ({"width": 0}, {"steps": 15}, {"blocks": 0}):
        with pytest.raises(ValueError, match="must be at"):
            NetworkConfig(**change)
    with pytest.raises(ValueError, match="dropout"):
        NetworkConfig(dropout=1.0)


@pytest.mark.parametrize("name", ["BODY_25", "COCO_17"])
def test_what_the_network_sees(any_body, name):
    """Against dense inverses and the points' Jacobian; the detector's joints lie elsewhere than the
    body's.
    """
    offsets = symmetric({"LHip": (0.05, 0.06, 0.0), "LWrist": (0.0, 0.0, -0.05)})
    model, places = any_body.with_keypoints(TARGET_SKELETONS[name]), slots(TARGET_SKELETONS[name])
    model = model.with_keypoint_offsets(offsets)
    rest, state = [place for place in ALL if place not in places], states()
    see = NetworkInputs(
        model.keypoint_points, places, 60.0, any_body.points.part(rest), model.offsets_of_keypoints
    )
    xyz, information = (each[:, list(places)] for each in targets_of(places))
    information[:, 3] = 0
    inputs = see(state, xyz, information, np.full(79, 1e-4))
    given = state.local, state.betas, state.transl
    placed, jacobian = model.keypoint_points.positions_with_jacobian(*given)
    reach, trust = (
        information @ np.linalg.inv(information + np.eye(3) / sigma**2) for sigma in (0.1, 0.03)
    )
    away = (reach @ (xyz - placed)[..., None])[..., 0]
    away /= 1 + np.linalg.norm(away, axis=-1, keepdims=True) / 0.5
    seen = inputs[:, :350].reshape(ROWS, 50, 7)
    expected = any_body.points.positions(*given)
    expected[:, list(places)] += away
    np.testing.assert_allclose(seen[..., :3], expected, atol=1e-6)
    np.testing.assert_allclose(seen[:, list(places), 3:6], 5 * away, atol=1e-6)
    np.testing.assert_allclose(
        seen[:, list(places), 6], np.trace(trust, axis1=2, axis2=3) / 3, atol=1e-6
    )
    assert not seen[:, rest, 3:].any() and not seen[:, places[3], 3:].any()
    np.testing.assert_allclose(inputs[:, 350:360], state.betas / 3, atol=1e-6)
    columns = state.local[:, :22, :, :2].swapaxes(2, 3).reshape(ROWS, -1)
    np.testing.assert_allclose(inputs[:, 360:492], columns, atol=1e-6)
    np.testing.assert_allclose(inputs[:, 492:495], state.transl, atol=1e-6)
    force = (information @ (xyz - placed)[..., None])[..., 0]
    force *= ((3600 / (3600 + ((xyz - placed) * force).sum(-1))) ** 2)[..., None]
    slope = np.einsum("bkxp,bkx->bp", jacobian, force)[:, [*range(76), *range(82, 85)]]
    np.testing.assert_allclose(inputs[:, 495:], np.clip(1e-4 * slope, -3, 3), rtol=1e-5, atol=1e-6)
    assert 0.01 < np.abs(inputs[:, 495:]).max() <= 3


def turned(columns: np.ndarray) -> np.ndarray:
    """(N, 3, 3) what becomes of two columns (N, 6)."""
    change, local = (
        np.zeros((len(columns), NUM_PARAMETERS), np.float32),
        np.zeros((len(columns), 24, 3, 3)),
    )
    change[:, 16:22] = columns
    moved(change, 1.0, np.zeros((len(columns), 10)), local, np.zeros((len(columns), 3)))
    return local[:, 1]


def test_any_two_columns_become_a_rotation_with_the_first_ones_direction():
    columns = np.random.default_rng(0).normal(0, 3, (200, 6)).astype(np.float32).astype(float)
    R = turned(columns)
    np.testing.assert_allclose(
        (R.swapaxes(-1, -2) @ R), np.tile(np.eye(3), (200, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-12)
    first, second = columns[:, :3], columns[:, 3:]
    np.testing.assert_allclose(
        R[..., 0], first / np.linalg.norm(first, axis=1, keepdims=True), atol=1e-15
    )
    # The second column is spanned by both and leans to its own side: nothing of it along the third.
    np.testing.assert_allclose((R[..., 2] * second).sum(1), 0, atol=1e-12)
    assert ((R[..., 1] * second).sum(1) > 0).all()


def test_columns_without_a_rotation_are_nan_and_not_some_rotation():
    columns = np.array([[0.0, 0, 0, 0, 1, 0], [1.0, 0, 0, 0, 0, 0], [1.0, 0, 0, 2, 0, 0]])
    assert np.isnan(turned(columns)).any(-1).any(-1).all()
