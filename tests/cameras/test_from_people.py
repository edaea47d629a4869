"""Cameras of known lenses are placed by people who walk about; what these do not determine is
refused by name.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.rotation import exp_so3
from shapepose_fg.body.shapes import statures_m
from shapepose_fg.cameras.bundle import Freedom, adjust
from shapepose_fg.cameras.calibrate.arrangement import Edge, arranged, parts
from shapepose_fg.cameras.calibrate.from_people import Undetermined, calibrate
from shapepose_fg.cameras.calibrate.levelling import Measured, scale_of, sigma_of_scale
from shapepose_fg.cameras.parameters import MOVE, TURN
from shapepose_fg.cameras.people import Footage
from shapepose_fg.cameras.relative_pose import refined_pose
from shapepose_fg.cameras.stature import build_of
from shapepose_fg.cli.calibrate import _BENT, _CENTRE_OFF
from shapepose_fg.cli.main import main
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.decompositions import rigid
from shapepose_fg.core.detections import Recording
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.calibration import read_rig, write_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.lenses import lenses_of
from shapepose_fg.io.write_detections import write_openpose
from shapepose_fg.simulation.motion import BodyMotion
from shapepose_fg.simulation.scene import keypoints_of
from tests.cameras.conftest import FPS, off_by
from tests.conftest import read_body

pytestmark = pytest.mark.usefixtures("few_frames")

TIMES = FrameTimes.from_fps(FPS, 250)


def unposed(rig: Rig) -> Rig:
    """The rig whose poses are forgotten: truth never reaches the method."""
    return replace(rig, cameras=tuple(replace(each, wTc=np.eye(4)) for each in rig.cameras))


def only(recording: Recording, keep) -> Recording:
    """What the cameras saw for which `keep` of view and frame holds."""
    return Recording(
        recording.skeleton,
        [each.only(keep(each.view, t)) for t, each in enumerate(recording.frames)],
    )


def off_after_growing(rig: Rig, truth: Rig) -> tuple[np.ndarray, np.ndarray, float]:
    """Degrees and metres by which cameras are off after a similarity, and how much too large the
    rig is.
    """
    size = [np.linalg.norm(each.centres - each.centres.mean(axis=0)) for each in (rig, truth)]
    cameras = []
    for camera in rig.cameras:
        wTc = camera.wTc.copy()
        wTc[:3, 3] *= size[1] / size[0]
        cameras.append(replace(camera, wTc=wTc))
    return *off_by(replace(rig, cameras=tuple(cameras)), truth), size[0] / size[1]


@pytest.mark.slow
def test_cameras_are_placed_by_people_alone(rig, recording):
    steps = list[tuple[int, int]]()
    found = calibrate(
        recording, unposed(rig), TIMES, range(250), progress=lambda *each: steps.append(each)
    )
    turn, move, grown = off_after_growing(found.rig, rig)
    # Errors of 2 px do not last here: a tenth of a degree, 1 cm at 4 m, is what ten seconds of
    # three people tell.
    assert turn.max() < 0.25 and move.max() < 0.02 and found.notes == ()
    assert (turn < 3 * np.degrees(found.adjusted.sigma(TURN))).all()
    assert (move < 3 * found.adjusted.sigma(MOVE)).all()
    assert abs(grown - 1) < 3.5 * found.world.sigma_scale and 0.03 < found.world.sigma_scale < 0.06
    # z is up and the floor at 0: heights of cameras are those of the true rig, which stands so.
    assert found.rig.up == "z" and found.world.persons == 3
    np.testing.assert_allclose(found.rig.centres[:, 2] / grown, rig.centres[:, 2], atol=0.08)
    assert steps[-1][0] == steps[-1][1] and found.held_out_px < 8


def test_people_of_known_stature_say_the_scale(rig, recording):
    people = Footage.of(recording, rig, TIMES, range(0, 250, 5)).people(rig)
    factors = [scale_of(people.points, recording.skeleton, stature) for stature in (None, 1.87)]
    assert factors[1] / factors[0] == pytest.approx(1.87 / 1.70)
    # Who knows people's stature knows the scale better, and more people do; a detector's bias
    # stays.
    assert 0.025 < sigma_of_scale(3, True) < sigma_of_scale(3, False) < sigma_of_scale(1, False)


def test_bones_say_how_tall_somebody_is():
    body = BodyModel.default()
    betas = np.random.default_rng(0).normal(size=(40, body.num_betas))
    statures = statures_m(betas, read_body())
    stands = keypoints_of(body, BodyMotion.still(betas))[0][:, list(BODY_25.core)]
    said = np.array([build_of(each[None], BODY_25).stature for each in stands])
    # The model's shape space leaves 0.9 %; limbs alone, legs and arms alike, would leave 2.4.
    assert np.std(said / statures) < 0.012 and np.mean(said / statures) == pytest.approx(
        1, abs=0.005
    )
    # Whose trunk and right leg are hidden is as tall, about; of whom nothing is seen nobody knows.
    stands[:, [8, 9, 10, 11, 12]] = np.nan
    arms = np.array([build_of(each[None], BODY_25).stature for each in stands])
    np.testing.assert_allclose(arms / statures, 1, atol=0.13)
    assert np.isnan(build_of(np.full((2, 15, 3), np.nan), BODY_25).stature)


@pytest.fixture(scope="module")
def adjusted(rig, recording):
    """The true cameras, adjusted to the people."""
    people = Footage.of(recording, rig, TIMES, range(250)).people(rig)
    return adjust(rig, rig, people, Freedom(20.0, 1.0), 12.0, scaled=True)


@pytest.mark.slow
def test_measured_distances_say_the_scale(adjusted):
    c = adjusted.rig.centres
    away = {(a, b): float(np.linalg.norm(c[a] - c[b])) for a in range(4) for b in range(a)}
    grown, sigma = Measured(distances=((2, 0, 1.1 * away[2, 0]),)).size_of(adjusted)
    assert grown == pytest.approx(1.1)
    # A tape errs by 2 cm; the cameras' own sigma comes on top.
    assert 0.02 / (1.1 * away[2, 0]) < sigma < 0.01
    both, surer = Measured(distances=((2, 0, 1.1 * away[2, 0]), (1, 3, 1.1 * away[3, 1]))).size_of(
        adjusted
    )
    assert both == pytest.approx(1.1) and surer < 0.8 * sigma
    wrong = ((2, 0, 1.1 * away[2, 0]), (1, 3, 1.1 * away[3, 1]), (1, 0, 1.3 * away[1, 0]))
    with pytest.raises(
        InputError, match=r"distance of cam1 and cam0: people and .* give .* m instead of"
    ):
        Measured(distances=wrong).size_of(adjusted)
    (note,) = Measured().better(adjusted, 0.05)
    far = ",".join(adjusted.rig.names[each] for each in sorted(max(away, key=away.__getitem__)))
    assert note.startswith(f"--distance {far}=") and "instead of 5.0 %" in note
    assert Measured().better(adjusted, 0.001) == ()


@pytest.mark.slow
def test_joints_behind_a_camera_are_no_fit(rig, recording, capfd):
    people = Footage.of(recording, rig, TIMES, range(0, 250, 25)).people(rig)
    # The first camera starts turned about: everybody is behind it.
    wTc = rig.cameras[0].wTc @ np.diag([-1.0, 1.0, -1.0, 1.0])
    start = replace(rig, cameras=(replace(rig.cameras[0], wTc=wTc), *rig.cameras[1:]))
    found = adjust(rig, start, people, Freedom(20.0, 1.0), 12.0)
    assert np.isfinite(found.covariance).all() and capfd.readouterr().out == ""


@pytest.mark.slow
def test_a_camera_that_shares_no_moment_is_named(rig, recording):
    apart = only(recording, lambda view, t: (view == 3) == (t >= 125))
    with pytest.raises(Undetermined, match="camera cam3: too few people are seen there") as refused:
        calibrate(apart, unposed(rig), TIMES, range(250))
    assert (
        len(refused.value.problems) == 1 and "film people for a minute" in refused.value.problems[0]
    )


@pytest.mark.parametrize("frames", [range(3), range(100, 110)])
def test_recordings_that_are_too_short_are_refused(rig, recording, frames):
    with pytest.raises(
        Undetermined, match="cameras cam0 cam1 cam2 cam3: at least 3 s of a person are needed, "
    ) as no:
        calibrate(recording, unposed(rig), TIMES, frames)
    assert len(no.value.problems) == 1 and "--without" not in no.value.problems[0]


def test_a_camera_without_people_can_be_left_out(rig, recording):
    empty = only(recording, lambda view, t: view != 3)
    with pytest.raises(Undetermined, match=r"camera cam3: .* only \(--without cam3\)"):
        calibrate(empty, unposed(rig), TIMES, range(250))


def test_two_cameras_are_nearest_to_what_they_saw():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 15, 3)) * [1.0, 0.6, 1.0] + [0.0, 0.0, 5.0]
    turn = np.array([0.0, 0.9, 0.1])
    R, t = _rotation(turn), np.array([-0.9, 0.1, 0.4])
    t = t / np.linalg.norm(t)
    b = points @ R.T + 4.0 * t
    rays = [each / np.linalg.norm(each, axis=-1, keepdims=True) for each in (points, b)]
    near, way = refined_pose(
        _rotation(turn + np.array([0.03, -0.05, 0.02])),
        t + np.array([0.05, 0.05, 0.0]),
        *rays,
        np.full(40, 0.3),
    )
    np.testing.assert_allclose(near, R, atol=1e-5)
    np.testing.assert_allclose(way, t, atol=1e-5)


def test_a_wrong_pair_gives_way():
    rng = np.random.default_rng(1)
    poses = np.tile(np.eye(4), (4, 1, 1))
    for view in range(4):
        poses[view, :3, :3] = _rotation(np.array([0.1 * view, 1.4 * view, 0.0]))
        poses[view, :3, 3] = rng.normal(size=3) * 3
    edges = {}
    for a, b in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)):
        bTa = np.linalg.solve(poses[b], poses[a])
        wrong = (a, b) == (0, 3)
        R = _rotation(np.array([0.0, 2.0 * wrong, 0.0])) @ bTa[:3, :3]
        # The wrong pair fits best, alone.
        edges[a, b] = Edge(rigid(R, bTa[:3, 3]), 0.9 if wrong else 0.6)
    found = arranged(edges, 4)
    between = np.linalg.solve(found[3], found[0])
    np.testing.assert_allclose(between, np.linalg.solve(poses[3], poses[0]), atol=0.02)
    assert parts({(0, 2): 0, (3, 2): 0}, 5) == [[0, 2, 3], [1], [4]]


def _rotation(turn: np.ndarray) -> np.ndarray:
    """(3, 3) of a rotation vector."""
    return exp_so3(np.asarray(turn, dtype=np.float64))


def test_lenses_by_their_field_of_view(tmp_path):
    for name in ("left_json", "right_json"):
        (tmp_path / name).mkdir()
    (tmp_path / "times.csv").touch()
    rig = lenses_of(tmp_path, ["90", "right=60"], (1920, 1080))
    assert rig.names == ("left", "right") and rig.cameras[0].image_size == (1920, 1080)
    np.testing.assert_allclose(rig.focal_px, [960.0, 960 * np.sqrt(3)])
    upright = lenses_of(tmp_path, ["90", "right=60"], (1080, 1920))
    np.testing.assert_allclose(upright.focal_px, rig.focal_px)
    for fields, size, said in (
        (["90"], None, "camera left: the size of its pictures is unknown; pass --image-size"),
        (["3"], (640, 480), "--field-of-view 3: must be 5 to 150 degrees"),
        (["up=60"], (640, 480), "there is no camera 'up'; there are left right"),
        (["left=60"], (640, 480), "missing for camera right"),
    ):
        with pytest.raises(InputError, match=said):
            lenses_of(tmp_path, fields, size)


def test_lenses_by_the_logs_of_phones(tmp_path):
    """Stray Scanner's, per picture or as a matrix; not those of pictures of another size."""
    for name in ("left_json", "right_json"):
        (tmp_path / name).mkdir()
    head = "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy\n"
    row = "812.{}, 0, 1, 2, 3, 0, 0, 0, 1, {}, 1401, 950, 725\n"
    (tmp_path / "odometry.csv").write_text(head + row.format(5, 1400) + row.format(6, 1402))
    (tmp_path / "camera_matrix.csv").write_text("1380.0, 0, 955\n0, 1381, 715\n0, 0, 1.0\n")
    (tmp_path / "poses.csv").write_text("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n")
    logs = [f"left={tmp_path}/odometry.csv", f"right={tmp_path}/camera_matrix.csv"]
    left, right = lenses_of(tmp_path, logs, (1920, 1440)).cameras
    np.testing.assert_allclose(left.K, [[1401, 0, 950], [0, 1401, 725], [0, 0, 1]])
    np.testing.assert_allclose(right.K, [[1380, 0, 955], [0, 1381, 715], [0, 0, 1]])
    for log, size, said in (
        (
            "odometry",
            (1440, 1920),
            "pictures of about 1900 x 1450 pixels, but those of camera left",
        ),
        ("poses", (1920, 1440), "has no intrinsics, columns fx fy cx cy; give degrees"),
        ("no", (1920, 1440), "no such file"),
    ):
        with pytest.raises(InputError, match=rf"{log}\.csv: .*{said}"):
            lenses_of(tmp_path, [f"left={tmp_path}/{log}.csv", "right=65"], size)


