"""Learned descent: its frame, its steps, and what the network is shown."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.descent import (
    BodyState,
    DescentTargets,
    LearnedDescent,
    gradient_scale,
    inverse_3x3,
)
from shapepose_fg.body.fitting.network import NUM_PARAMETERS, NetworkConfig, UpdateNetwork
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.rotation import exp_so3
from shapepose_fg.body.model.target_skeletons import BODY_POINTS, TARGET_SKELETONS, slots

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
    """An untrained network, which stands still, or one that makes random steps of some centimetres."""
    torch.manual_seed(0)
    made = UpdateNetwork(NetworkConfig(width=32, blocks=1, steps=3)).eval()
    made.gradient_scale.copy_(gradient_scale(BodyModel.default().points, tuple(range(25))))
    if random:
        torch.nn.init.normal_(made.leave.weight, 0, 0.2)
    return made.requires_grad_(False)


def states(count: int = ROWS) -> BodyState:
    generator = torch.Generator().manual_seed(0)
    turns = 0.4 * torch.randn(count, 24, 3, generator=generator)
    place = 0.1 * torch.randn(count, 3, generator=generator)
    return BodyState(torch.randn(count, 10, generator=generator), exp_so3(turns), place)


def targets_of(places: tuple[int, ...]) -> DescentTargets:
    """Random targets: those of `places` known to 1 to 10 cm, along some directions better than along others."""
    rng = np.random.default_rng(0)
    root = torch.from_numpy(rng.uniform(-60, 60, (ROWS, 50, 3, 3))).float()
    information = torch.zeros(ROWS, 50, 3, 3)
    information[:, list(places)] = (root @ root.mT)[:, list(places)]
    return DescentTargets(torch.from_numpy(rng.normal(0, 0.4, (ROWS, 50, 3))).float(), information)


def assert_same(one: BodyState, other: BodyState, atol: float) -> None:
    for name, value in vars(one).items():
        np.testing.assert_allclose(value.numpy(), getattr(other, name).numpy(), atol=atol, err_msg=name)


def test_the_frame_undoes_a_rigid_motion_whatever_the_weights_are(frame):
    R = Rotation.random(ROWS, random_state=0).as_matrix()
    t = np.random.default_rng(0).uniform(-1, 1, (ROWS, 3))
    variance = torch.from_numpy(np.random.default_rng(1).uniform(0, 0.01, (ROWS, 50))).float()
    variance[:, 3:20] = torch.inf  # not to be used
    xyz = torch.einsum("bxy,ky->bkx", torch.from_numpy(R).float(), frame.rest_xyz) + torch.from_numpy(t)[:, None]
    xyz[:, 3:20] = 7.0
    rotation, pelvis = frame.place(xyz.float(), variance, ALL)
    np.testing.assert_allclose(rotation.numpy(), R, atol=1e-5)  # single precision, points within a metre
    np.testing.assert_allclose(pelvis.numpy(), t, atol=1e-5)
    some = slots(TARGET_SKELETONS["COCO_17"])
    rotation, pelvis = frame.place(xyz[:, list(some)].float(), torch.zeros(ROWS, 17), some)
    assert torch.linalg.det(rotation).numpy() == pytest.approx(1, abs=1e-5)


def test_a_mirrored_person_is_turned_and_not_mirrored(frame):
    mirrored = frame.rest_xyz * torch.tensor([-1.0, 1.0, 1.0])
    rotation, _ = frame.place(mirrored[None], torch.zeros(1, 50), ALL)
    assert float(torch.linalg.det(rotation[0])) == pytest.approx(1, abs=1e-5)


def test_the_frame_has_the_pelvis_at_its_origin_and_trusts_the_trunk(frame):
    assert float(frame.rest_xyz[BODY_POINTS.index("pelvis")].norm()) < 1e-6
    variance = dict(zip(BODY_POINTS, frame.rest_variance.tolist(), strict=True))
    assert variance["spine1"] < variance["left_shoulder"] < variance["left_elbow"] < variance["left_wrist"]
    assert variance["left_hip"] < variance["left_knee"] < variance["left_ankle"]
    # Wrists go about half a metre to all sides; the pelvis is where it is but for the shape.
    assert 0.1 < np.sqrt(variance["left_wrist"]) < 0.5


def test_an_untrained_network_stands_still(model):
    start = states()
    descent = LearnedDescent(model.points, ALL, network(random=False), 6.0)
    arrived = list(descent.unroll(start, targets_of(ALL)))
    assert len(arrived) == 3
    for state in arrived:
        assert_same(state, start, atol=1e-6)
    assert len(list(descent.unroll(start, targets_of(ALL), steps=2))) == 2


@pytest.mark.parametrize("name", TARGET_SKELETONS)
def test_a_skeleton_is_shown_to_the_network_as_all_points_without_the_rest(model, name):
    """What it was trained with: all points of the body, of which some have no target."""
    places = slots(TARGET_SKELETONS[name])
    rest = [place for place in ALL if place not in places]
    everything, targets, update = model.points, targets_of(places), network(random=True)
    whole = LearnedDescent(everything, ALL, update, 6.0).unroll(states(), targets)
    own = model.with_keypoints(TARGET_SKELETONS[name]).keypoint_points
    part = LearnedDescent(own, places, update, 6.0, others=everything.part(rest))
    seen = DescentTargets(targets.xyz[:, list(places)], targets.information[:, list(places)])
    for one, other in zip(part.unroll(states(), seen), whole, strict=True):
        assert_same(one, other, atol=1e-4)  # single precision through three steps
    moved = (one.transl - states().transl).norm(dim=1)
    assert float(moved.mean()) > 0.01


def test_points_that_are_no_targets_must_be_given(model):
    with pytest.raises(ValueError, match="others must be the 25 points"):
        LearnedDescent(model.keypoint_points, tuple(range(25)), network(random=False), 6.0)


def test_targets_without_information_change_nothing(model):
    places = slots(TARGET_SKELETONS["BODY_25"])
    targets, descent = targets_of(places), LearnedDescent(model.points, ALL, network(random=True), 6.0)
    elsewhere = targets.xyz.clone()
    elsewhere[:, 25:] += 100.0
    *_, one = descent.unroll(states(), targets)
    *_, other = descent.unroll(states(), DescentTargets(elsewhere, targets.information))
    assert_same(one, other, atol=0)
    *_, seen = descent.unroll(states(), targets_of(ALL))
    assert float((seen.transl - one.transl).abs().max()) > 1e-3  # those that have some do


def test_rows_are_independent_and_steps_are_rotations(model):
    targets, descent = targets_of(ALL), LearnedDescent(model.points, ALL, network(random=True), 6.0)
    *_, all_rows = descent.unroll(states(), targets)
    row = slice(2, 3)
    alone = BodyState(*(value[row] for value in vars(states()).values()))
    *_, one = descent.unroll(alone, DescentTargets(targets.xyz[row], targets.information[row]))
    assert_same(one, BodyState(*(value[row] for value in vars(all_rows).values())), atol=1e-5)
    eye = np.broadcast_to(np.eye(3), (ROWS, 24, 3, 3))
    np.testing.assert_allclose((all_rows.local.mT @ all_rows.local).numpy(), eye, atol=1e-5)


def test_gradients_reach_the_network_from_the_last_step_only_through_itself(model):
    update = network(random=True).requires_grad_()
    descent = LearnedDescent(model.points, ALL, update, 6.0)
    first, second, _ = descent.unroll(states(), targets_of(ALL))
    assert second.transl.requires_grad
    (slope,) = torch.autograd.grad(second.transl.sum(), update.leave.bias, retain_graph=True)
    # transl <- transl + 0.1 * output: each row gives 0.1, of the second step alone.
    np.testing.assert_allclose(slope[-3:].numpy(), 0.1 * ROWS, rtol=1e-5)
    assert first.transl.requires_grad


def test_networks_know_their_step_and_refuse_nonsense():
    made, inputs = network(random=True), torch.randn(4, UpdateNetwork.num_inputs)
    assert made(inputs, 0).shape == (4, NUM_PARAMETERS)
    assert float((made(inputs, 0) - made(inputs, 1)).abs().max()) > 1e-4
    for change in ({"width": 0}, {"steps": 15}, {"blocks": 0}):
        with pytest.raises(ValueError, match="must be at"):
            NetworkConfig(**change)
    with pytest.raises(ValueError, match="dropout"):
        NetworkConfig(dropout=1.0)


def test_inverses_by_cross_products():
    matrices = torch.from_numpy(np.random.default_rng(0).normal(size=(50, 3, 3)))
    np.testing.assert_allclose(inverse_3x3(matrices).numpy(), np.linalg.inv(matrices.numpy()), rtol=1e-8)
