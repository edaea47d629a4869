"""Stage II over several frames: motion, joints lost from sight, factors of one's own, what went
wrong.
"""

import json
from dataclasses import replace
from importlib.resources import files

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, FitStatus
from shapepose_fg.core.camera import Views
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Known, Status
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.estimator_config import EstimatorConfig, RefineConfig
from shapepose_fg.estimation.in_time import interpolated, near_in_time
from shapepose_fg.estimation.motion_model import MotionConfig, MotionModel
from shapepose_fg.estimation.state import window_rows
from shapepose_fg.estimation.state_covariances import state_covariances
from shapepose_fg.estimation.window_graph import WindowGraph
from shapepose_fg.estimation.window_solution import WindowSolution
from shapepose_fg.pipeline.solve_window import solve_window
from shapepose_fg.simulation.scene import UP, look_at
from tests.marks import slow

FPS = 25.0
FRAMES = 30
WRIST, OTHER_WRIST, NOSE = (BODY_25.index(name) for name in ("RWrist", "LWrist", "Nose"))


class BesideFitter(BodyFitter):
    """Puts each row's body where the seen joints are, moved by `beside` (3,) metres; remembers what
    it was asked.
    """

    def __init__(
        self, shape: NDArray[np.float64], beside=(0.0, 0.0, 0.0), sigma_m: float = 0.1
    ) -> None:
        self.shape, self.beside, self.sigma_m = shape, np.array(beside), sigma_m
        self.groups: list[NDArray[np.intp] | None] = []
        self.without: list[set[int]] = []

    def fit(self, targets, initial=None, groups=None) -> BodyFit:
        self.groups.append(groups)
        seen = targets.information.any(axis=(2, 3))
        self.without.append(set(np.flatnonzero(~seen.any(axis=0)).tolist()))
        ok = seen.sum(axis=1) >= 4
        apart = np.where(seen[..., None], targets.xyz - self.shape, 0.0).sum(axis=1)
        moved = apart / np.maximum(seen.sum(axis=1), 1)[:, None]
        xyz = self.shape + moved[:, None] + self.beside
        failed = BodyFit.failed(
            np.where(ok, FitStatus.OK, FitStatus.TOO_FEW_JOINTS), self.shape.shape[0]
        )
        covariance = np.tile(self.sigma_m**2 * np.eye(3), (*seen.shape, 1, 1))
        return replace(
            failed,
            prior_xyz=np.where(ok[:, None, None], xyz, np.nan),
            prior_covariance=np.where(ok[:, None, None, None], covariance, np.nan),
        )


class NobodyFitter(BodyFitter):
    """Fits no body to anybody."""

    def fit(self, targets, initial=None, groups=None) -> BodyFit:
        return BodyFit.failed(np.full(len(targets), FitStatus.TOO_FEW_JOINTS), targets.xyz.shape[1])


class PlacingFitter(BesideFitter):
    """The same, with a body, known to `sigma_m`: its joints are not aside, only what it says
    without them is.
    """

    def fit(self, targets, initial=None, groups=None) -> BodyFit:
        fit = super().fit(targets, initial, groups)
        return replace(fit, joints=fit.prior_xyz - self.beside, covariance=fit.prior_covariance)


@pytest.fixture(scope="module")
def walk(five_cameras, two_people):
    """Two people who walk 1 m/s, 30 frames, noise of 3 px: observations and truth (60, 25, 3)."""
    times = np.arange(FRAMES) / FPS
    velocity = np.array([[0.5, 0.0, 0.0], [0.0, -1.0, 0.0]])
    both = np.stack([two_people[0], two_people[0] + [0.9, 0.2, 0.0]])
    truth = both[None] + times[:, None, None, None] * velocity[None, :, None]
    truth = (truth - times.mean() * velocity[None, :, None]).reshape(-1, 25, 3)
    xy = np.moveaxis(five_cameras.project(truth)[0], 0, 2)
    xy = xy + np.random.default_rng(0).normal(0, 3.0, xy.shape)
    frame, track = np.divmod(np.arange(2 * FRAMES), 2)
    time_s = np.repeat(frame[:, None] / FPS, 5, axis=1)
    return Observations(
        xy, np.full(xy.shape[:3], 0.8), np.full(truth.shape, np.nan), track, frame, time_s
    ), truth


