"""How far a detector's joints lie from the true ones, learnt without truth; what covariances make
of it.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.core.camera import Views
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.notes import Notebook
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.storage.kept_arrays import InMemory
from shapepose_fg.estimation.detector_offsets import OffsetConfig
from shapepose_fg.estimation.gated_views import ObservationConfig
from shapepose_fg.estimation.noise_law import (
    GROSS_M,
    NoiseLaw,
    Residuals,
    core_sigma_m,
)
from shapepose_fg.evaluation.metrics import covariance_calibration, match_people
from shapepose_fg.pipeline import offsets
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.pipeline.setup import Setup
from shapepose_fg.proposal.people_2d import whole_people
from shapepose_fg.proposal.thinning import ThinnedFrames
from shapepose_fg.simulation import DetectorConfig, built_in_scene, simulate

CONFIG = ObservationConfig()
SCORES = np.array([0.2, 0.4, 0.6, 0.75, 0.85, 0.95])


def residuals(rig, rows, noise=1.0, gross=0.0, seed=0) -> Residuals:
    """Of people who stand about; errors are `noise` times those of Eq. 1's weights, a share of them
    `gross`.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (rows, len(BODY_25), 3)) + np.array([0.0, 0.0, 1.0])
    xy, depth = (np.moveaxis(each, 0, 2) for each in rig.project(points))
    score = rng.choice(SCORES, depth.shape)
    wrong = rng.random(depth.shape) < gross
    scatter = CONFIG.scatter(BODY_25.joints)[:, None]
    sigma_m = np.hypot(noise * core_sigma_m(score) * scatter, np.where(wrong, GROSS_M, 0.0))
    error_m = rng.normal(size=xy.shape) * sigma_m[..., None]
    xy = xy + error_m * (rig.focal_px / depth)[..., None]
    far = np.linalg.norm(error_m, axis=-1) > 0.15  # what gates leave out
    every = Observations(xy, score, np.full(points.shape, np.nan))
    chosen = replace(every, confidence=np.where(far, 0.0, score))
    return Residuals.of(chosen, every, Views.of(rig), CONFIG, BODY_25.joints)


@pytest.mark.parametrize("noise, gross", [(1.0, 0.0), (2.0, 0.0), (1.0, 0.3)])
def test_the_law_is_found_without_truth(five_cameras, noise, gross):
    law = residuals(five_cameras, 150, noise, gross).law()
    assert law.count[0] == 0
    assert min(law.count[1:]) > 500
    np.testing.assert_allclose(law.times[1:], noise, rtol=0.15)
    np.testing.assert_allclose(law.gross[1:], gross, atol=0.06)


def test_few_detections_keep_what_ships(five_cameras):
    few, many = residuals(five_cameras, 1, noise=2.0), residuals(five_cameras, 60, noise=2.0)
    shipped = NoiseLaw.shipped()
    one = Residuals(
        few.score[:5], few.scatter[:5], few.squared[:5], few.others[:5], few.of_others[:5]
    )
    np.testing.assert_allclose(one.law().times, shipped.times, rtol=0.2)
    apart = [
        np.abs(np.log(np.divide(each.law().times, shipped.times))).max() for each in (few, many)
    ]
    assert apart[0] < 0.8 * apart[1]
    nothing = Residuals(
        few.score[:0], few.scatter[:0], few.squared[:0], few.others[:0], few.of_others[:0]
    )
    np.testing.assert_allclose(nothing.law().times, shipped.times, rtol=1e-4)
    np.testing.assert_allclose(nothing.law().gross, shipped.gross, atol=1e-4)


def test_weights_follow_the_law():
    """Twice the errors of the shipped law are four times the variance, in each range of scores."""
    shipped, scores = NoiseLaw.shipped(), np.array([0.05, 0.2, 0.95])
    np.testing.assert_allclose(shipped.ratios(scores), 1.0)
    twice = replace(shipped, times=tuple(2 * np.array(shipped.times)))
    np.testing.assert_allclose(twice.ratios(scores), 4.0)
    one = (2 * shipped.times[0], *shipped.times[1:])
    np.testing.assert_allclose(replace(shipped, times=one).ratios(scores), [4.0, 1.0, 1.0])


