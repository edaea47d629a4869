"""The whole way: what goes in as 2D candidates comes out as people."""

import subprocess
import sys
import threading
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factors import isotropic
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Known, Reconstruction, Status
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.detector_offsets import OffsetConfig
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.evaluation.score import score as score_of
from shapepose_fg.evaluation.shelf import read_shelf_ground_truth
from shapepose_fg.evaluation.truth import people_of
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline.config import PeopleConfig
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people, reconstruct
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.scene import Scene

WRISTS = [BODY_25.index("RWrist"), BODY_25.index("LWrist")]


@pytest.fixture(scope="module")
def scene(dance) -> Scene:
    return dance.scene


@pytest.fixture(scope="module")
def recording(dance) -> Recording:
    """The first two thirds of a second."""
    return Recording(BODY_25, [dance.recording[t] for t in range(16)])


@pytest.fixture(scope="module")
def people(dance) -> Reconstruction:
    return dance.people


ALONE = PipelineConfig(temporal=False)


def assert_same(one: Reconstruction, other: Reconstruction) -> None:
    """Rows do not influence each other; batches round differently, well under a millimetre."""
    np.testing.assert_array_equal(one.frame, other.frame)
    np.testing.assert_array_equal(one.status, other.status)
    np.testing.assert_allclose(one.joints, other.joints, atol=5e-4)
    np.testing.assert_allclose(one.betas, other.betas, atol=0.05)


def test_everybody_is_found_once_and_where_they_are(scene, people):
    found = joint_metrics(people, scene.keypoints)
    assert found.people_found == found.people_true == 160
    assert found.people_duplicated == found.people_invented == 0
    assert found.precision >= 0.98 and found.recall >= 0.98 and found.mpjpe_mm <= 30
    assert set(people.status) == {Status.OK}
    assert np.isfinite(people.joints).all() and np.isfinite(people.covariance).all()
    assert (np.linalg.eigvalsh(people.covariance) > 0).all()


def test_the_bodies_are_where_the_joints_are(scene, people):
    body = scene.body
    from shapepose_fg.body.model.body_model import BodyParameters

    columns = (people.betas, people.global_orient, people.body_pose, people.transl)
    fitted = body.keypoints(BodyParameters(*columns))
    distance = np.linalg.norm(fitted - people.joints, axis=-1)
    assert np.median(distance) < 0.02, "the model error that the fit allows for"


def test_the_run_says_how_it_came_about(people):
    run = people.run
    assert run["frames"] == [0, 40]
    assert run["people"]["found"] == len(people) == run["people"]["status"]["ok"]
    assert run["configuration"]["people"]["gate_m"] == PipelineConfig().people.gate_m
    assert set(run["seconds"]) >= {"triangulate", "propose", "follow", "solve"}
    assert run["versions"]["gtsam"].startswith("4.")
    assert [each["person"] for each in run["probability"]] == np.unique(people.person).tolist()
    assert all(
        0.3 < each["evidence"] <= 1 and 0.9 < each["probability"] <= 1
        for each in run["probability"]
    )


@pytest.mark.slow
def test_without_time_frames_stand_alone_and_batches_do_not_matter(scene, recording):
    recording = Recording(BODY_25, [recording[t] for t in range(10)])
    whole = reconstruct(recording, scene.rig, ALONE)
    part = reconstruct(recording, scene.rig, ALONE, frames=range(5, 9))
    rows = whole.rows((whole.frame >= 5) & (whole.frame < 9))
    assert_same(part, rows)
    assert part.run["frames"] == [5, 9]
    assert sum(part.run["probability"].values()) == len(part) and set(part.run["probability"]) <= {
        "0.8",
        "0.9",
    }
    assert_same(
        reconstruct(recording, scene.rig, replace(ALONE, batch_frames=3), frames=range(5, 9)), rows
    )


def test_the_same_input_gives_the_same_bytes(scene, recording):
    counts = list[tuple[int, int]]()
    execution = Execution(progress=lambda *done: counts.append(done))
    config = PipelineConfig(batch_frames=4)
    one, other = (
        reconstruct(recording, scene.rig, config, frames=range(6), execution=execution)
        for _ in range(2)
    )
    assert counts == 2 * [(6, 6)], "two frames are no window of their own"
    for name in Reconstruction.ROWS:
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name


def test_factors_that_cannot_be_sent_to_workers_are_refused(scene, recording):
    lock = threading.Lock()

    def factors(window, keys):
        with lock:
            yield from ()

    with pytest.raises(ValueError, match="cannot be sent to worker processes"):
        reconstruct(recording, scene.rig, extra_factors=factors, execution=Execution(workers=2))