def hidden(observations: Observations, rows, joint: int) -> Observations:
    """The same, one joint unseen in some rows."""
    confidence, xy = observations.confidence.copy(), observations.xy.copy()
    confidence[rows, joint], xy[rows, joint] = 0.0, 0.0
    return replace(observations, confidence=confidence, xy=xy)


def one_view_less(observations: Observations, rows, joint: int, view: int) -> Observations:
    """The same, one joint unseen by one view in some rows."""
    confidence, xy = observations.confidence.copy(), observations.xy.copy()
    confidence[rows, joint, view], xy[rows, joint, view] = 0.0, 0.0
    return replace(observations, confidence=confidence, xy=xy)


def solve(
    observations: Observations, rig, fitter, extra_factors=None, *, temporal=True, **motion
) -> WindowSolution:
    if not temporal:
        observations = replace(observations, track=np.arange(len(observations)))
    config = EstimatorConfig(motion=MotionConfig(**motion))
    return solve_window(observations, Views.of(rig), fitter, config, extra_factors=extra_factors)


def test_a_row_without_others_of_its_track_stands_alone(walk, five_cameras, two_people):
    """Whatever its track and company: every row of a batch is what it is by itself."""
    observations, _ = walk
    together = solve(observations, five_cameras, BesideFitter(two_people[0]), temporal=False)
    for row in (0, 31, 59):
        one = solve(observations.rows(np.array([row])), five_cameras, BesideFitter(two_people[0]))
        for name in ("joints", "covariance", "confidence", "inlier", "known", "status"):
            np.testing.assert_array_equal(getattr(one, name)[0], getattr(together, name)[row])
    assert np.isnan(together.velocity).all() and np.isnan(together.velocity_covariance).all()


def test_a_lone_row_is_what_it_is_by_itself_beside_somebody_s_window(
    walk, five_cameras, two_people
):
    """Its wrist, which one view saw, is not placed by the draft that windows start from."""
    observations, _ = walk
    track = np.where(observations.track == 0, 0, np.arange(len(observations)))
    seen = replace(observations, track=track)
    row = np.array([31])
    for view in range(1, 5):
        seen = one_view_less(seen, row, WRIST, view)
    together = solve(seen, five_cameras, PlacingFitter(two_people[0], (0.0, 0.05, 0.0)))
    alone = solve(seen.rows(row), five_cameras, PlacingFitter(two_people[0], (0.0, 0.05, 0.0)))
    for name in ("joints", "covariance", "confidence", "inlier", "known", "status"):
        np.testing.assert_array_equal(getattr(alone, name)[0], getattr(together, name)[31])


def test_a_start_that_is_not_complete_is_for_frames_alone(walk, five_cameras, two_people):
    """Nothing placed by stage I and no triangulation: alone there is nobody, a window has its
    draft.
    """
    observations, truth = walk
    config = EstimatorConfig(refine=RefineConfig(complete_start=False))
    asked = Views.of(five_cameras), NobodyFitter(), config
    alone = solve_window(replace(observations, track=np.arange(len(observations))), *asked)
    assert (alone.status == Status.TOO_FEW_VIEWS).all() and np.isnan(alone.joints).all()
    np.testing.assert_allclose(solve_window(observations, *asked).joints, truth, atol=0.03)


