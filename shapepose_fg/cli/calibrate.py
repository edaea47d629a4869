"""The command `calibrate`: poses of cameras from walking people."""

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import typer

from shapepose_fg.cli.found_cameras import MOST_S, check_most, report_option, show_clocks
from shapepose_fg.cli.options import (
    INPUT,
    REQUIRED,
    RESULT,
    TIME,
    RateOptions,
    grouped,
    json_option,
    names_of,
    next_reconstruct,
    option,
    picture_size,
)
from shapepose_fg.cli.terminal import note, progress, show, table
from shapepose_fg.core.errors import InputError, naming

if TYPE_CHECKING:
    from shapepose_fg.calibration.from_people import Calibrated
    from shapepose_fg.core.camera import Rig

_CAMERAS = "What is known"
_FILE_OFF, _GUESS_OFF = 0.02, 0.2
"""Prior standard deviations of focal lengths from a calibration, and from a field of view, as shares of them."""


@dataclass(frozen=True, kw_only=True)
class LensOptions:
    """2D detections, and the lenses of the cameras."""

    detections: Path = option(INPUT, "Folder with what a 2D detector wrote of every camera.", REQUIRED)
    skeleton: str | None = option(
        INPUT, "The detector's joints: a layout such as COCO_17, or a TOML file.", metavar="NAME"
    )
    calibration: Path | None = option(INPUT, "File of the lenses; its poses, if any, are not used.")
    field_of_view: list[str] | None = option(
        INPUT,
        "Without one: degrees from left to right, or a photo with EXIF; of one camera CAMERA=...",
        metavar="DEG",
    )
    image_size: str | None = option(INPUT, "Size of pictures where no file says it.", metavar="WxH")
    cameras: str | None = option(INPUT, "Only these cameras.", metavar="A,B")
    without: str | None = option(INPUT, "All cameras but these.", metavar="A,B")

    def rig(self) -> "Rig":
        """The cameras without poses; InputError where their lenses are unknown."""
        from shapepose_fg.core.camera import choose
        from shapepose_fg.io.calibration import read_rig
        from shapepose_fg.io.lenses import lenses_of

        if (self.calibration is None) == (self.field_of_view is None):
            raise InputError("--calibration or --field-of-view: one of them must say how wide the cameras see")
        size = picture_size(self.image_size)
        if self.calibration is not None:
            rig = read_rig(self.calibration, up="z", unit="m", image_size=size)
        else:
            rig = lenses_of(self.detections, self.field_of_view or [], size)
        note(*rig.notes)
        with naming("--cameras, --without"):
            rig = rig.only(choose(rig.names, names_of(self.cameras), names_of(self.without) or ()))
        if len(rig) < 2:
            raise InputError(f"{self.detections}: at least 2 cameras are needed, got {len(rig)}")
        return rig