def test_a_law_is_told_in_run_json(tmp_path, five_cameras):
    law, path = residuals(five_cameras, 20, noise=1.5).law(), tmp_path / "run.json"
    path.write_text(json.dumps({"noise_law": law.as_dict()}))
    assert NoiseLaw.load(path) == law
    path.write_text("{}")
    assert NoiseLaw.load(path) == NoiseLaw.shipped()
    for damage in (
        {"times": [1.0]},
        {"gross": [2.0] * 7},
        {"times": [0.0] * 7},
        {"count": None},
        {"times": ["?"]},
    ):
        path.write_text(json.dumps({"noise_law": law.as_dict() | damage}))
        with pytest.raises(InputError, match="noise_law"):
            NoiseLaw.load(path)
    path.write_text(json.dumps({"noise_law": 3}))
    with pytest.raises(InputError, match="noise_law"):
        NoiseLaw.load(path)


def test_2d_people_are_taken_whole_but_for_what_others_have(five_cameras, two_people, seen_exactly):
    found = seen_exactly(five_cameras, two_people)
    xy, _ = five_cameras.project(two_people)
    away = np.linalg.norm(found.xy[:, None] - xy[found.view, :, found.joint], axis=-1)
    own = np.full((2, 25, 5), -1)
    own[away.argmin(axis=1), found.joint, found.view] = np.arange(len(found))
    chosen = np.where(
        np.arange(25)[:, None] < 20, own, -1
    )  # five joints of each 2D person were not used
    np.testing.assert_array_equal(whole_people(chosen, found), own)
    other = chosen.copy()
    other[1, 22, 0] = own[0, 22, 0]
    assert whole_people(other, found)[0, 22, 0] == -1, "somebody else has it"
    assert whole_people(other, found)[1, 22, 0] == -1, "another one is used"
    other[0, 3:20, 0] = -1
    assert (whole_people(other, found)[0, :, 0] == -1).all(), "three joints are too few to tell"


@pytest.fixture(scope="module")
def noisy():
    """Four people before five cameras, 20 frames; the detector has twice the usual errors."""
    scene = built_in_scene(seed=3, cameras=5, frames=20)
    return (
        scene,
        simulate(scene, DetectorConfig(noise=2.0), seed=3),
        FrameTimes.from_fps(scene.fps, 20),
    )


@pytest.fixture
def of_few_frames(monkeypatch):
    """The law is learnt from recordings of as few frames as these."""
    monkeypatch.setattr(offsets, "NOISE_FRAMES", 20)


def set_up(scene, recording) -> tuple[Setup, ThinnedFrames]:
    """What a run has when it begins."""
    config = PipelineConfig()
    setup = Setup(scene.rig, BODY_25, config, make_fitter(config.body))
    return setup, ThinnedFrames(recording, scene.rig, config.candidates)


def test_a_run_learns_it_once_and_keeps_it(noisy, of_few_frames, monkeypatch):
    scene, recording, times = noisy
    setup, frames = set_up(scene, recording)
    kept = InMemory()
    law = offsets.kept_noise(kept, offsets.Sample(setup, frames, times), Notebook())
    found, usual = np.array([law.times, NoiseLaw.shipped().times])[:, 3:6]
    assert (found > 1.4 * usual).all() and (found < 2.4 * usual).all()
    monkeypatch.setattr(offsets, "noise_of", None)
    assert offsets.kept_noise(kept, offsets.Sample(setup, frames, times), Notebook()) == law


def test_a_short_recording_keeps_what_ships(noisy, monkeypatch):
    scene, recording, times = noisy
    monkeypatch.setattr(offsets, "NOISE_FRAMES", 21)
    setup, frames = set_up(scene, recording)
    assert offsets.noise_of(offsets.Sample(setup, frames, times), Notebook()) == NoiseLaw.shipped()


@pytest.mark.slow
def test_regions_hold_for_a_detector_with_twice_the_errors(noisy, of_few_frames, tmp_path):
    scene, recording, times = noisy

    def inside(people) -> float:
        found = match_people(people.frame, people.joints, scene.keypoints)
        off = people.joints[found.row] - scene.keypoints[found.frame, found.person]
        return covariance_calibration(off, people.covariance[found.row]).coverage[0.95]

    people = reconstruct(recording, scene.rig, times=times)
    usual = reconstruct(
        recording, scene.rig, PipelineConfig(offsets=OffsetConfig("none")), times=times
    )
    assert abs(inside(people) - 0.95) < 0.5 * abs(inside(usual) - 0.95)
    assert inside(people) > 0.8
    two = reconstruct(recording, scene.rig, times=times, execution=Execution(workers=2))
    np.testing.assert_array_equal(two.covariance, people.covariance)
    assert two.run["noise_law"] == people.run["noise_law"]


def test_a_score_without_weight_has_an_infinite_sigma_and_no_warning():
    sigma = core_sigma_m(np.array([0.0, 0.25, 1.0]), ObservationConfig.paper())
    assert np.isinf(sigma[0]) and np.isfinite(sigma[1:]).all() and sigma[1] > sigma[2]
