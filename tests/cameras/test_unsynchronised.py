"""Cameras of unknown poses that were started by hand: when and where, from the people alone, or
refused.
"""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.cameras.calibrate import unsynchronised
from shapepose_fg.cameras.calibrate.from_people import Undetermined, own_tracks
from shapepose_fg.cameras.calibrate.unsynchronised import calibrate_unsynchronised
from shapepose_fg.cameras.offsets.from_heights import offsets_without_poses
from shapepose_fg.cameras.sightings import Sightings
from shapepose_fg.cameras.tracks import next_of, on_one_clock
from shapepose_fg.cli.main import main
from shapepose_fg.core.decompositions import rigid
from shapepose_fg.core.rig_file import write_trajectory
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.io.calibration import read_rig
from tests.cameras.conftest import FPS, LATE_S, merged, moving
from tests.cameras.test_from_people import off_after_growing, unposed


@pytest.mark.slow
def test_rough_offsets_need_no_poses(rig, late):
    tracks = own_tracks(Sightings.of(late, range(300)), unposed(rig), FPS)
    shift = offsets_without_poses(tracks, FPS, 8.0)
    # Frame f of the first camera is frame f + shift of one that began later by so many.
    assert np.abs(shift + LATE_S * FPS).max() < 3


def test_moments_of_one_clock():
    """Two cameras, one person each who moves by 4 px a frame; the second began 2.25 frames late."""
    frame = np.tile(np.arange(20), 2)
    view = np.repeat([0, 1], 20)
    joints = np.linspace(0, 300, 15)[:, None] * [0.3, 1.0]
    time = frame + 2.25 * view
    xy = joints + 4.0 * time[:, None, None]
    seen = Sightings(frame, view, xy, np.full((40, 15), 0.8))
    following = next_of(seen)
    assert (following[frame < 19] == np.flatnonzero(frame < 19) + 1).all() and (
        following[frame == 19] == -1
    ).all()
    one = on_one_clock(seen, following, np.array([0.0, -2.25]), BODY_25)
    both = [one.at([moment]) for moment in one.frames]
    assert len(one.frames) == 17 and all(len(each) == 2 for each in both)
    assert max(np.abs(each.xy[0] - each.xy[1]).max() for each in both) < 1e-9


@pytest.mark.slow
def test_people_who_stand_are_refused(rig, two_people, few_frames, monkeypatch):
    """Offsets never converge: the first round has it all."""
    monkeypatch.setattr(unsynchronised, "ROUNDS", 1)
    three = replace(rig, cameras=rig.cameras[:3])
    still = np.repeat(moving(two_people[0], 0.0)[None, :2], 80, axis=0)
    with pytest.raises(
        Undetermined, match=r"camera cam0: the motion .* does not determine its off"
    ):
        calibrate_unsynchronised(merged(three, [still] * 3), unposed(three), FPS, range(80), 1.0)


@pytest.mark.slow
def test_the_command_finds_poses_and_times_from_people_alone(
    rig, in_late_files, capsys, monkeypatch, once, few_frames
):
    """Of three cameras, which the next test has, too: both compute these once."""
    steps = list[tuple[int, int]]()

    def watched(*given, **more):
        *others, progress = given

        def told(done: int, total: int) -> None:
            steps.append((done, total))
            progress(done, total)

        return once(calibrate_unsynchronised)(*others, told, **more)

    monkeypatch.setattr(unsynchronised, "calibrate_unsynchronised", watched)
    base = ["calibrate", "--calibration", "rig.json", "--detections", "detection", "--fps", "25"]
    base += ["--without", "cam2"]
    for more, code, said in (
        (
            ["--times", "times.csv", "--most", "6", "--report", "page.html"],
            0,
            "--timestamps times.csv",
        ),
        (["--times", "times.csv", "--timestamps", "rig.json"], 2, "give one of them"),
        (["--times", "times.csv", "--most", "0"], 2, "must be positive"),
    ):
        with pytest.raises(SystemExit) as ended:
            main([*base, "--output", "new.json", *more])
        out, error = capsys.readouterr()
        assert ended.value.code == code and said in " ".join((out + error).split())
    assert steps[-1][0] == steps[-1][1] and steps == sorted(steps)
    # The first offsets, of two pairs, take about as long as a round of poses: the time left is
    # estimated from these steps.
    assert steps[1][0] > 0.15 * steps[1][1]
    turn, move, _ = off_after_growing(read_rig("new.json"), rig.without(["cam2"]))
    assert turn.max() < 0.4 and move.max() < 0.03
    rows = np.array(
        [line.split(",")[1:] for line in Path("times.csv").read_text().splitlines()[1:]],
        dtype=float,
    )
    late_s = np.delete(LATE_S, 2)
    assert rows.shape == (300, 3) and np.abs(rows[7] - rows[7, 0] - late_s).max() < 0.005
    page = Path("page.html").read_text()
    scene = re.search(r'id="scene-data">(.*?)</script>', page, re.S)
    assert scene is not None and len(json.loads(scene[1])["cameras"]) == 3
    assert page.count('px<span class="range"') == 3 and "before" not in json.loads(scene[1])


@pytest.mark.slow
def test_the_command_finds_the_start_of_a_camera_with_a_log(
    rig, in_late_files, capsys, monkeypatch, once, few_frames
):
    """The log has its own clock, world and quarter turn; the rig and the times come back."""
    monkeypatch.setattr(unsynchronised, "calibrate_unsynchronised", once(calibrate_unsynchronised))
    turn = Rotation.from_rotvec([[0.4, 0.2, 1.0], [0, 0, np.pi / 2]]).as_matrix()
    oTc = rigid(turn[0], np.array([5.0, 6, 7])) @ rig.cameras[2].wTc @ rigid(turn[1], np.zeros(3))
    time_s = 4000 + np.arange(300) / FPS
    log = Trajectory("cam2", time_s, np.tile(oTc, (300, 1, 1)))
    write_trajectory(log, Path("log.tum"))
    base = ["calibrate", "--calibration", "rig.json", "--detections", "detection", "--fps", "25"]
    base += ["--times", "times.csv", "--most", "6", "--trajectory", "cam2=log.tum"]

    def run(*more: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as ended:
            main([*base, *more])
        said = capsys.readouterr()
        return int(str(ended.value.code)), " ".join((said.out + said.err).split())

    code, said = run("--output", "new.json", "--tolerance", "0.001,0.01")
    assert (
        code == 1
        and "camera cam2: its poses are known to" in said
        and not Path("new.json").exists()
    )
    assert "accepted: --calibration new.refused.json --timestamps times.refused.csv" in said
    kept = read_rig("new.refused.json")
    base += ["--tolerance", "5,300"]
    code, said = run("--output", "new.json", "--format", "pose2sim")
    assert code == 2 and "--format pose2sim: cannot hold --trajectory" in said
    code, said = run("--output", "new.json")
    assert code == 0, said
    assert "camera cam2: its trajectory starts" in said
    assert "trust: rotations to" in said and "--distance" in said
    found = read_rig("new.json")
    np.testing.assert_array_equal(kept.wTc, found.wTc)
    assert [bool(each.carrier) for each in found.cameras] == [False, False, True, False]
    turned, moved, _ = off_after_growing(found, rig)
    assert turned.max() < 1.0 and moved.max() < 0.1
    rows = np.genfromtxt("times.csv", delimiter=",", skip_header=1)[:, 1:]
    assert np.abs(rows[7] - rows[7, 0] - LATE_S).max() < 0.03
    assert found.trajectories[0].time_s[0] == pytest.approx(rows[0, 2], abs=1e-5)
