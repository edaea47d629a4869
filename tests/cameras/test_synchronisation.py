"""Cameras that were started by hand: found from the people, to a part of a frame, or said to be
unknown.
"""

import json
import shlex

import numpy as np
import pytest

from shapepose_fg.cameras import synchronise as synchronisation
from shapepose_fg.cameras.offsets.subframe import InSpace, Pairwise
from shapepose_fg.cameras.sightings import Sightings
from shapepose_fg.cameras.synchronise import synchronise
from shapepose_fg.cameras.tracks import CameraTracks, at_regular_times
from shapepose_fg.cli.main import main
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import Recording
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from tests.cameras.conftest import COMMON, FPS, LATE_S, filmed, merged, moving


@pytest.mark.slow
def test_offsets_of_any_size_are_found_to_milliseconds(rig, late):
    found = synchronise(late, rig, FPS, range(300), 8.0)
    assert found.undetermined(rig) == [] and (found.drift == 0).all()
    error = found.offset_s - LATE_S
    assert np.abs(error).max() < 0.003
    assert (
        np.abs(error[1:]) < 3.5 * found.sigma_s[1:] + 5e-4
    ).all() and found.sigma_s.max() < 0.004


@pytest.mark.slow
def test_clocks_that_run_apart(rig, two_people, monkeypatch):
    monkeypatch.setattr(synchronisation, "WHOLE_S", 6.0)
    monkeypatch.setattr(synchronisation, "_END_S", 5.0)
    drift = np.array([0.0, 0.0, 0.003, 0.0])
    seen = merged(
        rig, [filmed(two_people[0], *each) for each in zip([0, 0.7, -0.3, 0.2], drift, strict=True)]
    )
    found = synchronise(seen, rig, FPS, range(300), 2.0)
    assert np.abs(found.drift - drift).max() < 0.001
    # Frame 250 of the third camera was exposed after 10 s of a clock that is 3 in 1,000 slow.
    assert found.of_views(np.full(4, 10.0))[2] == pytest.approx(10.03 - 0.3, abs=0.008)