_TYPED = """
from dataclasses import replace
import gtsam
from factors import MOTIONS, Motion, isotropic
from shapepose_fg import Execution, PipelineConfig, Reconstruction, reconstruct
from shapepose_fg.simulation import built_in_scene, simulate
MOTIONS["known here alone"] = Motion(2, (1.5,))
scene = built_in_scene(seed=0, people=2, cameras=3, frames=16)
detections = simulate(scene, seed=0)
def carries_a_box(window, keys):
    for frame in keys.tolist():
        right, left = (frame[detections.skeleton.index(name)] for name in ("RWrist", "LWrist"))
        yield gtsam.RangeFactor3(right, left, 0.40, isotropic(1, 0.01))
def hand_in_hand(window, keys):
    for other in window.partners:
        for mine, theirs in zip(*window.shared(other)):
            ends = int(keys[mine, 4]), int(other.keys[theirs, 7])
            yield gtsam.RangeFactor3(*ends, 1.0, isotropic(1, 0.3))
fast = PipelineConfig.fast()
solving = replace(fast.solving, motion="known here alone")
config = replace(fast, batch_frames=8, solving=solving)
counts = []
two = Execution(workers=2, progress=lambda *done: counts.append(done))
alone, helped = (
    reconstruct(detections, scene.rig, config, extra_factors=[carries_a_box, hand_in_hand],
                execution=each)
    for each in (Execution(), two)
)
made = alone.run["extra_factors"]
print(len(alone), counts, {name: each["made"] > 0 for name, each in made.items()})
tables = [(each, each.observations, each.shapes) for each in (alone, helped)]
for one, other in zip(*tables):
    names = ("betas", "information") if one is alone.shapes else one.ROWS
    print([name for name in names
           if getattr(one, name).tobytes() != getattr(other, name).tobytes()])
"""


@pytest.mark.slow
def test_workers_change_no_byte():
    """Keyframes, in windows of 8 frames, with a model of motion and factors that a script on
    standard input has, which no other process can import: README's own, and one between people.
    """
    run = subprocess.run(
        [sys.executable, "-"], input=_TYPED, capture_output=True, text=True, timeout=300
    )
    made = "{'carries_a_box': True, 'hand_in_hand': True}"
    assert run.stdout == f"32 [(8, 16), (16, 16)] {made}\n[]\n[]\n[]\n", run.stderr


@pytest.mark.parametrize("frames", [range(0, 17), range(-1, 3), range(0, 8, 2)])
def test_frames_that_are_not_there_are_refused(scene, recording, frames):
    with pytest.raises(ValueError, match="within 0:16"):
        reconstruct(recording, scene.rig, frames=frames)


@pytest.mark.filterwarnings("error")
def test_nobody_and_nothing_are_empty_results(scene):
    nobody = reconstruct(Recording(BODY_25, [Detections.empty()] * 3), scene.rig)
    assert len(nobody) == 0 and nobody.run["people"]["found"] == 0
    assert len(reconstruct(Recording(BODY_25, []), scene.rig)) == 0


@pytest.mark.slow
def test_an_empty_frame_and_a_blind_view_harm_no_other(scene, recording):
    blind = recording[1].only(recording[1].view != 2)
    frames = [recording[0], Detections.empty(), blind, recording[3]]
    # What is learnt of the detector is learnt from all frames, so it is left out here.
    config = PipelineConfig(offsets=OffsetConfig(source="none"), temporal=False)
    result = reconstruct(Recording(BODY_25, frames), scene.rig, config)
    assert np.bincount(result.frame, minlength=4).tolist() == [4, 0, 4, 4]
    assert_same(result.at(0), reconstruct(recording, scene.rig, config, frames=range(1)))
    without_view = joint_metrics([result.joints[result.frame == 2]], scene.keypoints[1:2])
    assert without_view.people_found == 4 and without_view.mpjpe_mm < 40


@pytest.mark.parametrize(("seed", "frame"), [(0, 34), (1003, 8), (1004, 3)])
def test_nobody_is_cut_in_two_and_nobody_invented(seed, frame):
    """Frames where rays to different hips cross near somebody: that hip took the legs, or odds and
    ends.
    """
    scene = built_in_scene(seed=seed)
    seen = simulate(scene, seed=seed, frames=range(frame, frame + 1))[0]
    people = find_people(seen, scene.rig, BODY_25, PipelineConfig())
    apart = np.linalg.norm(people.initial[:, None] - scene.keypoints[frame][None], axis=-1)
    assert len(people) == 4
    assert sorted(np.nanmedian(apart, axis=-1).argmin(axis=1)) == [0, 1, 2, 3]


def test_one_person_before_two_cameras():
    scene = built_in_scene(seed=0, people=1, cameras=2, frames=6)
    found = joint_metrics(reconstruct(simulate(scene, seed=0), scene.rig), scene.keypoints)
    assert found.people_found == 6 and found.people_invented == 0
    # Two views, one baseline: no third to vote an error down.
    assert found.mpjpe_mm < 60


@pytest.mark.slow
def test_factors_of_one_s_own_reach_every_person(scene, recording):
    def hands_apart(window, keys):
        right, left = keys[0, WRISTS].tolist()
        yield gtsam.RangeFactor3(right, left, 0.5, isotropic(1, 1e-4))

    result = reconstruct(recording, scene.rig, frames=range(1), extra_factors=hands_apart)
    apart = np.linalg.norm(result.joints[:, WRISTS[0]] - result.joints[:, WRISTS[1]], axis=-1)
    np.testing.assert_allclose(apart, 0.5, atol=0.005)


