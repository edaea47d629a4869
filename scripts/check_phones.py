"""Measure calibration with phones: simulated rooms, filmed by phones that were started by hand.

    python scripts/check_phones.py --rooms 6:18
    python scripts/check_phones.py --rooms 6:18 --logs

The rooms are those of tests/cameras/filmed_by_phones.py; people walk as in the recorded motions of
`--data FOLDER` (or SHAPEPOSE_DATA). The command is given 65 degrees, --focal and one distance, or
with `--logs` the lenses that the phones have logged. It prints the rows of the table in
docs/evaluation/cameras.md: errors, and in brackets two standard deviations; the numbers of fixed
phones whose rotation and position are within theirs; for the carried phone the bound of its error
(95 %). Run it from a clone. About three minutes per room on one core.
"""

import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Option, Typer

sys.path.insert(0, str(Path(__file__).parent.parent))

from shapepose_fg.cli.main import main as command
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.rig_file import write_trajectory
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.footage.placement import (
    CameraFootage,
    Placement,
    PlacementKind,
    write_used_footage,
)
from shapepose_fg.io.timestamps import write_timestamps
from shapepose_fg.io.write_detections import write_association
from shapepose_fg.simulation.mocap import Mocap
from tests.cameras.filmed_by_phones import errors, film, odometry, similarity

HEAD = "| room | people | worst rotation | worst position | inside | scale | carried phone |"
LAYOUTS = ("four phones in the corners", "four upright phones", "three phones on one side")


def measure(room: int, mocap: Mocap, folder: Path, logs: bool) -> str:
    """Film a room, type the command, and compare the result with the truth: a row of the table."""
    phones, recording = film(room, mocap)
    rng, fixed = np.random.default_rng([room, 46]), phones[:-1]
    names, truth = [each.camera.name for each in phones], Rig(tuple(p.camera for p in fixed), "z")
    write_association(recording, Rig(tuple(each.camera for each in phones), "z"), folder)
    own = np.column_stack([each.time_s - each.time_s[0] for each in phones])
    write_timestamps(folder / "detection" / "times.csv", names, own)
    sizes, places = [2 * (each.camera.image_size,) for each in phones], np.arange(len(recording))
    used = [
        CameraFootage(name, folder, Placement(PlacementKind.SAME, *size), places)
        for name, size in zip(names, sizes, strict=True)
    ]
    write_used_footage(folder / "detection" / "footage.json", used, {})
    write_trajectory(odometry(phones[-1], rng), folder / "log.tum")
    distance = np.linalg.norm(truth.centres[:, None] - truth.centres, axis=-1)
    one, other = np.unravel_index(distance.argmax(), distance.shape)
    far = distance[one, other] + rng.normal(0, 0.01)
    words = ["--detections", folder / "detection", "--focal", "--tolerance", "180,100000", "--json"]
    for phone in phones:
        log, lens = folder / f"{phone.camera.name}.csv", phone.camera.K.tolist()
        log.write_text("\n".join(", ".join(map(str, row)) for row in lens))
        words += ["--field-of-view", f"{phone.camera.name}={log if logs else 65}"]
    words += [
        "--distance",
        f"{names[one]},{names[other]}={far:.2f}",
        "--times",
        folder / "times.csv",
    ]
    words += ["--trajectory", f"{names[-1]}={folder / 'log.tum'}"]
    printed, rig_file = io.StringIO(), folder / "found.json"
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        command(["calibrate", *map(str, words), "--output", str(rig_file)])
    row = f"| {LAYOUTS[room // 2 % 3]} | {1 + room % 2} |"
    if not rig_file.exists():
        return f"{row} refused | | | | |"
    rig, found = read_rig(rig_file), json.loads(printed.getvalue())
    by = similarity(rig.only(names[:-1]), truth)
    turn, move = errors(rig.wTc[:-1], truth.wTc, by)
    two_sigma = 2 * np.array(
        [(each["sigma_turn_deg"], each["sigma_move_mm"]) for each in found["cameras"]]
    )
    frame_s = np.genfromtxt(folder / "times.csv", delimiter=",", skip_header=1)[:, -1]
    poses = rig.trajectories[0].at(frame_s) @ rig.cameras[-1].bTc
    degrees, mm = (float((each**2).mean() ** 0.5) for each in errors(poses, phones[-1].wTc, by))
    carried = found["moving"][names[-1]]
    inside = (np.stack([turn, move]) < two_sigma.T).sum(axis=1)
    return (
        f"{row} {turn.max():.2f}° ({two_sigma[:, 0].max():.2f}) | {move.max():.0f} mm "
        f"({two_sigma[:, 1].max():.0f}) | {inside[0]}, {inside[1]} of {len(turn)} | "
        f"{100 * by[2] - 100:+.1f} % ({200 * found['sigma_scale']:.1f}) | "
        f"{degrees:.2f}° ({carried['within_deg']:.2f}), {mm:.0f} mm ({carried['within_mm']:.0f}) |"
    )


app = Typer(add_completion=False)


@app.command(help=__doc__)
def main(
    rooms: Annotated[str, Option(help="Which rooms, first:stop.")] = "0:6",
    logs: Annotated[bool, Option("--logs", help="Lenses from the phones' logs.")] = False,
    data: Annotated[Path, Option(envvar="SHAPEPOSE_DATA")] = Path(__file__).parents[2] / "shared",
) -> None:
    """Measure the rooms, and print a line for each."""
    mocap = Mocap.load(data / "data" / "cmu_mocap" / "cmu_smpl24.npz")
    print(HEAD)
    print("|---|---|---|---|---|---|---|")
    for room in range(*map(int, rooms.split(":"))):
        with tempfile.TemporaryDirectory() as folder:
            print(measure(room, mocap, Path(folder), logs), flush=True)


if __name__ == "__main__":
    app()