@pytest.mark.parametrize("views_left", [0, *slow(1)])
def test_a_wrist_out_of_sight_goes_where_the_body_can_have_it(
    walk, five_cameras, two_people, views_left
):
    """From frame 5 on no view sees the first wrist, or one does: it drifts towards what the body
    says without it, aside or along the ray. With `keep_limbs` it goes towards the body's joint, and
    its forearm gets its length where a ray leaves it open; nothing else moves, and others'
    covariances stay.
    """
    observations, truth = walk
    rows = np.flatnonzero((observations.track == 0) & (observations.frame >= 5))
    seen, elbow = observations, BODY_25.index("RElbow")
    for view in range(views_left, 5):
        seen = one_view_less(seen, rows, WRIST, view)
    forearm = two_people[0, WRIST] - two_people[0, elbow]
    length = np.linalg.norm(forearm)
    ray = two_people[0, WRIST] - five_cameras.cameras[0].wTc[:3, 3]
    aside = ray if views_left == 1 else np.cross(forearm, [0.0, 0.0, 1.0])
    fitter = PlacingFitter(two_people[0], 0.12 * aside / np.linalg.norm(aside))
    kept, carried = (solve(seen, five_cameras, fitter, keep_limbs=keep) for keep in (True, False))
    late = rows[-10:]

    off = [
        np.linalg.norm((each.joints - truth)[late, WRIST], axis=-1).mean()
        for each in (carried, kept)
    ]
    ends = [each.joints[late][:, [elbow, WRIST]] for each in (carried, kept)]
    wrong = [abs(np.linalg.norm(np.diff(each, axis=1), axis=-1).mean() - length) for each in ends]
    # Measured: 64 to 13 mm aside and 41 to 17 along the ray.
    assert off[0] > 0.02 and off[1] < 0.7 * off[0]
    assert wrong[0] > 0.005 and wrong[1] < 0.7 * wrong[0]
    changed = (kept.joints != carried.joints).any(axis=2)
    assert np.flatnonzero(changed.any(axis=0)).tolist() == [WRIST]
    # Lengths are kept for 0.1 s around, three frames.
    assert not changed[(observations.track == 1) | (observations.frame < 2)].any()
    # The wrist's knows where it may hide, which depends on its place.
    np.testing.assert_array_equal(
        *(np.delete(each.covariance, WRIST, axis=1) for each in (kept, carried))
    )


@pytest.mark.slow
def test_a_joint_with_a_factor_of_one_s_own_stays_where_that_leaves_it(
    walk, five_cameras, two_people
):
    """The same wrist, out of sight, with a factor that says next to nothing: `keep_limbs` leaves it
    alone.
    """
    observations, truth = walk
    rows = np.flatnonzero((observations.track == 0) & (observations.frame >= 5))
    seen = observations
    for view in range(5):
        seen = one_view_less(seen, rows, WRIST, view)

    def hint(window, keys):
        loose = gtsam.noiseModel.Isotropic.Sigma(3, 5.0)
        return [gtsam.PriorFactorPoint3(int(key), truth[0, WRIST], loose) for key in keys[:, WRIST]]

    fitter = PlacingFitter(two_people[0], np.array([0.0, 0.12, 0.0]))
    kept, carried, plain = (
        solve(seen, five_cameras, fitter, factors, keep_limbs=keep)
        for factors, keep in ((hint, True), (hint, False), (None, True))
    )
    np.testing.assert_array_equal(kept.joints[:, WRIST], carried.joints[:, WRIST])
    assert np.linalg.norm((plain.joints - kept.joints)[rows[-10:], WRIST], axis=-1).mean() > 0.03


@pytest.mark.slow
def test_motion_takes_noise_away_and_knows_the_velocity(walk, five_cameras, two_people):
    observations, truth = walk
    alone = solve(observations, five_cameras, BesideFitter(two_people[0]), temporal=False)
    found = solve(observations, five_cameras, BesideFitter(two_people[0]))
    before, after = (np.linalg.norm(each.joints - truth, axis=-1) for each in (alone, found))
    assert (found.status == Status.OK).all() and not found.problems
    # The noise here is white; the model says that 30 % of it are, and smooths no more than that
    # deserves. Measured: 0.57.
    assert after.mean() < 0.65 * before.mean()
    expected = np.array([[0.5, 0.0, 0.0], [0.0, -1.0, 0.0]])[observations.track]
    np.testing.assert_allclose(found.velocity.mean(axis=1), expected, atol=0.1)
    # Four sigmas of 60 x 25 x 3 numbers.
    error = np.abs(found.velocity - expected[:, None]) / np.sqrt(
        np.einsum("...ii->...i", found.velocity_covariance)
    )
    assert np.mean(error < 4) > 0.999


