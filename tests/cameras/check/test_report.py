"""What is printed and stored of a check: figures by camera and pair, sentences, the command,
run.json.
"""

import json

import numpy as np
import pytest

from shapepose_fg.cameras.check import report as reports
from shapepose_fg.cameras.check.findings import Finding, Kind, sentence
from shapepose_fg.cameras.check.report import Distances, camera_use, check_setup, result_check
from shapepose_fg.cli.main import main
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.frame_times import FrameTimes, spans_of
from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Known, Reconstruction, Status
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.write_detections import write_openpose
from tests.cameras.check.spoiled_setups import turned, zoomed


@pytest.fixture(scope="module")
def files(tmp_path_factory, room, recording):
    """The recording as a user has it: a rig file and OpenPose's JSON."""
    folder = tmp_path_factory.mktemp("recording")
    write_rig(room, folder / "rig.json")
    write_openpose(recording, room, folder / "openpose")
    return folder


def run(arguments, capsys):
    """Exit code, stdout and stderr of a command."""
    with pytest.raises(SystemExit) as ended:
        main([str(each) for each in arguments])
    said = capsys.readouterr()
    return ended.value.code, said.out, said.err


@pytest.mark.slow
def test_figures_of_a_good_set_up(sound):
    assert sound.findings == () and sound.warnings == () and sound.notes == ()
    for each in sound.cameras:
        # 2 px along each axis are 2.35 px in the median; triangulation takes a part, leaving out
        # adds one.
        assert 1.5 < each.median_px < 2.4 < each.left_out_px < 4.5
        # At 4 to 5 m and 900 px a pixel is 4 to 6 mm.
        assert 4 < each.median_mm / each.median_px < 6.5
        assert each.left_out_matched > 0.95 and each.late_frames == 0
    assert all(pair.matched > 0.95 and pair.miss_px < 3 for pair in sound.pairs)
    assert len(sound.pairs) == 10


@pytest.mark.slow
def test_the_bad_camera_stands_out_in_the_figures(recording, room):
    report = check_setup(recording, turned(room, 2, 30, np.array([0.0, 1.0, 0.0])))
    fits = [each.left_out_matched for each in report.cameras]
    assert np.argmin(fits) == 2 and fits[2] < 0.1 < 0.9 < np.median(fits)
    with_it = [pair.matched for pair in report.pairs if "cam2" in (pair.first, pair.second)]
    without = [pair.matched for pair in report.pairs if "cam2" not in (pair.first, pair.second)]
    # Two cameras whose rays stay in one plane agree whatever the turn.
    assert np.median(with_it) < 0.3 < 0.9 < min(without)
    stored = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert stored["findings"][0]["kind"] == "turned" and stored["findings"][0]["cameras"] == [
        "cam2"
    ]


@pytest.mark.parametrize("kind", list(Kind))
def test_every_kind_has_a_sentence(room, kind):
    pair = kind in (Kind.EXCHANGED, Kind.DUPLICATE)
    words = sentence(Finding(kind, (0, 1) if pair else (0,), 2.0, ((3.0, -4.0),), axis="y"), room)
    assert words[0] == "c" or words[0].isupper()
    assert not words.endswith(".") and "nan" not in words and len(words) > 30


@pytest.mark.slow
def test_the_command_says_it_in_words(files, room, capsys, monkeypatch, once):
    monkeypatch.setattr(reports, "check_setup", once(check_setup))
    options = ["--detections", files / "openpose", "--frames", "0:40"]
    code, out, _ = run(["check-calibration", "--calibration", files / "rig.json", *options], capsys)
    assert code == 0 and "No problems were found" in out
    assert all(len(line) <= 80 for line in out.splitlines())
    write_rig(zoomed(room, 1, 2.0), files / "zoomed.json")
    code, out, _ = run(
        ["check-calibration", "--calibration", files / "zoomed.json", *options], capsys
    )
    assert (
        code == 1
        and "cam1 has a focal length in the calibration that appears to be 2 times"
        in " ".join(out.split())
    )
    options = ["--calibration", files / "zoomed.json", *options, "--json"]
    code, out, _ = run(["check-calibration", *options], capsys)
    assert code == 1 and json.loads(out)["findings"][0]["kind"] == "focal length"