def test_frames_of_any_rate_are_interpolated_to_regular_times():
    """Two cameras, one 1 % slower and one with jitter, see a point that moves in a straight line;
    so they do at the same times, apart from a gap.
    """
    rng, frame = np.random.default_rng(0), np.arange(200)
    time_s = np.stack([frame / 24.75, frame / 25 + rng.uniform(-0.005, 0.005, 200)], axis=1)
    time_s -= time_s[0]
    seen = np.repeat(frame[(frame < 90) | (frame > 100)], 2)
    view = np.tile([0, 1], len(seen) // 2)
    spread = 100 * rng.random((15, 2))
    xy = spread + 500 + 20 * time_s[seen, view][:, None, None]
    given = Sightings(seen, view, xy, np.ones(xy.shape[:2]))
    even = at_regular_times(given, time_s, 25.0)
    np.testing.assert_allclose(even.xy, spread + 500 + 20 * even.frame[:, None, None] / 25)
    for each in (0, 1):
        frames = even.frame[even.view == each]
        assert len(np.unique(frames)) == len(frames) > 180 and frames[0] == 0
    assert at_regular_times(given, None, 25.0) is given


@pytest.mark.slow
def test_two_cameras(rig, late):
    two = Rig(rig.cameras[:2], rig.up)
    found = synchronise(
        Recording(late.skeleton, [f.only(f.view < 2) for f in late.frames]),
        two,
        FPS,
        range(300),
        8.0,
    )
    assert abs(found.offset_s[1] - LATE_S[1]) < 0.02


def test_a_camera_that_sees_somebody_else_beside_is_left_out_of_a_person(rig, two_people):
    """Three cameras see one person; the fourth sees another, who comes as near as 10 cm, and goes
    again.
    """
    times = np.arange(100) / FPS
    one = np.stack([moving(two_people[0], t)[0] for t in times])
    beside = 0.1 + 0.9 * np.abs(np.sin(np.pi * times / 2))
    other = one + beside[:, None, None] * np.array([0.8, 0.6, 0.0])
    parts = [merged(rig, [who[:, None]] * 4) for who in (one, other)]
    frames = (
        [a.only(a.view < 3) for a in parts[0].frames],
        [b.only(b.view == 3) for b in parts[1].frames],
    )
    seen = [Sightings.of(Recording(parts[0].skeleton, each), range(100)) for each in frames]
    both = Sightings(
        *(
            np.concatenate([getattr(s, n) for s in seen])
            for n in ("frame", "view", "xy", "confidence")
        )
    )
    views = Views.of(rig)
    tracks = [CameraTracks.of(both, views, view, FPS) for view in range(4)]
    space = InSpace.of(Pairwise(tracks, views, np.zeros(4), FPS))
    assert len(space.time) >= 45  # of 50 moments
    assert (space.member[:, :3] == 0).all() and (space.member[:, 3] == -1).all()


@pytest.mark.slow
def test_people_who_stand_tell_nothing(rig, two_people):
    still = np.repeat(moving(two_people[0], 0.0)[None], 150, axis=0)
    found = synchronise(merged(rig, [still] * 4), rig, FPS, range(150), 3.0)
    said = found.undetermined(rig)
    assert (
        len(said) == 4 and "does not determine its offset" in said[0] and "camera cam0" in said[0]
    )


@pytest.mark.parametrize("every", [1000, 4])
def test_a_camera_that_sees_nobody_or_single_frames_is_named(rig, late, every):
    blind = [f.only((f.view != 2) | (n % every == 1)) for n, f in enumerate(late.frames)]
    with pytest.raises(InputError, match="camera cam2: too few people are seen, or in single"):
        synchronise(Recording(late.skeleton, blind), rig, FPS, range(300), 1.0)


@pytest.mark.slow
def test_the_command_writes_what_reconstruct_takes(
    in_late_files, two_people, tmp_path, capsys, monkeypatch, once
):
    monkeypatch.setattr(synchronisation, "synchronise", once(synchronise))
    base = [
        "synchronise",
        "--calibration",
        tmp_path / "rig.json",
        "--detections",
        tmp_path / "detection",
    ]
    for more, code, said in (
        (
            ["--fps", "25", "--most", "8", "--output", tmp_path / "same.csv"],
            0,
            "next: shapepose-fg reconstruct",
        ),
        (["--fps", "25", "--most", "8", "--json"], 0, '"offset_s"'),
        ([], 2, "--fps: missing"),
        (["--fps", "25", "--most", "-1"], 2, "--most"),
    ):
        with pytest.raises(SystemExit) as ended:
            main([str(each) for each in [*base, *more]])
        out, error = capsys.readouterr()
        assert ended.value.code == code and said in out + error
        if "--json" in more:
            told = json.loads(out)["cameras"]
            assert np.abs([each["offset_s"] for each in told] - LATE_S).max() < 0.003
        if "--output" in more:
            assert "--start cam1=3.7" in out
            line = next(each for each in out.splitlines() if each.startswith("next: "))
    with pytest.raises(SystemExit) as ended:
        main([*line.split()[2:], "--frames", "0:24", "--no-report", "--no-check"])
    assert ended.value.code == 0
    asked = [
        "reconstruct",
        "--calibration",
        "rig.json",
        "--detections",
        "detection",
        "--output",
        "at-once",
    ]
    asked += ["--synchronise", "--frames", "0:24", "--no-report", "--no-check"]
    for more, code in ((["--timestamps", "same.csv"], 2), (["--fps", "25"], 0)):
        with pytest.raises(SystemExit) as ended:
            main([*asked, *more])
        assert ended.value.code == code
    assert (tmp_path / "at-once" / "synchronised.csv").read_text() == (
        tmp_path / "same.csv"
    ).read_text()
    np.testing.assert_array_equal(
        Reconstruction.load("at-once").joints, Reconstruction.load("results").joints
    )
    # The cameras' first common moment: what the first camera, which the times are of, calls 4 s.
    people, body = Reconstruction.load("results"), two_people[0] + np.array([0.45, 0.0, 0.0])
    start = people.time_s.min() - (LATE_S.max() - LATE_S.min())
    assert len(np.unique(people.person)) == 3 and abs(start) < 0.03
    for joints, time_s in zip(people.joints, people.time_s, strict=True):
        truth = moving(body, time_s + LATE_S.min())
        assert np.nanmedian(np.linalg.norm(joints - truth, axis=-1), axis=1).min() < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        "synchronise --calibration rig.json --detections detection --most 8 --output same.csv",
        "reconstruct --calibration rig.json --detections detection --synchronise --output "
        "results --no-report --preset fast",
    ],
)
def test_files_of_unequal_length_keep_all_common_footage(
    in_detected_files, command, capsys, monkeypatch, once
):
    """Any line that is printed next is typed as it is."""
    monkeypatch.setattr(synchronisation, "synchronise", once(synchronise))
    with pytest.raises(SystemExit) as ended:
        main(command.split())
    out, error = capsys.readouterr()
    assert ended.value.code == 0, error
    for line in (each for each in out.splitlines() if each.startswith("next: ")):
        with pytest.raises(SystemExit) as ended:
            main([*shlex.split(line)[2:], "--no-report", "--no-check", "--preset", "fast"])
        assert ended.value.code == 0, capsys.readouterr().err
    people = Reconstruction.load("results")
    assert abs(len(np.unique(people.frame)) - COMMON) <= 2
    assert len(np.unique(people.person)) == 3
