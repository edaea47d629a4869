"""Keyframes: which they are, what is said of the frames between, and that a whole run holds what it
promises.
"""

from dataclasses import replace

import numpy as np
import pytest

from factors import CONSTANT_VELOCITY
from shapepose_fg.body.model.rotation import exp_so3, log_so3
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Known, Reconstruction, Status
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.evaluation.metrics import covariance_calibration, joint_metrics, match_people
from shapepose_fg.pipeline.keyframes import (
    keyframes,
    spaced,
    strays_m,
    with_bodies_between,
    with_rows_between,
)
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.results.solve_again import Solver, solve_rows
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.files import truth_of

FAST = PipelineConfig.fast()


def test_keyframes_are_as_few_as_time_allows():
    """At 25 frames a second every third; where one was dropped the step is not too long; each cut
    begins anew.
    """
    time_s = np.arange(11) / 25
    assert np.flatnonzero(spaced(time_s, 0.12)).tolist() == [0, 3, 6, 9, 10]
    time_s[5:] += 0.04
    assert np.flatnonzero(spaced(time_s, 0.12)).tolist() == [0, 3, 5, 8, 10]
    assert spaced(time_s, 0.0).all()
    assert np.flatnonzero(spaced(np.arange(4) / 5, 0.12)).tolist() == [0, 1, 2, 3]
    chosen = keyframes(np.arange(12) / 25, range(1, 11), [6], 0.12)
    assert np.flatnonzero(chosen).tolist() == [0, 1, 4, 5, 6, 9, 10, 11]  # 0 and 11 are not wanted


def moving(
    joints: np.ndarray, velocity: np.ndarray, time_s: np.ndarray, frame: np.ndarray
) -> Reconstruction:
    """Rows of one person whose joints are known exactly."""
    N, J = joints.shape[:2]
    empty = Reconstruction.empty([f"joint {j}" for j in range(J)])
    rows = {name: np.zeros((N, *getattr(empty, name).shape[1:])) for name in empty.ROWS}
    rows |= {"joints": joints, "velocity": velocity, "time_s": time_s, "frame": frame}
    rows |= {"person": np.zeros(N, int), "known": np.full((N, J), Known.SEEN, np.uint8)}
    rows |= {"status": np.full(N, Status.OK)}
    return replace(empty, **rows)


def test_between_keyframes_is_what_the_model_of_motion_says():
    """Mean and covariance of a state between two that are known, by conditioning the model's own
    Gaussian.
    """
    rng, frame, time_s = (
        np.random.default_rng(0),
        np.array([7, 8, 9, 10]),
        np.array([0.2, 0.24, 0.3, 0.32]),
    )
    ends = rng.normal(size=(2, 2, 1, 3)) * np.array([0.2, 2.0])[:, None, None, None]  # m, m/s
    rows = moving(ends[0], ends[1], time_s[[0, 3]], frame[[0, 3]])
    model = replace(MotionModel.load(("RWrist",)), psd_still=np.array([3.0]), psd_speed=np.zeros(1))
    found = with_rows_between(rows, frame, time_s, np.array([True, False, False, True]), model)
    assert found.frame.tolist() == frame.tolist()
    for n in (1, 2):
        first, second = time_s[n] - time_s[0], time_s[3] - time_s[n]
        F, Q = (
            (CONSTANT_VELOCITY.transition(dt) for dt in (first, second)),
            CONSTANT_VELOCITY.noise(first, 3.0),
        )
        before, after = F
        start = before @ ends[:, 0, 0]
        gain = (
            Q @ after.T @ np.linalg.inv(after @ Q @ after.T + CONSTANT_VELOCITY.noise(second, 3.0))
        )
        mean, left = start + gain @ (ends[:, 1, 0] - after @ start), Q - gain @ after @ Q
        np.testing.assert_allclose(found.joints[n, 0], mean[0], atol=1e-9)
        np.testing.assert_allclose(found.velocity[n, 0], mean[1], atol=1e-9)
        np.testing.assert_allclose(found.covariance[n, 0], left[0, 0] * np.eye(3), rtol=1e-6)
        np.testing.assert_allclose(
            found.velocity_covariance[n, 0], left[1, 1] * np.eye(3), rtol=1e-6
        )
    assert found.known.tolist() == [[Known.SEEN], [Known.MOTION], [Known.MOTION], [Known.SEEN]]


def test_how_far_a_joint_strays_between_keyframes_is_told_by_the_states_at_both():
    """Of swings, 20 cm to and fro, the error of the cubic; what goes straight on, or falls, does
    not stray.
    """
    time_s, joint = np.arange(31) * 0.1, np.zeros((31, 1, 3))
    steady, falling = joint + time_s[:, None, None], joint - 4.9 * time_s[:, None, None] ** 2
    assert strays_m(steady, np.ones_like(steady), time_s).max() < 1e-9
    assert strays_m(falling, -9.8 * time_s[:, None, None] + joint, time_s).max() < 0.03
    for frequency_hz, far in ((0.5, False), (4.0, True)):
        turn = 2 * np.pi * frequency_hz * np.array([1.0, 0.0, 0.0])
        swing, velocity = (
            0.2 * np.sin(time_s[:, None, None] * turn),
            0.2 * turn * np.cos(time_s[:, None, None] * turn),
        )
        assert (strays_m(swing, velocity, time_s).mean() > 0.03) == far