def test_lenses_by_a_photo(tmp_path):
    """Of film's 36 x 24 mm a lens of 28 mm sees 75.4 degrees along the diagonal, whatever the
    picture's shape.
    """
    image = pytest.importorskip("PIL.Image", reason='needs pip install "shapepose-fg[photos]"')
    for name in ("left_json", "right_json"):
        (tmp_path / name).mkdir()
    exif = image.Exif()
    exif[0x8769] = {0xA405: 28}
    image.new("RGB", (400, 300)).save(tmp_path / "phone.jpg", exif=exif)
    image.new("RGB", (400, 300)).save(tmp_path / "bare.jpg")
    (tmp_path / "torn.jpg").write_bytes((tmp_path / "phone.jpg").read_bytes()[:40])
    along = 250 / np.tan(np.arctan(np.hypot(36, 24) / 2 / 28))  # pixels of the photo
    for size in ((1920, 1080), (1080, 1920)):
        rig = lenses_of(tmp_path, [str(tmp_path / "phone.jpg"), "right=60"], size)
        np.testing.assert_allclose(rig.focal_px[0], along / 400 * 1920)
    for name, said in (
        ("bare", "data have no FocalLengthIn35mmFilm"),
        ("torn", "cannot be read"),
        ("no", "no such file"),
    ):
        with pytest.raises(
            InputError, match=rf"{name}\.jpg: .*{said}.*; give an unedited photo of the camera"
        ):
            lenses_of(tmp_path, [str(tmp_path / f"{name}.jpg")], (640, 480))


