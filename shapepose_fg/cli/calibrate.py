"""The command `calibrate`: estimates camera poses from walking people."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import typer

from shapepose_fg.cli.found_cameras import (
    MOST_S,
    Most,
    from_zero,
    report_option,
    show_clocks,
    write_page,
)
from shapepose_fg.cli.options import (
    INPUT,
    REQUIRED,
    RESULT,
    TIME,
    RateOptions,
    SeenOptions,
    Stature,
    check_output_files,
    chosen_cameras,
    grouped,
    json_option,
    next_reconstruct,
    option,
    picture_size,
)
from shapepose_fg.cli.terminal import note, progress, show, show_json, table
from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from shapepose_fg.cameras.bundle import Freedom
    from shapepose_fg.cameras.calibrate.from_people import Calibrated
    from shapepose_fg.cameras.moving import Start
    from shapepose_fg.core.arrays import Array
    from shapepose_fg.core.camera import Rig
    from shapepose_fg.io.detection_table import DetectionTable

_CAMERAS = "Prior knowledge"
_FILE_OFF, _GUESS_OFF, _CENTRE_OFF, _BENT = 0.02, 0.2, 0.006, 0.04
"""Relative prior standard deviations of focal lengths from a calibration, and from a field of view;
of the principal point of a lens without calibration, as a share of the longer side; and of the
distortion k1 of a phone's main lens, whose log does not have it. The last two are root mean squares
of published lenses (docs/evaluation/cameras.md)."""


@dataclass(frozen=True, kw_only=True)
class LensOptions(SeenOptions):
    """Options: 2D detections, and the lenses of the cameras."""

    calibration: Path | None = option(
        INPUT, "Calibration with the intrinsics; poses in it are ignored."
    )
    field_of_view: list[str] | None = option(
        INPUT,
        "Instead of a calibration: field of view along the longer side of a picture in degrees, "
        "a photo with EXIF, or a phone's log with its lens; of one camera: CAMERA=...",
        metavar="DEG",
    )
    image_size: str | None = option(INPUT, "Picture size, if no file contains it.", metavar="WxH")
    cameras: str | None = option(INPUT, "Use only these cameras.", metavar="A,B")
    without: str | None = option(INPUT, "Leave out these cameras.", metavar="A,B")

    def rig(self, trajectories: Sequence[str]) -> "tuple[Rig, set[str]]":
        """The cameras without poses, and the names of those whose lenses are guessed; InputError if
        lenses are unknown. `trajectories` are CAMERA=FILE: a log with intrinsics gives the lens.
        """
        from shapepose_fg.io.calibration import read_rig
        from shapepose_fg.io.footage.places import per_camera
        from shapepose_fg.io.lenses import is_log, lenses_of
        from shapepose_fg.io.trajectories import read_log_lens

        if (self.calibration is None) == (self.field_of_view is None):
            raise InputError(
                "--calibration, --field-of-view: the focal lengths are needed; give one of them"
            )
        size, guessed = picture_size(self.image_size), set[str]()
        if self.calibration is not None:
            rig = read_rig(self.calibration, up="z", unit="m", image_size=size)
        else:
            fields = list(self.field_of_view or [])
            named = {each.partition("=")[0] for each in fields}
            for each in trajectories:
                name, _, file = each.partition("=")
                lacks = is_log(file) and name not in named and Path(file).is_file()
                fields += [each] if lacks and read_log_lens(Path(file)) is not None else []
            rig = lenses_of(self.detections, fields, size)
            given = per_camera("--field-of-view", fields, rig.names, one_for_all=True)
            guessed = {n for n, each in zip(rig.names, given, strict=True) if not is_log(each)}
        note(*rig.notes)
        rig = rig.only(chosen_cameras(rig.names, self.cameras, self.without))
        if len(rig) < 2:
            raise InputError(f"{self.detections}: at least 2 cameras are needed, got {len(rig)}")
        return rig, guessed


@grouped
def calibrate(
    seen: LensOptions,
    rate: RateOptions,
    focal: bool = option(
        _CAMERAS,
        "Refine focal lengths; prior sigma 2 % from a calibration, 20 % from a field of view.",
        False,
    ),
    stature: Stature | None = option(
        _CAMERAS, "Median stature of the people, metres; by default 1.70, of adults."
    ),
    distance: list[str] | None = option(
        _CAMERAS,
        "Distance between two cameras in metres; it determines the scale.",
        metavar="CAM,CAM=M",
    ),
    trajectory: list[str] | None = option(
        INPUT,
        "Log of a camera that moves (TUM, CSV, ARKit, ARCore); its start is found from the people.",
        metavar="CAMERA=FILE",
    ),
    tolerance: str = option(
        _CAMERAS,
        "Largest error of the poses of a camera that moves (95 %); a worse one is refused.",
        "0.6,25",
        metavar="DEG,MM",
    ),
    output: Path = option(RESULT, "File for the cameras.", REQUIRED),
    form: Literal["rig", "pose2sim"] = option(
        RESULT, "Format of the file: rig (JSON), or Pose2Sim's TOML.", "rig", "--format"
    ),
    times: Path | None = option(
        TIME,
        (
            "File for the times of all frames; estimate the start times of unsynchronised cameras, "
            "too."
        ),
    ),
    most: Most = option(TIME, "Largest offset between cameras for --times, seconds.", MOST_S),
    report: Path | None = report_option(),
    as_json: bool = json_option(),
) -> None:
    """Estimate camera poses from the people in the recording; lenses must be known or guessed.

    Film for a minute with fixed cameras whose views overlap. One person or more walk through all
    views, near and far, not along one line, and move their arms. Exit code 1 if this does not
    determine the cameras; then nothing is written.
    """
    from shapepose_fg.cameras.bundle import Freedom
    from shapepose_fg.cameras.calibrate.from_people import Undetermined, calibrate
    from shapepose_fg.cameras.calibrate.levelling import Measured
    from shapepose_fg.cameras.calibrate.unsynchronised import calibrate_unsynchronised
    from shapepose_fg.core.frame_times import rate_of
    from shapepose_fg.io.calibration import with_trajectories, write_pose2sim, write_rig
    from shapepose_fg.io.recording import own_times
    from shapepose_fg.io.timestamps import write_timestamps

    within = _within(tolerance)
    check_output_files({"--output": output, "--times": times, "--report": report})
    if times is not None and rate.timestamps is not None:
        raise InputError(
            "--times and --timestamps: times are either estimated or given; give one of them"
        )
    whole, guessed = seen.rig(trajectory or [])
    whole = with_trajectories(whole, trajectory or [])
    if form == "pose2sim" and whole.moves:
        raise InputError("--format pose2sim: cannot hold --trajectory; write a rig file")
    guess = Freedom(
        focal=focal * _GUESS_OFF, centre_px=_CENTRE_OFF * float(whole.image_sizes.max())
    )
    known = Freedom(focal=focal * _FILE_OFF * (seen.calibration is not None))
    rig = whole.without([camera.name for camera in whole.cameras if camera.carrier])
    lenses = {name: guess if name in guessed else known for name in whole.names}
    lens = [lenses[name] for name in rig.names]
    if len(rig) < 2:
        raise InputError(f"--trajectory: at least 2 cameras must stand still, got {len(rig)}")
    measured = Measured(stature, _distances(distance or [], rig.names))
    with tempfile.TemporaryDirectory(prefix="shapepose-fg-") as folder:
        part = rate.part(
            seen.detections, seen.skeleton, rig, Path(folder), own_frames=times is not None
        )
        recording, known, span = part
        fps, clocks = rate_of(known.frame_s), None
        time_s = own_times(recording, known, len(rig))
        time_s = time_s if times is None else from_zero(time_s)
        try:
            with progress("calibrating", "steps") as done:
                if times is None:
                    found = calibrate(recording, rig, known, span, lens, measured, done)
                else:
                    found, clocks = calibrate_unsynchronised(
                        recording, rig, fps, span, most, lens, measured, done, time_s=time_s
                    )
            time_s = time_s if clocks is None else clocks.of_views(time_s)
            whole, time_s, starts = _with_moving(
                whole,
                found,
                recording,
                time_s,
                seen,
                rate,
                0.0 if times is None else most,
                lenses,
            )
        except Undetermined as error:
            note(*error.problems, f"{output} is not written: the cameras are not determined")
            raise typer.Exit(1) from None
    note(*found.notes)
    refused = [each for name, start in starts.items() if (each := start.refusal(name, *within))]
    if refused:
        output = output.with_name(f"{output.stem}.refused{output.suffix}")
        times = times and times.with_name(f"{times.stem}.refused{times.suffix}")
    (write_pose2sim if form == "pose2sim" else write_rig)(whole, output)
    if times is not None and clocks is not None:
        write_timestamps(times, whole.names, time_s)
    if refused:
        kept = f"--calibration {output}" + f" --timestamps {times}" * (clocks is not None)
        note(*refused, f"they are kept, so that they can be accepted: {kept}")
        raise typer.Exit(1)
    heads, rows = _figures(found, focal)
    lines = [_CAPTION, *_world(found, stature, distance or [])]
    people = found.adjusted.people
    write_page(
        report,
        rig=found.rig,
        points=people.points,
        frame=people.frame,
        # Frame sets of an estimated clock start at time 0.
        time_s=known.frame_s
        if clocks is None
        else np.arange(people.frame.max(initial=0) + 1) / fps,
        skeleton=recording.skeleton,
        heads=heads,
        rows=rows,
        missed_px={"joint, px": found.missed_px},
        lines=lines,
        remarks=found.notes,
    )
    if as_json:
        content = found.as_dict() | (
            {} if clocks is None else {"clocks": clocks.as_dict(rig)["cameras"]}
        )
        content |= {"moving": {name: each.as_dict() for name, each in starts.items()}}
        show_json(content)
    else:
        show(table(("camera", *heads), [(name, *each) for name, each in rows], caption=_CAPTION))
        show("\n".join(lines[1:]))
        given = rate.given()
        if times is not None and clocks is not None:
            show_clocks(clocks, rig)
            print(f"{times}: times of {len(recording)} frames")
            given = {"--timestamps": times}
        print(f"{output}: {'rig file' if form == 'rig' else 'Pose2Sim'}")
        options = {
            "--calibration": output,
            "--detections": seen.detections,
            "--skeleton": seen.skeleton,
        }
        print(next_reconstruct(options | given | {"--output": "results"}))


def _with_moving(
    whole: "Rig",
    found: "Calibrated",
    recording: "DetectionTable",
    time_s: "Array",
    seen: LensOptions,
    rate: RateOptions,
    most: float,
    lenses: "dict[str, Freedom]",
) -> "tuple[Rig, Array, dict[str, Start]]":
    """The rig `whole` with the fixed cameras as calibrated in `rig`, and with moving ones, whose
    start is found, with the freedom of their `lenses`; the times (T, V) of frames, from 0 on; and
    the starts of the moving ones.

    `time_s` (T, W) are the times of the fixed cameras' frames.
    """
    from shapepose_fg.cameras.moving import Filmed, Placed
    from shapepose_fg.core.camera import Rig
    from shapepose_fg.io.calibration import with_first_poses
    from shapepose_fg.io.recording import own_times

    rig = found.rig
    cameras = dict(zip(rig.names, rig.cameras, strict=True))
    columns = dict(zip(rig.names, time_s.T, strict=True))
    trajectories = {each.name: each for each in whole.trajectories}
    placed, starts, bent = None, dict[str, "Start"](), _BENT * (seen.calibration is None)
    for name in trajectories:
        given = whole.only([name])
        if placed is None:
            fixed = whole.only(rig.names)
            placed = Placed.by_cameras(recording, fixed, found.adjusted, time_s)
        with tempfile.TemporaryDirectory(prefix="shapepose-fg-") as folder:
            own, known, _ = rate.part(seen.detections, seen.skeleton, given, Path(folder), True)
            own_s = own_times(own, known, 1)[:, 0]
            odometry = trajectories[name].from_start(own_s)
            filmed = Filmed.of(own, given.cameras[0], odometry, own_s)
            lens = replace(lenses[name], lens=bent)
            starts[name] = start = filmed.started(placed, most, lens, found.world.sigma_scale)
        cameras[name], trajectories[name] = start.of(given.cameras[0], odometry)
        columns[name] = own_s + start.offset_s
        note(start.words(name))
    length = max(map(len, columns.values()))
    time_s = np.column_stack(
        [np.r_[columns[name], np.full(length - len(columns[name]), np.nan)] for name in whole.names]
    )
    begin = np.nanmin(time_s) if most > 0 else 0.0
    moving = tuple(replace(each, time_s=each.time_s - begin) for each in trajectories.values())
    moved = Rig(tuple(cameras[name] for name in whole.names), "z", trajectories=moving)
    return with_first_poses(moved), time_s - begin, starts


_CAPTION = (
    "±: one sigma of rotation and position, relative to the rig; shared: share of its people seen "
    "by another camera, too; "
    "halves: difference between its poses from the first and the second half of the recording"
)


def _figures(found: "Calibrated", focal: bool) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """The cameras with standard deviations: headings, and the values of each camera."""
    heads = ["people", "shared", "x y z, m", "± °", "± mm", "halves, °"] + ["focal, px"] * focal
    rows = []
    for each in found.as_dict()["cameras"]:
        place = " ".join(f"{value:.2f}" for value in each["centre_m"])
        figures = [
            str(each["people"]),
            f"{each['shared']:.0%}",
            place,
            f"{each['sigma_turn_deg']:.2f}",
        ]
        figures += [f"{each['sigma_move_mm']:.0f}", f"{each['halves_turn_deg']:.2f}"]
        figures += [f"{each['focal_px']:.0f} ± {each['sigma_focal_percent']:.1f} %"] * focal
        rows.append((each["camera"], figures))
    return heads, rows


def _world(found: "Calibrated", stature: float | None, distances: list[str]) -> list[str]:
    """Scale, up axis, fit, and how far to trust them, one line each."""
    from shapepose_fg.cameras.parameters import MOVE, TURN

    world = found.world
    if distances:
        source = f"{' '.join(distances)}, which makes people {world.stature_m:.2f} m tall (median)"
    else:
        source = (
            f"median stature {stature:g} m"
            if stature is not None
            else "assumed median stature 1.70 m"
        )
        source += f", {world.persons} people at once"
    level = (
        "from feet on the floor"
        if world.floor is not None
        else "from bodies, because no level floor was found"
    )
    turn, move = (float(found.adjusted.sigma(part).max()) for part in (TURN, MOVE))
    trust = (
        f"trust: rotations to {np.degrees(2 * turn):.1f} degrees, positions to "
        f"{2e3 * move:.0f} mm and all lengths to {200 * world.sigma_scale:.1f} % (two sigma, worst "
        "camera)"
    )
    better = "; a distance measured between two cameras, --distance, gives lengths to about 1 %"
    return [
        f"scale: {source}; one sigma is {100 * world.sigma_scale:.1f} %",
        f"up: z, {level}; the floor is at 0",
        (
            "error of a joint against the other cameras, on frames that were not used: "
            f"{found.held_out_px:.2f} px"
        ),
        trust + ("" if distances else better),
    ]


def _within(given: str) -> tuple[float, float]:
    """Tolerated errors of poses, degrees and metres."""
    try:
        degrees, mm = (float(each) for each in given.split(","))
    except ValueError:
        degrees = mm = np.nan
    if not (0 < degrees <= 180 and 0 < mm <= 1e5):
        raise InputError(
            f"--tolerance {given[:80]}: must be degrees and millimetres, such as 0.6,25"
        )
    return degrees, mm / 1e3


def _distances(given: list[str], names: Sequence[str]) -> tuple[tuple[int, int, float], ...]:
    """Pairs of cameras, and their distances in metres."""
    found = []
    for text in given:
        pair, _, number = text.rpartition("=")
        cameras = pair.split(",")
        if len(cameras) != 2 or cameras[0] == cameras[1] or not set(cameras) <= set(names):
            raise InputError(
                f"--distance {text}: give two cameras and metres, such as "
                f"{names[0]},{names[1]}=3.42; there are {' '.join(names)}"
            )
        try:
            metres = float(number)
        except ValueError:
            metres = np.nan
        if not 0.05 <= metres <= 1000:
            raise InputError(f"--distance {text}: must be 0.05 to 1000 metres")
        found.append((names.index(cameras[0]), names.index(cameras[1]), metres))
    return tuple(found)