def test_the_order_of_rows_does_not_matter(walk, five_cameras, two_people):
    observations, _ = walk
    order = np.random.default_rng(0).permutation(len(observations))
    found = solve(observations, five_cameras, BesideFitter(two_people[0]))
    mixed = solve(observations.rows(order), five_cameras, BesideFitter(two_people[0]))
    np.testing.assert_allclose(mixed.joints, found.joints[order], atol=1e-6)
    np.testing.assert_allclose(found.rows(order).covariance, mixed.covariance, atol=1e-9)


def test_rows_of_a_track_are_one_group_of_the_fitter(walk, five_cameras, two_people):
    fitter = BesideFitter(two_people[0])
    solve(walk[0], five_cameras, fitter)
    assert all(len(np.unique(groups)) == 2 for groups in fitter.groups)


@pytest.mark.slow
@pytest.mark.usefixtures("out_of_sight")
def test_a_joint_lost_from_sight_keeps_its_place_beside_the_body(walk, five_cameras, two_people):
    """The body is 12 cm beside the joints. A wrist hidden for ten frames stays where it is, not
    where the body is.
    """
    observations, truth = walk
    rows = np.flatnonzero(
        (observations.track == 0) & (observations.frame >= 10) & (observations.frame < 20)
    )
    seen = hidden(observations, rows, WRIST)
    beside = (0.0, 0.12, 0.0)
    found = solve(seen, five_cameras, BesideFitter(two_people[0], beside, sigma_m=0.15))
    error = np.linalg.norm(found.joints[rows, WRIST] - truth[rows, WRIST], axis=-1)
    alone = solve(
        seen, five_cameras, BesideFitter(two_people[0], beside, sigma_m=0.15), temporal=False
    )
    np.testing.assert_allclose(
        np.linalg.norm(alone.joints - truth, axis=-1)[rows, WRIST], 0.12, atol=0.02
    )
    assert error.max() < 0.04
    assert (found.known[rows, WRIST] == Known.MOTION).all() and (
        alone.known[rows, WRIST] == Known.BODY
    ).all()
    assert (np.delete(found.known, rows, axis=0) == Known.SEEN).all()
    sigma = np.sqrt(np.trace(found.covariance[rows, WRIST], axis1=1, axis2=2))
    assert sigma[4] > 1.5 * sigma[0] and sigma[5] > 1.5 * sigma[-1], (
        "surest where it was seen a moment ago"
    )


def test_two_cameras_that_face_each_other_are_not_averaged_over_time(
    walk, five_cameras, two_people
):
    """Cameras in a line with the wrist see it 4 px too high and too low in all frames, 24 cm along
    the line: the body has it to 2 cm, and thirty frames of the same error are no better than one.
    """
    observations, truth = walk
    target = truth[observations.track == 0][:, WRIST].mean(axis=0)
    cameras = [
        replace(five_cameras.cameras[0], name=name, wTc=look_at(target + away, target, UP))
        for name, away in (("near", np.array([4.0, 0, 0.3])), ("far", np.array([-4.0, 0, 0.3])))
    ]
    rig, mine = replace(five_cameras, cameras=tuple(cameras)), observations.track == 0
    xy = np.moveaxis(rig.project(truth[mine])[0], 0, 2)
    xy[:, WRIST, :, 1] += [4.0, -4.0]
    T = int(mine.sum())
    seen = Observations(
        xy, np.full(xy.shape[:3], 0.8), np.full((T, 25, 3), np.nan), np.zeros(T, int), np.arange(T),
        np.repeat(np.arange(T)[:, None] / FPS, 2, axis=1),
    )  # fmt: skip
    found = solve(seen, rig, BesideFitter(two_people[0], sigma_m=0.02))
    away = found.joints[:, WRIST] - truth[mine, WRIST]
    # 16 mm; 94 where what the views say is new in every frame.
    assert np.abs(away[:, 0]).mean() < 0.03