@pytest.mark.slow
def test_the_command_writes_a_rig_or_says_why_not(rig, recording, tmp_path, capsys):
    """Of three cameras; the others place four."""
    three = only(recording, lambda view, t: view < 3)
    rig = rig.without(["cam3"])
    write_openpose(three, rig, tmp_path / "seen")
    write_rig(rig, tmp_path / "lenses.json")
    base = [
        "calibrate",
        "--detections",
        tmp_path / "seen",
        "--fps",
        25,
        "--output",
        tmp_path / "new.json",
    ]

    def run(*more):
        with pytest.raises(SystemExit) as ended:
            main([str(each) for each in [*base, *more]])
        said = capsys.readouterr()
        return ended.value.code, said.out, " ".join(said.err.split())

    code, out, _ = run("--calibration", tmp_path / "lenses.json", "--frames", "0:125")
    assert (
        code == 0
        and "next: shapepose-fg reconstruct" in out
        and "scale: assumed median stature 1.70 m" in out
    )
    assert off_after_growing(read_rig(tmp_path / "new.json"), rig)[0].max() < 0.25
    (tmp_path / "new.json").unlink()
    code, out, error = run("--calibration", tmp_path / "lenses.json", "--frames", "0:10")
    assert (
        code == 1
        and "cameras cam0 cam1 cam2: at least 3 s of a person" in error
        and not (tmp_path / "new.json").exists()
    )
    degrees = [np.degrees(2 * np.arctan(c.image_size[0] / 2 / c.K[0, 0])) for c in rig.cameras]
    fields = [
        f"--field-of-view={name}={each:.1f}" for name, each in zip(rig.names, degrees, strict=True)
    ]
    size = "x".join(map(str, rig.cameras[0].image_size))
    away = np.linalg.norm(rig.centres[0] - rig.centres[2])
    more = (f"--distance=cam0,cam2={2 * away:.3f}", "--report", tmp_path / "page.html", "--json")
    code, out, error = run(*fields, "--image-size", size, "--focal", *more)
    told = json.loads(out)
    assert code == 0 and len(told["cameras"]) == 3 and told["floor_found"]
    # The room is twice as large as it was: people are taller than anybody.
    turn, _, grown = off_after_growing(read_rig(tmp_path / "new.json"), rig)
    assert turn.max() < 0.5 and grown == pytest.approx(2, rel=0.03) and 3 < told["stature_m"] < 4
    assert "m; if they are adults, measure the distance of the cameras again" in error
    assert "median stature of people is 3." in (tmp_path / "page.html").read_text("utf-8")
    lenses = ("--calibration", tmp_path / "lenses.json")
    for more, said in (
        (["--distance=cam0=3"], "give two cameras and metres, such as cam0,cam1=3.42"),
        (["--distance=cam0,cam2=-1"], "must be 0.05 to 1000 metres"),
    ):
        code, _, error = run(*lenses, *more)
        assert code == 2 and said in error
    code, _, error = run()
    assert code == 2 and "the focal lengths are needed; give one of them" in error


