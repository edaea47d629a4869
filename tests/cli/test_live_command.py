"""`shapepose-fg live`: lines of detections in, lines of people out."""

import json

import numpy as np
import pytest

from shapepose_fg.cli.main import main
from shapepose_fg.io.calibration import write_rig


@pytest.fixture
def cameras(tmp_path, five_cameras):
    write_rig(five_cameras, tmp_path / "calibration.json")
    return str(tmp_path / "calibration.json")


def lines(rig, people, frames: int) -> str:
    """What an OpenPose of each camera would write of people who stand still, 10 pictures a second."""
    xy, _ = rig.project(people)
    rng, written = np.random.default_rng(0), []
    for frame in range(frames):
        for view, name in enumerate(rig.names):
            noisy = xy[view] + rng.normal(0, 1, xy[view].shape)
            flat = np.concatenate([noisy, np.full((*noisy.shape[:2], 1), 0.9)], axis=-1).reshape(len(people), -1)
            seen = [{"pose_keypoints_2d": each.tolist()} for each in flat]
            written.append(json.dumps({"camera": name, "time_s": frame / 10, "people": seen}))
    return "\n".join(written) + "\n"


def test_people_come_out_as_lines(tmp_path, cameras, five_cameras, two_people):
    (tmp_path / "in.jsonl").write_text(lines(five_cameras, two_people, 8))
    given = ["live", "--calibration", cameras, "--detections", str(tmp_path / "in.jsonl"), "--workers", "1"]
    with pytest.raises(SystemExit) as ended:
        main([*given, "--output", str(tmp_path / "out.jsonl")])
    assert ended.value.code == 0
    told = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    now, settled = ([each for each in told if each["kind"] == kind] for kind in ("now", "settled"))
    assert [each["time_s"] for each in now] == pytest.approx(np.arange(8) / 10)
    assert [each["time_s"] for each in settled] == pytest.approx(np.arange(8) / 10)
    for frame in (now[-1], settled[4]):
        assert [person["person"] for person in frame["people"]] == [0, 1]
        joints = np.array([person["joints"] for person in frame["people"]])
        order = np.argsort(joints[:, :, 0].mean(axis=1))
        # Pixels are good to 1; a pixel is some 4 mm, of five views.
        assert np.linalg.norm(joints[order] - two_people, axis=-1).mean() < 0.01


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("{", "standing.jsonl, line 1: line 1 column 2 is not JSON"),
        ('{"camera": "9", "time_s": 0, "people": []}', "there is no camera 9"),
        ('{"camera": "CAM", "people": []}', "time_s is missing"),
        ('{"camera": "CAM", "time_s": 0, "people": [{"pose_keypoints_2d": [1, 2]}]}', "75 numbers a person"),
    ],
)
def test_a_line_that_is_none_is_named(tmp_path, cameras, five_cameras, capsys, line, said):
    file = tmp_path / "standing.jsonl"
    file.write_text(line.replace("CAM", five_cameras.names[0]) + "\n")
    with pytest.raises(SystemExit) as ended:
        main(["live", "--calibration", cameras, "--detections", str(file), "--workers", "1"])
    assert ended.value.code == 2
    told = " ".join(capsys.readouterr().err.split())
    assert said in told and "line 1" in told and "Traceback" not in told