@pytest.mark.usefixtures("out_of_sight")
def test_a_joint_lost_for_long_goes_to_the_body(walk, five_cameras, two_people):
    """Hidden from frame 5 on: after a second, what was known of it has faded, and the covariance is
    about the body's 15 cm.
    """
    observations, truth = walk
    rows = np.flatnonzero((observations.track == 0) & (observations.frame >= 5))
    beside = np.array([0.0, 0.12, 0.0])
    found = solve(
        hidden(observations, rows, WRIST), five_cameras, BesideFitter(two_people[0], beside, 0.15)
    )
    off = (found.joints[rows, WRIST] - truth[rows, WRIST]) @ beside / 0.12
    assert off[0] < 0.02 < 0.04 < off[-1] and (np.diff(off[3:]) > 0).all()
    sigma = np.sqrt(np.trace(found.covariance[rows, WRIST], axis1=1, axis2=2) / 3)
    assert (np.diff(sigma) > 0).all() and 0.13 < sigma[-1] < 0.25


def test_frames_may_be_missing(walk, five_cameras, two_people):
    observations, truth = walk
    kept = np.flatnonzero(~np.isin(observations.frame, [7, 8, 9, 21]))
    found = solve(observations.rows(kept), five_cameras, BesideFitter(two_people[0]))
    assert (found.status == Status.OK).all()
    np.testing.assert_allclose(found.joints, truth[kept], atol=0.03)


@pytest.mark.slow
def test_a_foot_that_stands_still_stays_still(walk, five_cameras, two_people):
    """A factor of one's own over time: the same place in two frames, to within a millimetre."""
    observations, _ = walk
    heel = BODY_25.index("RHeel")

    def stands(window, keys):
        for before, after in zip(keys[:-1, heel].tolist(), keys[1:, heel].tolist(), strict=True):
            yield gtsam.BetweenFactorPoint3(
                before, after, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)
            )

    found = solve(observations, five_cameras, BesideFitter(two_people[0]), stands)
    for track in (0, 1):
        places = found.joints[observations.track == track, heel]
        assert np.ptp(places, axis=0).max() < 0.01
    assert np.isfinite(found.covariance).all()


@pytest.mark.slow
def test_velocities_take_factors_too(walk, five_cameras, two_people):
    """Wrists that stand still by decree; in a frame alone there are no velocities, and the factors
    rest.
    """
    observations, _ = walk

    def still(window, keys):
        for key in window.velocity_keys[:, WRIST].tolist():
            yield gtsam.PriorFactorPoint3(
                key, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)
            )

    found = solve(observations, five_cameras, BesideFitter(two_people[0]), still)
    assert np.abs(found.velocity[:, WRIST]).max() < 0.01
    alone = solve(observations, five_cameras, BesideFitter(two_people[0]), still, temporal=False)
    assert (alone.status == Status.OK).all()


def box(window, keys):
    """Hands 40 cm apart, to within 1 cm."""
    for right, left in keys[:, [WRIST, OTHER_WRIST]].tolist():
        yield gtsam.RangeFactor3(right, left, 0.4, gtsam.noiseModel.Isotropic.Sigma(1, 0.01))


@pytest.mark.slow
@pytest.mark.parametrize("temporal", [True, False])
def test_joints_tied_to_each_other_get_the_body_without_any_of_their_targets(
    walk, five_cameras, two_people, temporal
):
    fitter = BesideFitter(two_people[0])
    solve(walk[0], five_cameras, fitter, box, temporal=temporal)
    assert {WRIST, OTHER_WRIST} in fitter.without and set() in fitter.without


