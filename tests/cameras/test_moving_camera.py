"""The start of a carried phone's odometry: found from the people, wherever and whenever it was, or
refused.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.cameras import moving as moving_camera
from shapepose_fg.cameras.bundle import Freedom
from shapepose_fg.cameras.calibrate.from_people import Undetermined
from shapepose_fg.cameras.moving import Filmed, Placed, Start
from shapepose_fg.core.camera import Camera
from shapepose_fg.core.decompositions import rigid
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.estimation.trajectory_graph import correlated
from shapepose_fg.simulation.scene import UP, look_at
from tests.cameras.conftest import moving

K = np.array([[1000.0, 0, 639.5], [0, 1000, 359.5], [0, 0, 1]])
LATE_S = 7.31
OWN_S = np.arange(0, 24, 1 / 15)


def path(time: np.ndarray) -> np.ndarray:
    """(F, 4, 4) poses of a phone that is carried around people."""
    angle = 1.2 * np.sin(0.25 * time)
    eyes = np.stack([4 * np.cos(angle), 4 * np.sin(angle), 1.5 + 0.1 * np.sin(2 * time)], axis=-1)
    return np.stack([look_at(eye, np.array([0, 0, 0.9]), UP) for eye in eyes])


@pytest.fixture(scope="module")
def walk(two_people) -> Placed:
    """Three people who walk and wave for 36 s, as fixed cameras place them."""
    rng, time = np.random.default_rng(0), np.arange(0, 36, 0.2)
    points = np.stack([moving(two_people[0], t) for t in time])[:, :, :15]
    points = points + rng.normal(0, 0.01, points.shape)
    moment = np.repeat(np.arange(len(time)), 3)
    return Placed.of(time[moment], moment, points.reshape(-1, 15, 3))


@pytest.fixture(scope="module")
def filmed(two_people) -> Filmed:
    """The same people in a phone whose log is turned by a quarter, and starts anywhere."""
    rng, wTc = np.random.default_rng(1), path(OWN_S)
    people = np.stack([moving(two_people[0], t) for t in OWN_S + LATE_S])[:, :, :15]
    at = np.einsum(
        "fij,fpkj->fpki", np.linalg.inv(wTc)[:, :3, :3], people - wTc[:, None, None, :3, 3]
    )
    rays = at / at[..., 2:]
    rays[..., :2] += rng.normal(0, 2 / 1000, rays[..., :2].shape)
    oTw = rigid(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 10, 3))
    mount = rigid(Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.zeros(3))
    log = Trajectory("phone", OWN_S, oTw @ wTc @ mount)
    return Filmed(Camera("phone", K, np.eye(4), (1280, 720)), log, OWN_S, rays)


MOST_S = 20.0
"""The phone began at most so much earlier or later than the fixed cameras."""


@pytest.fixture(scope="module")
def start(walk, filmed):
    return filmed.started(walk, MOST_S, Freedom())


@pytest.fixture
def one_start(monkeypatch):
    """The start on which most agree is refined, and none of its rivals."""
    monkeypatch.setattr(moving_camera, "_PEAKS", 1)


def test_the_start_is_found_anywhere(filmed, start):
    camera, odometry = start.of(filmed.camera, filmed.trajectory)
    found = odometry.wTb @ camera.bTc
    away = np.linalg.norm(found[:, :3, 3] - path(OWN_S)[:, :3, 3], axis=1)
    turn = Rotation.from_matrix(found[:, :3, :3].mT @ path(OWN_S)[:, :3, :3]).magnitude()
    assert abs(start.offset_s - LATE_S) < 0.02 and away.max() < 0.05
    assert np.degrees(turn).max() < 0.6 and start.share > 0.9
    assert start.sigma_turn_deg < 1.0 and start.sigma_move_m < 0.05
    assert np.degrees(turn).max() < 3 * start.sigma_turn_deg
    assert away.max() < 3 * start.sigma_move_m
    np.testing.assert_allclose(camera.K, K)
    assert odometry.time_s[0] == pytest.approx(start.offset_s)


def test_it_is_refused_if_it_is_less_sure_than_asked_or_the_fixed_cameras_are(walk, filmed, start):
    """The sentence has the figures and the cure; errors of the fixed cameras count."""
    bounds = np.array([start.within_deg, start.within_m])
    assert start.within_deg > start.sigma_turn_deg and start.within_m > start.sigma_move_m
    said = start.refusal("phone", *(0.9 * bounds))
    assert said is not None and "camera phone: its poses are known to" in said
    assert "are required (--tolerance); give the lenses" in said
    assert start.refusal("phone", *(1.1 * bounds)) is None
    shifted = replace(walk, spread=np.full((*walk.points.shape, 1), 0.05))
    other = filmed._refined(start, shifted, MOST_S, Freedom(), 0.0)
    assert other.sigma_move_m == pytest.approx(np.hypot(start.sigma_move_m, 0.0866), rel=0.1)


def test_the_drift_and_the_unit_of_an_odometry_are_found(walk, filmed, one_start):
    """Its heading and its height drift, and its metres are 2 % too long."""
    log, part = filmed.trajectory, OWN_S / OWN_S[-1]
    up = (
        log.wTb[0, :3, :3]
        @ np.linalg.inv(
            path(OWN_S[:1])[0, :3, :3] @ Rotation.from_euler("z", 90, degrees=True).as_matrix()
        )
        @ UP
    )
    turn = Rotation.from_rotvec(np.radians(1.5) * part[:, None] * up).as_matrix()
    at = 1.02 * log.wTb[:, :3, 3] + 0.15 * part[:, None] * up
    drifted = replace(filmed, trajectory=replace(log, wTb=rigid(turn @ log.wTb[:, :3, :3], at)))
    start = drifted.started(walk, MOST_S, Freedom())
    found = start.of(drifted.camera, drifted.trajectory)[1].wTb @ start.bTc
    away = np.linalg.norm(found[:, :3, 3] - path(OWN_S)[:, :3, 3], axis=1)
    turned = Rotation.from_matrix(found[:, :3, :3].mT @ path(OWN_S)[:, :3, :3]).magnitude()
    assert away.max() < 0.08 and np.degrees(turned).max() < 0.8
    assert start.stretch == pytest.approx(1 / 1.02, abs=0.01) and start.share > 0.9


@pytest.mark.slow
def test_errors_are_as_large_as_printed(walk, filmed):
    """Over six draws of errors of the detector that last, and of the log's drift."""
    time_s, wTc = OWN_S[:, None], path(OWN_S)
    lasting = np.linalg.cholesky(
        correlated(time_s - time_s.T) / correlated(0.0) + 1e-6 * np.eye(len(OWN_S))
    )
    steps = np.diff(wTc[:, :3, 3], axis=0)
    root = np.sqrt(np.linalg.norm(steps, axis=1))[:, None]
    ratio = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        drift = np.cumsum(filmed.trajectory.drift * root * rng.normal(size=steps.shape), axis=0)
        log = wTc.copy()
        log[1:, :3, 3] += drift
        off = np.einsum("fg,gpjc->fpjc", lasting, rng.normal(size=filmed.rays[..., :2].shape))
        rays = filmed.rays.copy()
        rays[..., :2] += 8 / 1000 * off
        seen = replace(filmed, rays=rays, trajectory=Trajectory("phone", OWN_S, log))
        start = seen._refined(Start(np.eye(4), np.eye(4), LATE_S), walk, MOST_S, Freedom(), 0.0)
        away = seen._placed(start)[:, :3, 3] - wTc[:, :3, 3]
        ratio.append(np.sqrt((away**2).sum(axis=1).mean()) / start.sigma_move_m)
    assert 0.5 < np.mean(np.square(ratio)) < 2.0


