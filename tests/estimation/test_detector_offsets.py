"""Where a detector puts its joints: learnt from what it saw, against the known truth."""

import json
from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.body.fitting.fitters import SmplFitter
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.offsets.estimation import OffsetPrior, learn_offsets
from shapepose_fg.core.detections import Recording
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.detector_offsets import OffsetConfig, confident_targets, spread_frames
from shapepose_fg.estimation.gated_views import ObservationConfig
from shapepose_fg.pipeline.config import PeopleConfig
from shapepose_fg.pipeline.pipeline import PipelineConfig, estimate_offsets, reconstruct
from shapepose_fg.proposal.thinning import ThinnedFrames
from shapepose_fg.simulation import DetectorConfig, built_in_scene, simulate
from shapepose_fg.simulation.scene import Scene
from tests.body.mirrored_offsets import symmetric

ODD = symmetric(
    {
        "LHip": (0.035, 0.03, 0.0),
        "LShoulder": (0.01, -0.02, -0.01),
        "Neck": (0.0, -0.03, 0.01),
        "Nose": (0.0, 0.0, 0.02),
        "LEar": (0.0, 0.01, -0.02),
        "LKnee": (0.0, 0.02, 0.01),
        "LElbow": (-0.015, 0.0, -0.01),
        "LHeel": (0.0, 0.01, -0.02),
    }
)
"""A detector with hips, shoulders, neck, face, knees and heels of its own."""
NONE = PipelineConfig(offsets=OffsetConfig(source="none"))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Four people in close motion before six cameras."""
    return built_in_scene(seed=0, frames=16)


@pytest.fixture(scope="module")
def odd_scene(scene) -> Scene:
    """The same, with the keypoints of the odd detector as truth."""
    return scene.with_keypoint_offsets(ODD)


@pytest.fixture(scope="module")
def odd_recording(scene) -> Recording:
    return simulate(scene, DetectorConfig(offsets=ODD), seed=0)


@pytest.fixture(scope="module")
def odd_offsets(scene, odd_recording) -> KeypointOffsets:
    """What is learnt from the recording."""
    return estimate_offsets(odd_recording, scene.rig)


def exact(scene: Scene) -> JointTargets:
    """Everybody's joints in every frame, known to 5 mm."""
    xyz = scene.keypoints.reshape(-1, 25, 3)
    return JointTargets(xyz, np.broadcast_to(np.eye(3) / 0.005**2, (len(xyz), 25, 3, 3)))


def left_out_error_mm(model: BodyModel, scene: Scene) -> float:
    """How far from a joint the body puts it that is fitted to all the others: mean, exact
    targets.
    """
    fitter, off = SmplFitter(model), []
    for k in range(6):  # four joints at a time, far from each other
        targets = exact(scene)
        information = targets.information.copy()
        information[:, k::6] = 0.0
        fit = fitter.fit(JointTargets(targets.xyz, information))
        assert fit.ok.all()
        off.append(np.linalg.norm(fit.joints - targets.xyz, axis=-1)[:, k::6].ravel())
    return float(1e3 * np.concatenate(off).mean())


@pytest.mark.slow
def test_the_body_predicts_the_joints_of_the_detector(scene, odd_scene, odd_offsets):
    """What offsets are for. They are learnt from noisy detections and judged on the true joints."""
    before = left_out_error_mm(scene.body, odd_scene)
    after = left_out_error_mm(scene.body.with_keypoint_offsets(odd_offsets), odd_scene)
    best = left_out_error_mm(odd_scene.body, odd_scene)
    assert before > best + 8.0, "or there is nothing to be won"
    # Most of what knowing the truth would bring; the rest is what pose and shape explain as well.
    assert after < best + 0.25 * (before - best)


def test_offsets_that_no_pose_explains_are_recovered(odd_offsets):
    offsets = odd_offsets
    error = dict(zip(BODY_25.joints, 1e3 * (offsets.xyz_m - ODD.xyz_m), strict=True))
    # Hips farther apart, the nose farther out: no turn of a bone does that. Two sigmas of some 8
    # mm.
    assert abs(error["LHip"][0]) < 16 and abs(error["RHip"][0]) < 16
    assert abs(error["Nose"][2]) < 16 and abs(error["Neck"][1]) < 16
    # All of them, also what a turn of a bone or a longer limb could be, are nearer to the truth
    # than zero is.
    off = np.linalg.norm(offsets.xyz_m - ODD.xyz_m, axis=1)
    moved = np.linalg.norm(ODD.xyz_m, axis=1) > 0
    assert off[moved].mean() < 0.6 * np.linalg.norm(ODD.xyz_m[moved], axis=1).mean()
    # Honest about it: errors a coordinate are of the size of sigma, not several times as large.
    assert np.sqrt((off**2 / 3 / offsets.sigma_m**2).mean()) < 1.3