@pytest.mark.parametrize("temporal", [True, *slow(False)])
def test_a_joint_thrown_away_is_a_status_with_a_name(walk, five_cameras, two_people, temporal):
    observations, _ = walk
    bad = (observations.track == 1) & (observations.frame == 4)
    row = int(np.flatnonzero(bad)[0])
    who = 1 if temporal else row  # alone, every row is a track

    def throw(window, keys):
        if window.track == who and 4 in window.frames:
            key = int(keys[window.frames == 4, WRIST][0])
            yield gtsam.PriorFactorPoint3(
                key, [1000.0, 0, 0], gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
            )

    found = solve(observations, five_cameras, BesideFitter(two_people[0]), throw, temporal=temporal)
    assert (found.status[bad] == Status.NOT_SOLVED).all()
    assert (found.status[observations.track == 0] == Status.OK).all()
    named = {(each.track, each.frame, each.joint) for each in found.problems}
    assert (who, 4, WRIST) in named and {joint for _, _, joint in named} == {WRIST}
    assert "diverged" in found.problems[0].reason
    assert {each.row for each in found.rows(np.array([row])).problems} == {0}


@pytest.mark.slow
def test_factors_that_make_no_sense_end_no_run(walk, five_cameras, two_people):
    """A factor that is not a number: a status for that person, the other is solved."""
    observations, truth = walk

    def nonsense(window, keys):
        if window.track == 1:
            noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.01)
            yield gtsam.PriorFactorPoint3(int(keys[0, WRIST]), np.full(3, np.nan), noise)

    found = solve(observations, five_cameras, BesideFitter(two_people[0]), nonsense)
    first = observations.track == 0
    assert (found.status[first] == Status.OK).all() and (
        found.status[~first] == Status.NOT_SOLVED
    ).all()
    np.testing.assert_allclose(found.joints[first], truth[first], atol=0.03)


def test_a_factor_must_be_on_the_window_s_own_keys(walk, five_cameras, two_people):
    def elsewhere(window, keys):
        yield gtsam.PriorFactorPoint3(7, np.zeros(3), gtsam.noiseModel.Unit.Create(3))

    with pytest.raises(ValueError, match="not in this window"):
        solve(walk[0], five_cameras, BesideFitter(two_people[0]), elsewhere)


def test_a_person_twice_in_a_frame_is_refused(walk, five_cameras, two_people):
    twice = Observations.concatenate([walk[0], walk[0].rows(np.array([3]))])
    with pytest.raises(ValueError, match="only one row per frame"):
        window_rows(twice)


def test_gaps_are_closed_in_a_straight_line():
    points = np.full((4, 2, 3), np.nan)
    points[0, 0], points[2, 0] = 0.0, 2.0
    filled = interpolated(points, np.array([0.0, 1.0, 2.0, 5.0]))
    assert filled[:, 0, 0].tolist() == [0.0, 1.0, 2.0, 2.0] and np.isnan(filled[:, 1]).all()


def test_near_in_time_reaches_both_ways():
    marked = np.zeros((6, 1), dtype=bool)
    marked[2] = True
    times = np.array([0.0, 0.4, 0.6, 0.8, 1.2, 2.0])
    assert near_in_time(marked, times, 0.25)[:, 0].tolist() == [
        False,
        True,
        True,
        True,
        False,
        False,
    ]


def test_the_motion_model_is_read_by_name_and_checked(tmp_path):
    model = MotionModel.load(("RWrist", "MidHip", "NoSuchJoint"))
    assert model.psd_still[0] > model.psd_still[1] > 0, "wrists turn faster than hips"
    np.testing.assert_allclose(
        model.density([[2.0, 0, 0]])[0, 0], model.psd_still[0] + 4 * model.psd_speed[0]
    )
    doubled = MotionModel.load(("RWrist",), MotionConfig(psd_scale=2.0))
    assert doubled.psd_still[0] == pytest.approx(2 * model.psd_still[0])
    (tmp_path / "other.json").write_text('{"format": "something else"}', encoding="utf-8")
    with pytest.raises(InputError, match="not a motion model"):
        MotionModel.load(("RWrist",), MotionConfig(model=str(tmp_path / "other.json")))
    with pytest.raises(ValueError, match="psd_scale must be positive"):
        MotionConfig(psd_scale=0.0)
    with pytest.raises(ValueError, match="window_alternations must be at least 1"):
        RefineConfig(window_alternations=0)