@pytest.mark.slow
def test_a_factor_that_throws_a_wrist_away_is_a_status_that_names_it(scene, recording):
    def throw(window, keys):
        far = np.array([1000.0, 0.0, 0.0])
        yield gtsam.PriorFactorPoint3(int(keys[0, WRISTS[0]]), far, isotropic(3, 1e-3))

    result = reconstruct(recording, scene.rig, frames=range(6), extra_factors=throw)
    failed = result.rows(result.status == Status.NOT_SOLVED)
    # Motion takes the frames around with it: none of them may pass for solved.
    assert 0 in failed.frame and len(failed) == len(result)
    problems = result.run["people"]["problems"]
    assert {(each["person"], each["frame"], each["joint"]) for each in problems} >= {
        (person, frame, "RWrist")
        for person, frame in zip(failed.person.tolist(), failed.frame.tolist(), strict=True)
    }


@pytest.mark.slow
def test_without_time_problems_and_phantoms_are_those_of_the_frames(scene, recording):
    """Who is named is in people.npz; who goes when detections are given out again is counted."""

    def throw(window, keys):
        far = np.array([1000.0, 0.0, 0.0])
        yield gtsam.PriorFactorPoint3(int(keys[0, WRISTS[0]]), far, isotropic(3, 1e-3))

    config = PipelineConfig(temporal=False, offsets=OffsetConfig(source="none"))
    result = reconstruct(recording, scene.rig, config, frames=range(3), extra_factors=throw)
    named = {(each["person"], each["frame"]) for each in result.run["people"]["problems"]}
    assert named == set(zip(result.person.tolist(), result.frame.tolist(), strict=True))
    assert {person for person, _ in named} == {0, 1, 2, 3}
    # Who goes when detections are given out again has no problem of their own; there is hardly
    # anybody.
    gone = "hardly any detections of their own, or at the position of another person"
    assert result.run["people"]["dropped"].get(gone, 0) <= 3


def test_settings_reach_their_steps(scene, recording):
    strict = PipelineConfig(people=PeopleConfig(min_probability=1.0))
    assert len(find_people(recording[0], scene.rig, BODY_25, strict)) == 0
    with pytest.raises(ValueError, match="batch_frames must be at least 1"):
        replace(strict, batch_frames=0)


@pytest.mark.slow
def test_shelf_is_as_good_as_promised(shared_data):
    """Over time, all frames; the figures are those that the project promises."""
    shelf = shared_data / "shelf"
    rig = read_rig(shelf / "calibration.json")
    detections = read_detections(shelf, rig)
    truth = read_shelf_ground_truth(shelf / "gt_dev.txt")
    times = FrameTimes.from_fps(25.0, len(detections))
    score = score_of(people_of(reconstruct(detections, rig, times=times)), truth)
    assert score.found == 243
    assert score.figures["pcp"] >= 96.4 and min(score.people.values()) >= 92.5


def test_the_observations_are_what_the_joints_were_solved_from(dance, scene, people):
    """Whoever reads observations.npz finds the detections, and projecting the joints gives the
    residuals.
    """
    table = people.observations
    assert table.used.mean() > 0.5
    row, joint, view = np.argwhere(table.used)[1000].tolist()
    seen = dance.recording[int(people.frame[row])]
    own = np.flatnonzero(seen.view == view)
    detection = own[table.candidate[row, joint, view]]
    assert seen.joint[detection] == joint
    np.testing.assert_allclose(table.xy[row, joint, view], seen.xy[detection], rtol=1e-6)
    projected, _ = scene.rig.project(people.joints)
    residual = projected[view, row, joint] - seen.xy[detection]
    np.testing.assert_allclose(table.residual_px[row, joint, view], residual, atol=1e-3)
    assert np.median(np.linalg.norm(table.residual_px[table.used], axis=-1)) < 10
    # Seen means that a detection was used; the motion of others around it can tell a joint that
    # nobody saw.
    np.testing.assert_array_equal(Known.observed(people.known), table.used.any(axis=-1))
    assert Known.UNKNOWN not in people.known
    assert people.run["people"]["joints"]["seen"] == (people.known == Known.SEEN).sum()


@pytest.mark.slow
def test_detections_are_assigned_until_hardly_any_changes():
    """More rounds than that change nothing; where they are not assigned again, they are not there
    yet.
    """
    scene = built_in_scene(people=3, cameras=3, frames=12)
    recording = simulate(scene)
    rounds = {}
    for most in (0, 8, 50):
        windows = replace(PipelineConfig().windows, again_over_time=most)
        config = replace(PipelineConfig(), windows=windows)
        rounds[most] = reconstruct(
            recording, scene.rig, config, times=FrameTimes.from_fps(scene.fps, len(recording))
        )
    assert (rounds[8].joints == rounds[50].joints).all()
    candidates = [np.asarray(rounds[most].observations.candidate) for most in (0, 8)]
    assert candidates[0].shape == candidates[1].shape and (candidates[0] != candidates[1]).any()