def test_bodies_turn_evenly_between_keyframes(scene):
    """Once around in 0.8 s, past the angle at which rotation vectors jump; where a keyframe has no
    body, the interval is twice as long, and before the first and after the last is none.
    """
    time_s, number = np.arange(-2, 35) * 0.025, np.arange(37)
    axis = np.array([0.6, 0.0, 0.8])
    turn = log_so3(exp_so3(time_s[:, None] / 0.8 * 2 * np.pi * axis))
    columns = {
        "betas": np.zeros((37, 10)),
        "global_orient": turn,
        "body_pose": np.tile(turn[:, None], (1, 23, 1)),
        "transl": np.stack([time_s**2, time_s, 0 * time_s], axis=1),
    }
    truth = truth_of(scene).rows(np.zeros(37, dtype=int))
    truth = replace(truth, frame=number, time_s=time_s, **columns)
    key = (number % 4 == 2) & (number != 26)
    given = {name: np.where(key.reshape(-1, *[1] * (each.ndim - 1)), each, np.nan)
             for name, each in columns.items()}  # fmt: skip
    status = np.where(key, Status.OK, Status.BODY_UNDETERMINED)
    found = with_bodies_between(replace(truth, status=status, **given))
    inside = (number >= 2) & (number <= 34)
    assert np.array_equal(np.isfinite(found.betas).all(axis=1), inside)
    assert np.array_equal(found.status == Status.OK, inside)
    apart = log_so3(exp_so3(found.global_orient[inside]).mT @ exp_so3(turn[inside]))
    # 45 degrees a keyframe, once 90; a straight line: 0.05
    far = np.linalg.norm(apart, axis=-1)
    assert np.delete(far, np.arange(20, 29)).max() < 0.02 and far.max() < 0.1
    middle = (time_s > 0.1) & (time_s < 0.5)  # slopes at ends are of one side
    np.testing.assert_allclose(found.transl[middle], truth.transl[middle], atol=1e-9)
    np.testing.assert_allclose(
        found.body_pose[inside][:, 4], found.global_orient[inside], atol=1e-12
    )


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=3, cameras=4, frames=46)


@pytest.fixture(scope="module")
def results(scene):
    """By default, and fast."""
    times = FrameTimes.from_fps(scene.fps, len(scene))
    return [
        reconstruct(simulate(scene), scene.rig, config, times=times)
        for config in (PipelineConfig(), FAST)
    ]


@pytest.mark.slow
def test_fast_finds_the_same_people_as_surely(scene, results):
    """Everybody in every frame, with a body; as near to the truth but for a fifth, and no surer
    than right.
    """
    accurate, fast = results
    assert len(fast) == len(accurate) == 3 * 46
    assert (fast.status == Status.OK).all()
    key = fast.frame % 3 == 0
    key |= fast.frame == 45
    assert Known.observed(fast.known[key]).mean() > 0.9
    assert not Known.observed(fast.known[~key]).any()
    assert (fast.observations.candidate[~key] == -1).all()
    errors = [joint_metrics(people, scene.keypoints) for people in results]
    assert errors[1].f1 > errors[0].f1 - 0.01
    assert errors[1].mpjpe_mm < 1.2 * errors[0].mpjpe_mm
    matches = match_people(fast.frame, fast.joints, scene.keypoints)
    between = ~key[matches.row]
    error = fast.joints[matches.row] - scene.keypoints[matches.frame, matches.person]
    inside = covariance_calibration(error[between], fast.covariance[matches.row[between]]).coverage
    # Of this one scene, whose errors last.
    assert inside[0.95] > 0.85
    assert inside[0.5] < 0.8


@pytest.mark.slow
def test_fast_results_are_solved_anew(scene, results):
    """The same rows, where they were: what is between keyframes is carried again, and not solved
    from nothing. Windows that overlap by frames of the next one lose no row of anybody.
    """
    fast = results[1]
    solver = Solver.of(fast, scene.rig)
    again = solve_rows(fast, solver)
    in_windows = replace(solver, config=replace(FAST, batch_frames=16))
    some = fast.rows(fast.frame < 24)
    np.testing.assert_array_equal(solve_rows(some, in_windows).frame, some.frame)
    np.testing.assert_array_equal(again.frame, fast.frame)
    np.testing.assert_array_equal(again.person, fast.person)
    assert (again.status == Status.OK).all()
    assert np.nanmedian(np.linalg.norm(again.joints - fast.joints, axis=-1)) < 0.003
    # A gate falls the other way where a joint is on its edge: 2 of 3,450 on one kind of processor,
    # 0 on another.
    assert ((again.known == Known.MOTION) != (fast.known == Known.MOTION)).mean() < 0.002
