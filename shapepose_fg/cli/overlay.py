"""The command `overlay`: draws a result over its videos or pictures."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Interval

from shapepose_fg.cli.options import (
    DRAW,
    INPUT,
    RESULT,
    argument,
    chosen_cameras,
    frame_range,
    frames_option,
    grouped,
    option,
)
from shapepose_fg.cli.pictures import PictureOptions
from shapepose_fg.cli.terminal import note, progress, show_written
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import ASSUMED_FPS
from shapepose_fg.core.result_files import results_folder
from shapepose_fg.core.run_summary import covered_frames
from shapepose_fg.core.storage.files import inside


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """Options: what is drawn, and its size."""

    cameras: str | None = option(DRAW, "Use only these cameras.", metavar="A,B")
    without: str | None = option(DRAW, "Leave out these cameras.", metavar="A,B")
    stills: str | None = option(
        DRAW, "Draw still pictures of these frames instead of a video.", metavar="A,B"
    )
    each: bool = option(
        DRAW,
        "Write a file per camera at its own size, or all cameras in one.",
        False,
        "--each/--grid",
    )
    bodies: bool = option(DRAW, "Draw the bodies' surfaces.", False, "--bodies/--no-bodies")
    skeletons: bool = option(DRAW, "Draw joints and bones.", True, "--skeletons/--no-skeletons")
    points: bool = option(
        DRAW, "Draw the 2D detections; red crosses were not used.", True, "--points/--no-points"
    )
    width: Annotated[int, Interval(ge=160, le=7680)] = option(
        DRAW, "Width of the grid, pixels.", 1920
    )


@grouped
def overlay(
    pictures: PictureOptions,
    drawn: Drawn,
    results: Path = argument("RESULTS", "Folder of a reconstruction."),
    detections: Path | None = option(
        INPUT, "Folder written by `detect`, which contains the paths of the pictures."
    ),
    frames: str | None = frames_option(),
    output: Path | None = option(
        RESULT, "Folder for videos and pictures; by default RESULTS/overlay."
    ),
) -> None:
    """Draw a result over the videos or pictures from which it was made: as mp4, or still pictures.

    Each person has a colour. White dots are joints that were seen, dark dots joints that were
    inferred; squares are 2D detections that were used, red crosses those that were not. By default,
    the videos are those in which `detect` ran.
    """
    if drawn.stills is not None and frames is not None:
        raise InputError("--stills and --frames: both select frames; give one of them")
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.io.calibration.reading import cameras_of
    from shapepose_fg.viz.overlay.frames import Overlay, write_overlay

    folder = results_folder(results)
    with Reconstruction.open(folder) as people:
        rig, run = cameras_of(folder), people.run
        known = pictures.named(rig) if drawn.cameras is None else rig.names
        names = chosen_cameras(known, drawn.cameras, drawn.without)
        shown = pictures.of_result(folder, run, rig, names, detections)
        if drawn.points and not people.observed:
            note(f"{folder}: observations.npz is missing, so no detections are drawn")
        model, file = None, run.get("body")
        if drawn.bodies:
            from shapepose_fg.body.model.body_model import BodyModel

            model = BodyModel.default() if file is None else BodyModel.load(Path(file))
        over = Overlay(people, rig, shown, drawn.skeletons, drawn.points, model)
        length = max(len(used.places) for used, _ in shown)
        if drawn.stills is not None:
            chosen, fps = _stills(drawn.stills, length), None
        else:
            covered = [
                each
                for span in covered_frames(run) or [range(length)]
                for each in span
                if each < length
            ]
            chosen, fps = covered if frames is None else frame_range(frames, length), _fps(run)
        if len(chosen) == 0:
            raise InputError(
                f"{folder}: none of its frames has a picture; give the videos that it was made from"
            )
        with progress("drawing") as done:
            width = None if drawn.each else drawn.width
            written = write_overlay(
                over, chosen, output or inside(folder, "overlay"), width, fps, done
            )
        show_written(map(str, written))


def _fps(run: Mapping[str, Any]) -> float:
    """Frame rate of the new video, Hz."""
    rate = run.get("time", {}).get("fps")  # it is a number if present (`check_run`)
    return float(rate) if rate is not None and 0.1 <= rate <= 1000 else ASSUMED_FPS


def _stills(text: str, length: int) -> list[int]:
    """Numbers of the frames for still pictures."""
    words = re.split(r"[,\s]+", text.strip())
    if not all(re.fullmatch(r"\d{1,9}", word) and int(word) < length for word in words):
        raise InputError(f"--stills {text}: must be frames 0 to {length - 1}, such as 0,50")
    return [int(word) for word in words]