@pytest.mark.parametrize("source", ["views", "body"])
@pytest.mark.parametrize(
    ("key", "value"),
    [("white_share", 1.5), ("white_share", 1.0), ("white_share", 0.0), ("white_share", -1.0),
     ("white_share", np.nan), ("correlation_s", -2.0), ("correlation_s", 0.0),
     ("correlation_s", np.inf), ("kept", 7.0), ("kept", -0.1), ("kept", np.nan)],
)  # fmt: skip
def test_impossible_errors_in_a_motion_model_are_refused(tmp_path, source, key, value):
    shipped = files("shapepose_fg.estimation") / "data" / "motion.json"
    data = json.loads(shipped.read_text(encoding="utf-8"))
    data[source][key] = value
    (tmp_path / "motion.json").write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(
        InputError, match=r"motion\.json: .*(white_share must be between|not a motion model|JSON)"
    ):
        MotionModel.load(("RWrist",), MotionConfig(model=str(tmp_path / "motion.json")))


@pytest.mark.parametrize(
    ("densities", "possible"),
    [([0.5, 0.0, 0.0], True), ([0.0, 1.0, 1.0], False), ([0.5, -0.5, 1.0], False),
     ([0.5, 1.0, -0.5], False),
     ([0.5, np.inf, 1.0], False)],
)  # fmt: skip
def test_densities_that_are_none_are_refused(tmp_path, densities, possible):
    data = json.loads(
        (files("shapepose_fg.estimation") / "data" / "motion.json").read_text(encoding="utf-8")
    )
    data["joints"]["RWrist"] = densities
    (tmp_path / "motion.json").write_text(json.dumps(data), encoding="utf-8")
    config = MotionConfig(model=str(tmp_path / "motion.json"))
    if possible:
        assert MotionModel.load(("RWrist",), config).psd_still[0] == 0.5
    else:
        with pytest.raises(InputError, match=r"motion\.json: (densities must be positive|.*JSON)"):
            MotionModel.load(("RWrist",), config)


def test_another_format_is_refused_whatever_it_holds(tmp_path):
    data = json.loads(
        (files("shapepose_fg.estimation") / "data" / "motion.json").read_text(encoding="utf-8")
    )
    (tmp_path / "motion.json").write_text(
        json.dumps(data | {"format": "shapepose-fg motion model 2"})
    )
    with pytest.raises(InputError, match=r"motion\.json: this is not a motion model"):
        MotionModel.load(("RWrist",), MotionConfig(model=str(tmp_path / "motion.json")))


def nothing(window, keys):
    return ()


def steady(window, keys):
    for before, after in zip(keys[:-1, WRIST].tolist(), keys[1:, WRIST].tolist(), strict=True):
        yield gtsam.BetweenFactorPoint3(
            before, after, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.01)
        )


def far_apart(window, keys):
    yield gtsam.BetweenFactorPoint3(
        int(keys[0, WRIST]),
        int(keys[-1, WRIST]),
        np.zeros(3),
        gtsam.noiseModel.Isotropic.Sigma(3, 0.01),
    )


