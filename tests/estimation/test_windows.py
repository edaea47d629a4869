"""Stage II for fitters without a body model, frame by frame: factors of one's own, what went wrong,
and the motion model.
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
from shapepose_fg.core.observations import Observations, window_rows
from shapepose_fg.core.reconstruction import Status
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.estimator_config import EstimatorConfig, RefineConfig
from shapepose_fg.estimation.in_time import near_in_time
from shapepose_fg.estimation.motion_densities import MotionConfig, MotionModel
from shapepose_fg.estimation.window_solution import WindowSolution
from shapepose_fg.pipeline.solve_window import solve_window

FPS = 25.0
FRAMES = 30
WRIST, OTHER_WRIST, NOSE = (BODY_25.index(name) for name in ("RWrist", "LWrist", "Nose"))


class BesideFitter(BodyFitter):
    """Puts each row's body where the seen joints are, moved by `beside` (3,) metres."""

    def __init__(
        self, shape: NDArray[np.float64], beside=(0.0, 0.0, 0.0), sigma_m: float = 0.1
    ) -> None:
        self.shape, self.beside, self.sigma_m = shape, np.array(beside), sigma_m

    def fit(self, targets, initial=None) -> BodyFit:
        seen = targets.information.any(axis=(2, 3))
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
            joints=np.where(ok[:, None, None], xyz, np.nan),
            covariance=np.where(ok[:, None, None, None], covariance, np.nan),
        )


class NobodyFitter(BodyFitter):
    """Fits no body to anybody."""

    def fit(self, targets, initial=None) -> BodyFit:
        return BodyFit.failed(np.full(len(targets), FitStatus.TOO_FEW_JOINTS), targets.xyz.shape[1])


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
    together = solve(seen, five_cameras, BesideFitter(two_people[0], (0.0, 0.05, 0.0)))
    alone = solve(seen.rows(row), five_cameras, BesideFitter(two_people[0], (0.0, 0.05, 0.0)))
    for name in ("joints", "covariance", "confidence", "inlier", "known", "status"):
        np.testing.assert_array_equal(getattr(alone, name)[0], getattr(together, name)[31])


def test_what_stage_one_did_not_place_is_missing_by_the_paper_only(walk, five_cameras, two_people):
    """Nothing placed by stage I: the paper's X_0 is empty, ours is triangulated."""
    observations, truth = walk
    views, fitter = Views.of(five_cameras), NobodyFitter()
    paper = solve_window(observations, views, fitter, EstimatorConfig(refine=RefineConfig.paper()))
    assert (paper.status == Status.TOO_FEW_VIEWS).all() and np.isnan(paper.joints).all()
    ours = solve_window(observations, views, fitter, EstimatorConfig())
    np.testing.assert_allclose(ours.joints, truth, atol=0.03)


def test_the_order_of_rows_does_not_matter(walk, five_cameras, two_people):
    observations, _ = walk
    order = np.random.default_rng(0).permutation(len(observations))
    found = solve(observations, five_cameras, BesideFitter(two_people[0]))
    mixed = solve(observations.rows(order), five_cameras, BesideFitter(two_people[0]))
    np.testing.assert_allclose(mixed.joints, found.joints[order], atol=1e-6)
    np.testing.assert_allclose(found.rows(order).covariance, mixed.covariance, atol=1e-9)


def test_frames_may_be_missing(walk, five_cameras, two_people):
    observations, truth = walk
    kept = np.flatnonzero(~np.isin(observations.frame, [7, 8, 9, 21]))
    found = solve(observations.rows(kept), five_cameras, BesideFitter(two_people[0]))
    assert (found.status == Status.OK).all()
    np.testing.assert_allclose(found.joints, truth[kept], atol=0.03)


def box(window, keys):
    """Hands 40 cm apart, to within 1 cm."""
    for right, left in keys[:, [WRIST, OTHER_WRIST]].tolist():
        yield gtsam.RangeFactor3(right, left, 0.4, gtsam.noiseModel.Isotropic.Sigma(1, 0.01))


def test_a_joint_thrown_away_is_a_status_with_a_name(walk, five_cameras, two_people):
    observations, _ = walk
    bad = (observations.track == 1) & (observations.frame == 4)
    row = int(np.flatnonzero(bad)[0])

    def throw(window, keys):
        if window.track == 1 and 4 in window.frames:
            key = int(keys[window.frames == 4, WRIST][0])
            yield gtsam.PriorFactorPoint3(
                key, [1000.0, 0, 0], gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
            )

    found = solve(observations, five_cameras, BesideFitter(two_people[0]), throw)
    assert (found.status[bad] == Status.NOT_SOLVED).all()
    assert (found.status[observations.track == 0] == Status.OK).all()
    named = {(each.track, each.frame, each.joint) for each in found.problems}
    assert (1, 4, WRIST) in named and {joint for _, _, joint in named} == {WRIST}
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