@pytest.mark.slow
def test_no_offsets_are_found_where_there_are_none(scene):
    recording = simulate(scene, seed=0)
    offsets = estimate_offsets(recording, scene.rig)
    # Learnt from 64 bodies with errors of 20 mm and of a pose prior that never fits exactly: some
    # millimetres.
    assert np.linalg.norm(offsets.xyz_m, axis=1).mean() < 0.006
    harmed = left_out_error_mm(scene.body.with_keypoint_offsets(offsets), scene)
    assert harmed < left_out_error_mm(scene.body, scene) + 1.0


@pytest.mark.slow
def test_offsets_are_learnt_from_frames_that_are_thinned_as_in_a_run(scene):
    """Every detection is there four times, 2 px aside; eight of a joint stay in a view, of four
    people.
    """
    config = PipelineConfig(people=PeopleConfig(most_pairs=1000))
    rng, frames = np.random.default_rng(0), []
    for seen in simulate(scene, seed=0, frames=range(3)):
        xy = np.tile(seen.xy, (4, 1)) + rng.normal(0, 2, (4 * len(seen), 2))
        confidence = np.tile(seen.confidence, 4) * np.repeat([1.0, 0.99, 0.98, 0.97], len(seen))
        view, joint = np.tile(seen.view, 4), np.tile(seen.joint, 4)
        frames.append(
            replace(
                seen,
                view=view,
                joint=joint,
                xy=xy,
                confidence=confidence,
                place=None,
                mirrored=None,
            )
        )
    recording = Recording(BODY_25, frames)
    thinned = ThinnedFrames(recording, scene.rig, config.candidates)
    assert all(thinned.is_thinned(frame) for frame in range(3))
    found = estimate_offsets(recording, scene.rig, config)
    expected = estimate_offsets(
        Recording(BODY_25, [thinned[frame] for frame in range(3)]), scene.rig, config
    )
    np.testing.assert_array_equal(found.xyz_m, expected.xyz_m)


@pytest.mark.slow
def test_left_and_right_are_mirrored_unless_the_data_insist():
    scene = built_in_scene(seed=0, frames=8)
    # One hip only: what is symmetric about it (half) is found, what is not is shrunk much harder.
    xyz = np.zeros((25, 3))
    xyz[BODY_25.index("LHip")] = (0.04, 0.0, 0.0)
    one_sided = replace(KeypointOffsets.identity(), xyz_m=xyz)
    targets = exact(scene.with_keypoint_offsets(one_sided))
    tight = learn_offsets(targets, scene.body, prior=OffsetPrior(asymmetry_sigma_m=1e-5)).xyz_m
    mirrored = tight[list(BODY_25.mirror)] * (-1.0, 1.0, 1.0)
    np.testing.assert_allclose(tight, mirrored, atol=1e-5)  # the prior's own 10 micrometres
    loose = learn_offsets(targets, scene.body, prior=OffsetPrior(asymmetry_sigma_m=0.02)).xyz_m
    left, right = loose[BODY_25.index("LHip"), 0], -loose[BODY_25.index("RHip"), 0]
    assert left > right + 0.01


def test_nothing_to_learn_from_is_nothing_learnt(scene):
    nobody = JointTargets(np.zeros((0, 25, 3)), np.zeros((0, 25, 3, 3)))
    unseen = JointTargets(np.zeros((3, 25, 3)), np.zeros((3, 25, 3, 3)))
    for targets in (nobody, unseen):
        offsets = learn_offsets(targets, scene.body)
        assert not offsets.xyz_m.any() and not offsets.count.any()
        # The prior's sigma: half of the variance is symmetric, half is not, and only the first half
        # is wide.
        assert (offsets.sigma_m > 0.011).all() and (offsets.sigma_m < 0.02).all()


def test_a_joint_that_nobody_saw_keeps_its_prior(scene):
    targets = exact(scene)
    information = targets.information.copy()
    nose = BODY_25.index("Nose")
    information[:, nose] = 0.0
    offsets = learn_offsets(JointTargets(targets.xyz, information), scene.body)
    assert offsets.count[nose] == 0 and offsets.count[8] == len(targets)
    assert offsets.sigma_m[nose] > 1.2 * offsets.sigma_m[BODY_25.index("REye")]