@pytest.mark.slow
def test_reconstruct_warns_and_stores_it(files, room, tmp_path, capsys):
    write_rig(Rig(room.cameras, "y"), files / "up.json")
    options = [
        "--detections",
        files / "openpose",
        "--frames",
        "0:8",
        "--output",
        tmp_path / "out",
        "--workers",
        1,
    ]
    code, out, err = run(["reconstruct", "--calibration", files / "up.json", *options], capsys)
    assert code == 0 and "--up z" in err.replace("\n", " ")
    stored = json.loads((tmp_path / "out" / "run.json").read_text())
    assert [each["kind"] for each in stored["setup"]["findings"]] == ["up axis"]
    for each in stored["cameras"]:
        assert 0 < each["used"] <= each["offered"]
        assert each["given"]["median_px"] < 3 and each["left_out"]["median_px"] < 5
    assert "left out px" in out
    code, out, err = run(
        ["reconstruct", "--calibration", files / "up.json", *options, "--no-check", "--overwrite"],
        capsys,
    )
    assert (
        code == 0
        and "warning" not in err
        and "setup" not in json.loads((tmp_path / "out" / "run.json").read_text())
    )


def test_what_became_of_each_camera_s_detections(room, recording, people):
    """One person in one frame: camera 1 saw the joints 12 px beside, and they were not used."""
    joints = people[:1, 0]
    xy = np.moveaxis(room.project(joints)[0], 0, 2)
    xy[:, :, 1, 0] += 12.0
    gate = np.full(xy.shape[:3], Gate.USED, dtype=np.uint8)
    gate[:, :, 1] = Gate.TOO_FAR
    first = np.zeros(1, dtype=np.int64)
    table = ObservationTable(
        frame=first,
        person=first,
        joint_names=np.array([f"j{n}" for n in range(25)]),
        view_names=np.array(room.names),
        candidate=np.full(gate.shape, -1, dtype=np.int32),
        xy=xy.astype(np.float32),
        confidence=np.full(gate.shape, 0.8, dtype=np.float32),
        residual_px=(np.moveaxis(room.project(joints)[0], 0, 2) - xy).astype(np.float32),
        gate=gate,
    )
    result = result_of(joints, table)
    uses = camera_use(result, recording, room, range(1))
    depth = np.median(room.project(joints)[1][1])
    assert uses[1].used == 0 and uses[0].used == 25
    assert uses[1].given.median_px == pytest.approx(12, abs=1e-3)
    assert uses[1].left_out.median_px == pytest.approx(12, abs=0.01)
    assert uses[1].given.median_mm == pytest.approx(1e3 * 12 * depth / room.focal_px[1], rel=0.01)
    assert uses[1].after_gates == Distances(0, None, None, None, None)
    assert uses[0].left_out.median_px == pytest.approx(0, abs=0.01)


def result_of(joints: np.ndarray, table: ObservationTable) -> Reconstruction:
    """A result with one row of `joints` (1, J, 3) and no body."""
    J = joints.shape[1]
    return Reconstruction(
        frame=table.frame,
        person=table.person,
        joint_names=table.joint_names,
        joints=joints,
        covariance=np.full((1, J, 3, 3), np.nan),
        confidence=np.full((1, J), 0.8),
        betas=np.full((1, 10), np.nan),
        global_orient=np.full((1, 3), np.nan),
        body_pose=np.full((1, 23, 3), np.nan),
        transl=np.full((1, 3), np.nan),
        status=np.array(["body undetermined"]),
        observations=table,
    )


def test_frames_as_spans():
    assert spans_of([5, 3, 4, 9, 9]) == [range(3, 6), range(9, 10)]
    assert spans_of([]) == []


@pytest.mark.slow
@pytest.mark.parametrize("temporal", [True, False])
def test_speeds_need_identities(recording, room, sound, temporal):
    """Frame by frame numbers of people are no identities: whoever is number 0 next may stand
    anywhere.
    """
    N = 80
    joints = np.zeros((N, 25, 3))
    joints[::2, :, 0] = 1.3  # 1.3 m and back in a thirtieth of a second
    people = Reconstruction(
        frame=np.arange(N),
        person=np.zeros(N, dtype=int),
        joint_names=np.array(BODY_25.joints),
        joints=joints,
        covariance=np.tile(4e-4 * np.eye(3), (N, 25, 1, 1)),
        confidence=np.ones((N, 25)),
        known=np.full((N, 25), Known.SEEN),
        betas=np.zeros((N, 10)),
        global_orient=np.zeros((N, 3)),
        body_pose=np.zeros((N, 23, 3)),
        transl=np.zeros((N, 3)),
        status=np.full(N, str(Status.OK)),
        time_s=np.arange(N) / 30,
        run={"configuration": {"temporal": temporal}, "time": FrameTimes.from_fps(30, N).as_dict()},
    )
    warnings = result_check(sound, people, recording, room, range(len(recording))).warnings
    assert any("people move at 39 m/s" in each for each in warnings) == temporal