@pytest.mark.slow
def test_the_cameras_of_shelf(shared_data):
    rig = read_rig(shared_data / "shelf" / "calibration.json")
    recording = read_detections(shared_data / "shelf", rig)
    times = FrameTimes.from_fps(25.0, len(recording))
    found = calibrate(recording, unposed(rig), times, range(len(recording)))
    turn, move, grown = off_after_growing(found.rig, rig)
    # Measured: 0.26 degrees and 21 mm; Shelf's own calibration is no better known than that.
    assert np.median(turn) < 0.35 and np.median(move) < 0.03
    assert abs(grown - 1) < 3 * found.world.sigma_scale


def test_a_guessed_lens_has_the_prior_of_published_ones():
    """Root mean squares of the table of phones' lenses, to a fifth."""
    page = Path(__file__).parents[2] / "docs" / "evaluation" / "cameras.md"
    table = page.read_text(encoding="utf-8").partition("**Published lenses**")[2]
    rows = [line.split("|")[2:5] for line in table.split("\n\n")[1].splitlines()[2:]]
    along, across, bent = (
        np.array([each for each in c if each.strip()], float) for c in zip(*rows, strict=True)
    )
    assert pytest.approx(0.01 * np.sqrt(np.mean(np.r_[along, across] ** 2)), rel=0.2) == _CENTRE_OFF
    assert pytest.approx(np.sqrt(np.mean(bent**2)), rel=0.2) == _BENT