def seen_by(views: int, confidence: float, scene: Scene) -> Observations:
    """The people of frame 0 as some of the cameras see them, without error."""
    truth = scene.truth_at(0)
    xy = np.moveaxis(scene.rig.project(truth)[0], 0, 2)
    seen = np.where(np.arange(len(scene.rig)) < views, confidence, 0.0)
    return Observations(xy, np.broadcast_to(seen, xy.shape[:3]).copy(), truth)


@pytest.mark.parametrize(
    ("views", "confidence", "used"), [(6, 0.8, True), (2, 0.8, False), (6, 0.3, False)]
)
def test_only_what_three_views_see_well_is_learnt_from(scene, views, confidence, used):
    observations = seen_by(views, confidence, scene)
    targets = confident_targets(observations, scene.rig, ObservationConfig())
    assert (np.abs(targets.information).max(axis=(2, 3)) > 0).all() == used
    assert (np.abs(targets.information).max(axis=(2, 3)) > 0).any() == used
    np.testing.assert_allclose(targets.xyz, scene.truth_at(0), atol=1e-6)


def test_frames_are_spread_over_the_recording():
    assert spread_frames(0, 5) == []
    assert spread_frames(3, 5) == [0, 1, 2]
    assert spread_frames(101, 5) == [0, 25, 50, 75, 100]


@pytest.mark.slow
def test_the_run_records_the_offsets_and_a_file_brings_them_back(
    scene, odd_recording, odd_offsets, tmp_path
):
    learnt = reconstruct(odd_recording, scene.rig, frames=range(2))
    learnt.save(tmp_path)
    recorded = KeypointOffsets.load(tmp_path / "run.json")
    np.testing.assert_allclose(recorded.xyz_m, odd_offsets.xyz_m, atol=1e-6)
    from_file = PipelineConfig(offsets=OffsetConfig(source=str(tmp_path / "run.json")))
    again = reconstruct(odd_recording, scene.rig, from_file, frames=range(2))
    # The file holds micrometres; the fit's own tolerance is larger.
    np.testing.assert_allclose(again.joints, learnt.joints, atol=5e-4)
    without = reconstruct(odd_recording, scene.rig, NONE, frames=range(2))
    assert without.run["keypoint_offsets"] is None
    assert np.abs(without.body_pose - learnt.body_pose).max() > 1e-3
    with pytest.raises(InputError, match="missing"):
        missing = PipelineConfig(offsets=OffsetConfig(source=str(tmp_path / "missing.json")))
        reconstruct(odd_recording, scene.rig, missing)


@pytest.mark.slow
def test_frames_outside_the_span_are_learnt_from_and_not_counted(scene, odd_recording, odd_offsets):
    part = reconstruct(odd_recording, scene.rig, frames=range(3, 5))
    assert part.run["keypoint_offsets"] == odd_offsets.as_dict()
    assert part.run["people"]["found"] == len(part) == 8


class PlainFitter(BodyFitter):
    """A fitter of one's own that knows nothing of offsets."""

    def __init__(self) -> None:
        self._fitter = SmplFitter()

    def fit(
        self,
        targets: JointTargets,
        initial: BodyFit | None = None,
        groups: np.ndarray | None = None,
    ) -> BodyFit:
        return self._fitter.fit(targets, initial)


def test_a_fitter_without_offsets_goes_without(scene, odd_recording, tmp_path):
    people = reconstruct(odd_recording, scene.rig, frames=range(1), fitter=PlainFitter())
    assert people.run["keypoint_offsets"] is None
    ODD.save(tmp_path / "odd.json")
    config = PipelineConfig(offsets=OffsetConfig(source=str(tmp_path / "odd.json")))
    with pytest.raises(ValueError, match="need a fitter with a `model`"):
        reconstruct(odd_recording, scene.rig, config, frames=range(1), fitter=PlainFitter())


def test_a_detector_s_own_skeleton_moves_the_candidates_and_not_the_people(scene, odd_scene):
    exactly = replace(DetectorConfig.perfect(), offsets=ODD)
    seen = simulate(scene, exactly, frames=[0])[0]
    true_xy, _ = scene.rig.project(odd_scene.truth_at(0))
    hip = BODY_25.index("LHip")
    here = (seen.view == 0) & (seen.joint == hip)
    distance = np.linalg.norm(seen.xy[here][:, None] - true_xy[0, :, hip], axis=-1).min(axis=1)
    assert here.any() and distance.max() < 1e-6
    np.testing.assert_array_equal(scene.vertices_at(0), odd_scene.vertices_at(0))
    assert json.loads(json.dumps(exactly.as_dict()))["offsets"]["joints"]["LHip"]["xyz_mm"] == [
        35.0,
        30.0,
        0.0,
    ]
