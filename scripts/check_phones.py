"""Measure calibration with phones: simulated rooms, filmed by phones that were started by hand.

    python scripts/check_phones.py --rooms 0:6

The rooms are those of tests/calibration/filmed_by_phones.py; people walk as in the recorded motions
of `--data FOLDER` (or SHAPEPOSE_DATA). The commands are told 65 degrees, --focal and one distance.
Run it from a clone. docs/evaluation/cameras.md has the results. About three minutes
per room on one core.
"""

import argparse
import contextlib
import io
import json
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from shapepose_fg.cli.main import main as command
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.rig_file import write_trajectory
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.recording import read_recording
from shapepose_fg.io.timestamps import write_timestamps
from shapepose_fg.io.write_detections import write_association
from shapepose_fg.pipeline.pipeline import refine_trajectories
from shapepose_fg.simulation.mocap import Mocap
from tests.calibration.filmed_by_phones import errors, film, odometry, similarity


def measure(room: int, mocap: Mocap, folder: Path) -> dict[str, object]:
    """Film a room, type the commands, and compare the result with the truth."""
    phones, recording = film(room, mocap)
    rng, fixed = np.random.default_rng([room, 46]), phones[:-1]
    names, truth = [each.camera.name for each in phones], Rig(tuple(p.camera for p in fixed), "z")
    write_association(recording, Rig(tuple(each.camera for each in phones), "z"), folder)
    own = np.column_stack([each.time_s - each.time_s[0] for each in phones])
    write_timestamps(folder / "detection" / "times.csv", names, own)
    write_trajectory(odometry(phones[-1], rng), folder / "log.tum")
    far = np.linalg.norm(truth.centres[0] - truth.centres[1]) + rng.normal(0, 0.01)
    words = ["--detections", folder / "detection", "--field-of-view", "65", "--focal", "--json"]
    words += ["--image-size", "{}x{}".format(*fixed[0].camera.image_size)]
    words += ["--distance", f"phone1,phone2={far:.2f}", "--times", folder / "times.csv"]
    words += ["--trajectory", f"{names[-1]}={folder / 'log.tum'}"]
    said, rig_file = io.StringIO(), folder / "found.json"
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        command(["calibrate", *map(str, words), "--output", str(rig_file)])
    found: dict[str, object] = {"room": room, "people": 1 + room % 2}
    if not rig_file.exists():
        return found | {"refused": True}
    rig, cameras = read_rig(rig_file), json.loads(said.getvalue())["cameras"]
    by = similarity(rig.only(names[:-1]), truth)
    turn, move = errors(rig.wTc[:-1], truth.wTc, by)
    sigma = np.array([each["sigma_turn_deg"] for each in cameras]) / np.sqrt(3)
    found |= {"deg": turn.round(2).tolist(), "mm": move.round().tolist()}
    found |= {"inside": int((turn < np.sqrt(7.815) * sigma).sum()), "scale": round(by[2], 4)}
    recording, times = read_recording(
        folder / "detection", rig, None, folder / "kept", timestamps=folder / "times.csv"
    )
    assert times is not None
    # Number of frames in which the carried phone is refined.
    span = range(len(recording) // 3, len(recording) // 3 + 250)
    begin, end = times.frame_s[[span.start, span.stop]]
    frame_s = np.genfromtxt(folder / "times.csv", delimiter=",", skip_header=1)[:, -1]
    used = (frame_s > begin) & (frame_s < end)
    refined = refine_trajectories(recording, rig, frames=span, times=times)
    for name, each in (("start", rig), ("refined", refined)):
        poses = each.trajectories[0].at(frame_s[used]) @ each.cameras[-1].bTc
        figures = errors(poses, phones[-1].wTc[used], by)
        found[name] = [round(float(np.sqrt((figure**2).mean())), 2) for figure in figures]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    given = os.environ.get("SHAPEPOSE_DATA", Path(__file__).parents[2] / "shared")
    parser.add_argument("--rooms", default="0:6", help="which rooms, first:stop")
    parser.add_argument("--data", type=Path, default=given)
    arguments = parser.parse_args()
    mocap = Mocap.load(arguments.data / "data" / "cmu_mocap" / "cmu_smpl24.npz")
    for room in range(*map(int, arguments.rooms.split(":"))):
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(measure(room, mocap, Path(folder))), flush=True)


if __name__ == "__main__":
    main()