@pytest.mark.parametrize(
    ("factors", "calls"),
    [(nothing, 0), *slow((steady, 1), (far_apart, 1)), (box, 1)],
    ids=["no factors", "a chain", "frames far apart tied", "two joints tied"],
)
def test_chains_have_the_covariances_of_gtsam(
    walk, five_cameras, two_people, monkeypatch, factors, calls
):
    """A wrist lost twice, frames missing, one person in fewer frames, a joint that no view sees:
    the same numbers, to rounding. GTSAM is asked once, only where there are factors of the user's
    own.
    """
    observations, _ = walk
    gone = (observations.track == 1) & (observations.frame > 20) | np.isin(
        observations.frame, [7, 8]
    )
    observations = observations.rows(np.flatnonzero(~gone))
    lost = np.isin(observations.frame, [4, 5, 24]) & (observations.track == 0)
    observations = hidden(hidden(observations, np.flatnonzero(lost), WRIST), slice(None), NOSE)
    graphs = list[WindowGraph]()

    def captured(window, keys):
        graphs.append(window)
        yield from factors(window, keys) if window.track == 0 else ()

    beside = BesideFitter(two_people[0], (0.0, 0.05, 0.0))
    solve(observations, five_cameras, beside, captured, around_s=0.1)
    whole = [gtsam.Marginals(graph.graph, graph.values) for graph in graphs]
    asked, marginals = list[int](), gtsam.Marginals
    monkeypatch.setattr(
        gtsam, "Marginals", lambda graph, values: (asked.append(1), marginals(graph, values))[1]
    )
    found = state_covariances(graphs)
    assert [len(graph) for graph in graphs] == [28, 19] and len(asked) == calls
    for graph, (positions, velocities), known in zip(graphs, found, whole, strict=True):
        assert np.isfinite(positions[:, WRIST]).all()
        of_positions, of_velocities = (
            np.array([[known.marginalCovariance(key) for key in row] for row in keys.tolist()])
            for keys in (graph.keys, graph.velocity_keys)
        )
        # Of variances of 1e-4 m² and 1e-2 m²/s².
        np.testing.assert_allclose(positions, of_positions, rtol=1e-6, atol=1e-11)
        np.testing.assert_allclose(velocities, of_velocities, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("frames", [1, 2, 6])
def test_joints_of_which_nobody_says_anything_cost_nobody_a_status(
    walk, five_cameras, two_people, frames
):
    """Three joints in five views, X_0 of all 25: too few to place a body, but these three have
    covariances.
    """
    observations, truth = walk
    rows = np.flatnonzero((observations.track == 0) & (observations.frame < frames))
    seen = replace(observations.rows(rows), initial=truth[rows])
    for joint in set(range(25)) - {1, 8, 9}:
        seen = hidden(seen, slice(None), joint)
    found = solve(seen, five_cameras, BesideFitter(two_people[0]))
    assert (found.status == Status.TOO_FEW_VIEWS).all() and not found.problems
    determined = np.isfinite(found.covariance).all(axis=(2, 3))
    np.testing.assert_array_equal(
        determined, np.isin(np.arange(25), [1, 8, 9]) & np.ones((frames, 1), dtype=bool)
    )
    np.testing.assert_array_equal(np.isfinite(found.joints).all(axis=2), determined)


def test_a_joint_with_a_factor_of_one_s_own_stays_without_views_and_body(
    walk, five_cameras, two_people
):
    """What the user says of a joint that nobody else mentions is in the problem."""
    observations, truth = walk
    rows = np.flatnonzero((observations.track == 0) & (observations.frame < 6))
    seen = replace(observations.rows(rows), initial=truth[rows])
    for joint in set(range(25)) - {1, 8, 9}:
        seen = hidden(seen, slice(None), joint)

    def here(window, keys):
        noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.01)
        for key, place in zip(keys[:, WRIST].tolist(), truth[rows, WRIST], strict=True):
            yield gtsam.PriorFactorPoint3(key, place, noise)

    found = solve(seen, five_cameras, BesideFitter(two_people[0]), here)
    np.testing.assert_allclose(found.joints[:, WRIST], truth[rows, WRIST], atol=0.01)
    assert np.isfinite(found.covariance[:, [1, 8, 9, WRIST]]).all()


@pytest.mark.slow
def test_somebody_undetermined_takes_nothing_from_anybody_else(walk, five_cameras, two_people):
    """The user says how fast the first person's wrist is, nobody where: it is not known, and all
    else is.
    """
    observations, truth = walk
    first = observations.track == 0
    seen = replace(hidden(observations, first, WRIST), initial=truth)

    def still(window, keys):
        for key in window.velocity_keys[:, WRIST].tolist() if window.track == 0 else ():
            yield gtsam.PriorFactorPoint3(
                key, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
            )

    found = solve(seen, five_cameras, NobodyFitter(), still)
    unknown = ~np.isfinite(found.covariance).all(axis=(2, 3))
    assert unknown[first, WRIST].all() and unknown.sum() == FRAMES
    assert (found.status[~first] == Status.BODY_UNDETERMINED).all()
    assert {(each.track, each.joint) for each in found.problems} == {(0, WRIST)}