@grouped
def calibrate(
    seen: LensOptions,
    rate: RateOptions,
    focal: bool = option(
        _CAMERAS, "Refine focal lengths: by 2 % of a calibration, 20 % of a field of view.", False
    ),
    stature: float | None = option(
        _CAMERAS, "People's median stature in metres; without it that of adults, 1.70."
    ),
    distance: list[str] | None = option(
        _CAMERAS, "Metres between the lenses of two cameras, which then say the scale.", metavar="CAM,CAM=M"
    ),
    output: Path = option(RESULT, "File for the cameras, our own JSON.", REQUIRED),
    times: Path | None = option(
        TIME, "Cameras were started by hand: find when, too, and write the times of all frames here."
    ),
    most: float = option(TIME, "With --times: seconds by which they were started apart, at most.", MOST_S),
    report: Path | None = report_option(),
    as_json: bool = json_option(),
) -> None:
    """Find where cameras stand by the people whom they see; lenses must be known, or guessed.

    Film a minute: cameras still, each sharing part of its picture with another; two or more people who walk
    through all views, near and far, arms raised at times, not on one line. Exit code 1 where that does not
    determine the cameras; nothing is written then.
    """
    from shapepose_fg.calibration.from_people import Undetermined, calibrate
    from shapepose_fg.calibration.levelling import Measured
    from shapepose_fg.calibration.unsynchronised import calibrate_unsynchronised
    from shapepose_fg.core.frame_times import rate_of
    from shapepose_fg.io.calibration import write_rig
    from shapepose_fg.io.recording import own_times
    from shapepose_fg.io.timestamps import write_timestamps

    if stature is not None and not 0.5 <= stature <= 2.5:
        raise InputError(f"--stature {stature:g}: must be 0.5 to 2.5 metres")
    check_most(most)
    if times is not None and rate.timestamps is not None:
        raise InputError("--times and --timestamps: when frames were taken is sought, or known; give one of them")
    off = 0.0 if not focal else _FILE_OFF if seen.calibration is not None else _GUESS_OFF
    rig = seen.rig()
    measured = Measured(stature, _distances(distance or [], rig.names))
    with tempfile.TemporaryDirectory(prefix="shapepose-fg-") as folder:
        part = rate.part(seen.detections, seen.skeleton, rig, Path(folder), own_frames=times is not None)
        recording, known, span = part
        fps, clocks = rate_of(known.frame_s), None
        try:
            with progress("calibrating", "steps") as done:
                if times is None:
                    found = calibrate(recording, rig, known, span, off, measured, done)
                else:
                    found, clocks = calibrate_unsynchronised(recording, rig, fps, span, most, off, measured, done)
        except Undetermined as error:
            note(*error.problems)
            raise typer.Exit(1) from None
    note(*found.notes)
    write_rig(found.rig, output)
    if times is not None and clocks is not None:
        write_timestamps(times, rig.names, clocks.of_views(own_times(recording, known, len(rig))))
    heads, rows = _figures(found, focal)
    lines = [_CAPTION, *_world(found, stature, distance or [])]
    if report is not None:
        from shapepose_fg.viz.report.cameras import CameraPage

        people = found.adjusted.people
        page = CameraPage(
            rig=found.rig,
            points=people.points,
            frame=people.frame,
            # Moments of one clock that was found begin at 0.
            time_s=known.frame_s if clocks is None else np.arange(people.frame.max(initial=0) + 1) / fps,
            skeleton=recording.skeleton,
            heads=heads,
            rows=rows,
            missed_px={"joint, px": found.missed_px},
            lines=lines,
            remarks=found.notes,
        )
        page.write(report)
        note(f"{report}: the cameras in 3D and the people, to be opened in a browser")
    if as_json:
        told = found.as_dict() | ({} if clocks is None else {"clocks": clocks.as_dict(rig)["cameras"]})
        print(json.dumps(told, indent=2, allow_nan=False))
    else:
        show(table(("camera", *heads), [(name, *each) for name, each in rows], caption=_CAPTION))
        print("\n".join(lines[1:]))
        given = rate.given()
        if times is not None and clocks is not None:
            show_clocks(clocks, rig)
            print(f"{times}: times of {len(recording)} frames")
            given = {"--timestamps": times}
        print(f"{output}: our own rig file")
        options = {"--calibration": output, "--detections": seen.detections, "--skeleton": seen.skeleton}
        print(next_reconstruct(options | given | {"--output": "results"}))


_CAPTION = (
    "± is one sigma, the rig's place and size aside; shared: of its people, seen by another camera too;"
    " halves: how far apart the two halves of the recording place it"
)


def _figures(found: "Calibrated", focal: bool) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """The cameras with standard deviations: headings, and each camera's figures."""
    heads = ["people", "shared", "x y z, m", "turn ± °", "place ± mm", "halves, °"] + ["focal, px"] * focal
    rows = []
    for each in found.as_dict()["cameras"]:
        place = " ".join(f"{value:.2f}" for value in each["centre_m"])
        figures = [str(each["people"]), f"{each['shared']:.0%}", place, f"{each['sigma_turn_deg']:.2f}"]
        figures += [f"{each['sigma_move_mm']:.0f}", f"{each['halves_turn_deg']:.2f}"]
        figures += [f"{each['focal_px']:.0f} ± {each['sigma_focal_percent']:.1f} %"] * focal
        rows.append((each["camera"], figures))
    return heads, rows


def _world(found: "Calibrated", stature: float | None, distances: list[str]) -> list[str]:
    """Scale, up and fit, a line each."""
    world = found.world
    if distances:
        whose = f"{' '.join(distances)}, people are {world.stature_m:.2f} m tall in the median"
    else:
        whose = f"people of {stature:g} m" if stature is not None else "adults of 1.70 m in the median"
        whose += f", {world.persons} at once"
    better = "" if distances else "; --distance between two cameras says it better"
    level = "from feet on the floor" if world.floor is not None else "from bodies alone, no level floor was found"
    return [
        f"scale: {whose}: ± {100 * world.sigma_scale:.1f} %, one sigma{better}",
        f"up: z, {level}; the floor is at 0",
        f"a joint as against the other cameras, on frames that were not used: {found.held_out_px:.2f} px",
    ]


def _distances(given: list[str], names: Sequence[str]) -> tuple[tuple[int, int, float], ...]:
    """Pairs of cameras, and their distances in metres."""
    found = []
    for text in given:
        pair, _, number = text.rpartition("=")
        cameras = pair.split(",")
        if len(cameras) != 2 or cameras[0] == cameras[1] or not set(cameras) <= set(names):
            raise InputError(f"--distance {text}: give two cameras and metres, such as {names[0]},{names[1]}=3.42")
        try:
            metres = float(number)
        except ValueError:
            metres = np.nan
        if not 0.05 <= metres <= 1000:
            raise InputError(f"--distance {text}: must be 0.05 to 1000 metres")
        found.append((names.index(cameras[0]), names.index(cameras[1]), metres))
    return tuple(found)
