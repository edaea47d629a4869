"""Cameras that are off are brought back by the people; sound ones stay; what motion does not say is
said.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.cameras import refine as refinement
from shapepose_fg.cameras.bundle import Freedom, adjust, dilution, misfit
from shapepose_fg.cameras.check.evidence import SetupHypothesis, gather
from shapepose_fg.cameras.check.small_errors import SmallErrors
from shapepose_fg.cameras.parameters import MOVE, TURN
from shapepose_fg.cameras.people import Footage
from shapepose_fg.cameras.refine import refine
from shapepose_fg.cameras.sightings import Sightings
from shapepose_fg.cameras.stature import build_of
from shapepose_fg.cli.main import main
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.calibration import read_rig, write_rig
from shapepose_fg.io.write_detections import write_openpose
from tests.cameras.check.conftest import seen_by
from tests.cameras.check.spoiled_setups import biased, lasting
from tests.cameras.conftest import FPS, disturbed, off_by

pytestmark = pytest.mark.usefixtures("few_frames")

TIMES = FrameTimes.from_fps(FPS, 250)


def run(arguments, capsys):
    """Exit code, stdout and stderr of a command."""
    with pytest.raises(SystemExit) as ended:
        main([str(each) for each in arguments])
    said = capsys.readouterr()
    return ended.value.code, said.out, said.err


def test_one_frame_is_one_look_and_a_minute_is_many():
    assert dilution(np.zeros(1)) == pytest.approx(2.5)
    assert dilution(np.arange(10.0) * 100) == pytest.approx(2.5, rel=0.01)
    # Twice as many frames of the same seconds tell hardly more.
    few, many = (dilution(np.linspace(0, 10, count)) / count for count in (50, 100))
    assert many == pytest.approx(few, rel=0.05)


@pytest.mark.slow
def test_disturbed_cameras_come_back(rig, recording, people):
    wrong = disturbed(rig, 0, focal=0.02)
    found = refine(recording, wrong, TIMES, range(150), Freedom(focal=0.02))
    turn, move = off_by(found.rig, rig)
    assert found.better and found.after_px < 0.4 * found.before_px and found.notes == ()
    assert np.median(off_by(wrong, rig)[0]) > 0.6
    assert turn.max() < 0.2 and move.max() < 0.025
    focal = [
        new.K[0, 0] / old.K[0, 0] - 1
        for new, old in zip(found.rig.cameras, rig.cameras, strict=True)
    ]
    assert np.abs(focal).max() < 0.012
    # Independent errors are taken for lasting ones: sigmas are wide rather than narrow.
    assert (turn < 2.8 * np.degrees(found.adjusted.sigma(TURN))).all()
    assert (move < 2.8 * found.adjusted.sigma(MOVE)).all()
    wide, before = (
        np.linalg.norm(np.diff(each.centres, axis=0)) for each in (found.of_stature(1.8), found.rig)
    )
    assert wide / before == pytest.approx(1.8 / found.stature_m)
    bones = people[:, :, list(BODY_25.core)].reshape(-1, 15, 3)
    assert found.stature_m == pytest.approx(build_of(bones, BODY_25).stature, rel=0.02)


@pytest.mark.slow
def test_a_sound_rig_is_kept_and_its_adjustment_within_its_sigma(rig, recording):
    found = refine(recording, rig, TIMES, range(125))
    assert not found.better and found.rig is rig
    turn, move = off_by(found.adjusted.rig, rig)
    for off, sigma in (
        (turn, np.degrees(found.adjusted.sigma(TURN))),
        (move, found.adjusted.sigma(MOVE)),
    ):
        assert (off < 3 * sigma).all() and np.median(off / sigma) < 2
    assert abs(found.after_px / found.before_px - 1) < 0.1


@pytest.mark.slow
def test_a_calibration_by_a_board_is_kept_against_a_detector_s_biases(
    shared_cases, tmp_path, capsys
):
    """One person's lasting biases fit other cameras better, on frames that were not used as
    well.
    """
    case, new = shared_cases / "caliscope_person", tmp_path / "new.toml"
    base = [
        "refine-calibration",
        "--calibration",
        case / "camera_array_aniposelib_4cam.toml",
        "--up",
        "x",
        "--focal",
    ]
    code, out, _ = run(
        [*base, "--detections", case / "detections", "--fps", 30, "--output", new], capsys
    )
    assert code == 0 and "the cameras were not changed" in " ".join(out.split())
    given, kept = (read_rig(each, up="x") for each in (base[2], new))
    np.testing.assert_allclose(kept.centres, given.centres, atol=1e-6)
    np.testing.assert_allclose(kept.K, given.K, atol=1e-3)


def test_more_frames_of_the_same_biases_are_no_more_evidence(rig, recording, people, seed=0):
    bias = lasting(np.random.default_rng(seed), 0.02, 0.08, 25, 4)[None]
    seen = biased(recording, rig, people, np.repeat(bias, 3, axis=0))
    usual = np.array([*Freedom(1.0, 0.02).sigmas[:6], 0.0, 0.0, 0.02])
    few, many = (gather(seen, frames, 4) for frames in (range(60), range(250)))
    for evidence in (few, many):
        assert SmallErrors.of(SetupHypothesis.given(evidence, rig)).off(usual) < 0.5
    assert (
        SmallErrors.of(
            SetupHypothesis.given(many, disturbed(rig, seed, degrees=3, metres=0.1))
        ).off(usual)
        > 0.5
    )


@pytest.mark.slow
def test_a_bumped_camera_does_not_pull_the_others(rig, recording):
    bumped = replace(rig, cameras=(disturbed(rig, 1, degrees=2.5).cameras[0], *rig.cameras[1:]))
    footage, now = Footage.of(recording, rig, TIMES, range(125)), bumped
    for _ in range(3):
        people = footage.people(now)
        now = adjust(bumped, now, people, Freedom(), 12.0, misfit(people, now)).rig
    assert off_by(now, rig)[0].max() < 0.3
    # Where the rig stands as a whole is said by the three that were right.
    apart = [
        a.wTc[:3, :3].T @ b.wTc[:3, :3]
        for a, b in zip(now.cameras[1:], rig.cameras[1:], strict=True)
    ]
    assert max(np.degrees(np.arccos((np.trace(each) - 1) / 2)) for each in apart) < 0.5


@pytest.mark.slow
def test_a_camera_that_was_knocked_far_off_is_found_again(rig, recording):
    knocked = replace(rig, cameras=(disturbed(rig, 1, degrees=15).cameras[0], *rig.cameras[1:]))
    found = refine(recording, knocked, TIMES, range(125))
    assert (
        found.better
        and off_by(found.rig, rig)[0].max() < 0.3
        and off_by(found.rig, rig)[1].max() < 0.03
    )
    assert (
        found.change()["turn"][0] == pytest.approx(15, abs=1)
        and found.change()["turn"][1:].max() < 1
    )


@pytest.mark.slow
def test_joints_behind_a_camera_are_no_trouble(rig, recording):
    """Where cameras are far off, joints end behind them; what these say is nothing, and nothing
    fails.
    """
    people = Footage.of(recording, rig, TIMES, range(250)).people(rig)
    back = np.diag([-1.0, 1.0, -1.0, 1.0])
    cameras = tuple(
        replace(each, wTc=each.wTc @ back) if v < 3 else each for v, each in enumerate(rig.cameras)
    )
    wrong = replace(rig, cameras=cameras)
    adjusted = adjust(wrong, wrong, people, Freedom(), 12.0)
    assert (wrong.project(people.points)[1][0][people.seen[..., 0]] < 0).all()
    assert np.isfinite(adjusted.covariance).all() and np.isfinite(adjusted.rig.centres).all()


@pytest.mark.slow
def test_the_reference_camera_keeps_its_pose(rig, recording):
    wrong, footage = disturbed(rig, 2), Footage.of(recording, rig, TIMES, range(250))
    adjusted = adjust(wrong, wrong, footage.people(wrong), Freedom(), 12.0, reference=1)
    np.testing.assert_allclose(adjusted.rig.cameras[1].wTc, wrong.cameras[1].wTc, atol=1e-5)
    assert adjusted.sigma(TURN)[1] == 0 < adjusted.sigma(TURN)[0]


def test_people_whom_one_camera_sees_are_too_few(rig, recording):
    alone = Recording(recording.skeleton, [each.only(each.view == 0) for each in recording.frames])
    with pytest.raises(InputError, match="only 0 people are seen by two cameras"):
        refine(alone, rig, TIMES, range(250))


@pytest.mark.parametrize("frames", [range(1), range(3), range(249, 250)])
def test_a_few_frames_are_too_few(rig, recording, frames):
    with pytest.raises(InputError, match=r"only [0-9]+ people are seen by two cameras"):
        refine(recording, rig, TIMES, frames)


@pytest.mark.slow
def test_two_cameras(rig, recording):
    two = replace(rig, cameras=rig.cameras[:2])
    seen = Recording(recording.skeleton, [each.only(each.view < 2) for each in recording.frames])
    wrong = disturbed(two, 0)
    found = refine(seen, wrong, TIMES, range(125))
    # Of two cameras half of what is wrong shows: here a bias of the detector is no good
    # explanation, but one.
    assert found.after_px < min(3, found.before_px) and found.probability > 0.5
    # How they look at each other is found; along the line between them they may both turn.
    assert off_by(found.adjusted.rig, two)[0].max() < off_by(wrong, two)[0].max()


@pytest.mark.slow
def test_what_motion_does_not_determine_is_said(rig, recording):
    frames = [each.only((each.view != 3) | (t < 2)) for t, each in enumerate(recording.frames)]
    few = Recording(recording.skeleton, [*frames[:25], *[Detections.empty()] * 225])
    found = refine(few, rig, TIMES, range(25), Freedom(focal=0.02))
    assert any("camera cam3" in each and "it is not changed" in each for each in found.notes)


def pose2sim_project(rig, recording, folder):
    """A project with our own rig file as its calibration."""
    (folder / "calibration").mkdir(parents=True)
    (folder / "Config.toml").write_text("[project]\nframe_rate = 25\nmulti_person = true\n")
    write_rig(rig, folder / "calibration" / "rig.json")
    write_openpose(recording, rig, folder / "pose")
    return folder


def test_places_and_names_are_looked_at_first(rig, recording, tmp_path, capsys):
    project = pose2sim_project(
        rig, replace(recording, frames=recording.frames[:3]), tmp_path / "walk"
    )
    base = ["refine-calibration", "--project", project, "--output"]
    code, _, error = run([*base, tmp_path / "new.qca.txt"], capsys)
    assert code == 2 and "cameras read as rig file can be written as that" in " ".join(
        error.split()
    )
    code, _, error = run(["refine-calibration", "--output", tmp_path / "new.json"], capsys)
    assert code == 2 and "--calibration and --detections: missing" in " ".join(error.split())
    assert not list(tmp_path.glob("new*"))


@pytest.mark.slow
def test_the_command_writes_cameras_and_says_what_changed(
    rig, recording, tmp_path, capsys, monkeypatch, once
):
    """Of a Pose2Sim project, and of its files one by one."""
    monkeypatch.setattr(refinement, "refine", once(refine))
    five_seconds, new = replace(recording, frames=recording.frames[:125]), tmp_path / "new.json"
    project = pose2sim_project(disturbed(rig, 4), five_seconds, tmp_path / "walk")
    page = ["--report", tmp_path / "page.html"]
    code, out, error = run(
        ["refine-calibration", "--project", project, "--output", new, *page], capsys
    )
    assert code == 0 and "25 Hz (from Config.toml)" in " ".join(error.split())
    said = " ".join(out.split())
    assert f"next: shapepose-fg reconstruct --calibration {new} --project {project}" in said
    assert "px before" in said and "±" in said
    drawn = json.loads(
        (tmp_path / "page.html").read_text().split('id="scene-data">')[1].split("</script>")[0]
    )
    given = project / "calibration" / "rig.json"
    for part, used in (("before", given), ("cameras", new)):
        centres = [each["centre"] for each in drawn[part]]
        np.testing.assert_allclose(centres, read_rig(used).centres, atol=1e-6)
    assert off_by(read_rig(new), rig)[0].max() < 0.25
    base = [
        "refine-calibration",
        "--calibration",
        given,
        "--detections",
        project / "pose",
        "--fps",
        25,
    ]
    code, out, _ = run([*base, "--json", "--output", tmp_path / "again.json"], capsys)
    told = json.loads(out)
    assert (
        code == 0
        and told["better"]
        and len(told["cameras"]) == 4
        and told["held_out"]["after_px"] < 8
    )
    np.testing.assert_allclose(
        read_rig(tmp_path / "again.json").centres, read_rig(new).centres, atol=1e-6
    )
    for more, said in (
        (["--reference", "x"], "no such camera"),
        (["--off-degrees", 90], "must be at most 20"),
    ):
        code, _, error = run([*base, *more, "--output", new], capsys)
        assert code == 2 and said in " ".join(error.split())


@pytest.mark.slow
def test_a_distortion_is_found_from_a_wrong_one(rig, people):
    lens = np.array([-0.2, 0.05, 0.0, 0.0, 0.0])
    true, given = (
        replace(rig, cameras=tuple(replace(each, distortion=d) for each in rig.cameras))
        for d in (lens, 0.6 * lens)
    )
    frames = []
    for each in seen_by(rig, people[::12], sigma_px=0.2).frames:
        xy = each.xy.copy()
        for view, cameras in enumerate(zip(true.cameras, given.cameras, strict=True)):
            mine = each.view == view
            xy[mine] = cameras[1].undistort(cameras[0].distort(xy[mine]))
        frames.append(replace(each, xy=xy))
    sightings = Sightings.of(Recording(BODY_25, frames), range(len(frames)))
    footage, now = Footage.taken(sightings, given, BODY_25), given
    for _ in range(4):
        here = footage.people(now)
        now = adjust(given, now, here, Freedom(0.1, 0.005, lens=0.1), 2.5, misfit(here, now)).rig
    off = [np.abs(each.distortion - lens)[0] for each in now.cameras]
    assert max(off) < 0.02  # 0.08 before