def test_an_unknown_focal_length_is_found_too(walk, filmed):
    wrong = replace(filmed, rays=filmed.rays * [1.06, 1.06, 1.0])
    start = wrong.started(walk, MOST_S, Freedom(focal=0.2, centre_px=8.0))
    assert start.focal == pytest.approx(1.06, abs=0.015)


@pytest.mark.slow
def test_an_unknown_principal_point_is_found_and_does_not_turn_the_camera(walk, filmed, one_start):
    """Found as a rotation of the camera instead, it would be off by 1.6 degrees."""
    wrong = replace(filmed, rays=filmed.rays + np.array([0.02, -0.02, 0.0]))
    start = wrong.started(walk, MOST_S, Freedom(centre_px=20.0))
    camera, odometry = start.of(filmed.camera, filmed.trajectory)
    turn = (odometry.wTb @ camera.bTc)[:, :3, :3].mT @ path(OWN_S)[:, :3, :3]
    assert np.degrees(Rotation.from_matrix(turn).magnitude()).max() < 0.8
    np.testing.assert_allclose(camera.K[:2, 2] - K[:2, 2], [20, -20], atol=6)


@pytest.mark.slow
def test_an_unknown_distortion_is_found_and_does_not_move_the_camera(walk, filmed, one_start):
    """People look 1 to 3 % larger through such a lens."""
    square = (filmed.rays[..., :2] ** 2).sum(axis=-1, keepdims=True)
    bent = replace(filmed, rays=filmed.rays * [1, 1, 0] * (1 + 0.15 * square) + [0, 0, 1])
    start = bent.started(walk, MOST_S, Freedom(lens=0.1))
    camera, odometry = start.of(bent.camera, bent.trajectory)
    away = np.linalg.norm((odometry.wTb @ camera.bTc)[:, :3, 3] - path(OWN_S)[:, :3, 3], axis=1)
    assert camera.distortion[0] == start.k1 == pytest.approx(0.15, abs=0.05)
    assert np.sqrt((away**2).mean()) < start.within_m


@pytest.mark.slow
def test_the_prior_on_the_unit_stays_where_it_was_given(walk, filmed, one_start):
    """People look 4 % larger than the log says: refined again, the start stays."""
    log = replace(filmed.trajectory, drift=0.002)
    larger = replace(filmed, rays=filmed.rays * [1.04, 1.04, 1.0], trajectory=log)
    once = larger.started(walk, MOST_S, Freedom())
    again = larger._refined(once, walk, MOST_S, Freedom(), 0.0)
    assert abs(np.log(once.stretch)) > 0.003
    assert again.stretch == pytest.approx(once.stretch, abs=1e-3)


def test_a_log_of_another_walk_and_people_who_stand_are_refused(walk, filmed):
    still = path(np.zeros(len(OWN_S)))
    rng = np.random.default_rng(2)
    still[:, :3, 3] += np.cumsum(rng.normal(0, 0.05, (len(OWN_S), 3)), axis=0)
    other = replace(filmed, trajectory=replace(filmed.trajectory, wTb=still))
    with pytest.raises(Undetermined, match="camera phone: ") as refused:
        other.started(walk, MOST_S, Freedom())
    assert "; film the people" in str(refused.value)
    standing = Placed.of(walk.time_s, walk.moment, walk.points[walk.moment * 0])
    with pytest.raises(Undetermined, match="camera phone: "):
        filmed.started(standing, MOST_S, Freedom())
    nobody = replace(filmed, own_s=filmed.own_s[:3], rays=filmed.rays[:3])
    with pytest.raises(Undetermined, match="camera phone: too few people are seen"):
        nobody.started(walk, MOST_S, Freedom())
