"""The command `check-calibration`: whether cameras and detections fit each other, in words."""

import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from shapepose_fg.cli.options import (
    FramesOption,
    ImageSizeOption,
    SkeletonOption,
    UnitOption,
    UpOption,
    frame_range,
    image_size_of,
)
from shapepose_fg.cli.terminal import note, show

if TYPE_CHECKING:
    from shapepose_fg.core.camera import Axis
    from shapepose_fg.io.calibration import Unit

# Everything else is imported inside the command: `--help` must not wait for it.


def check_calibration(
    calibration: Annotated[Path, typer.Option(help="Cameras: a file, or a folder, of one of the formats known.")],
    detections: Annotated[Path, typer.Option(help="Folder with what a 2D detector wrote of every camera.")],
    videos: Annotated[
        list[str] | None,
        typer.Option(
            "--videos",
            "--images",
            metavar="FOLDER|CAMERA=PATH",
            help="The videos or pictures too, to compare their sizes with the calibration's.",
        ),
    ] = None,
    frames: FramesOption = None,
    up: UpOption = None,
    unit: UnitOption = None,
    image_size: ImageSizeOption = None,
    skeleton: SkeletonOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Check whether cameras and detections fit: turned, exchanged or late cameras, wrong units, in words.

    Exit code 1 where something looks wrong, 0 where nothing does.
    """
    from shapepose_fg.core.storage.kept_arrays import InFolder
    from shapepose_fg.io.calibration import read_rig
    from shapepose_fg.io.detections import read_detections
    from shapepose_fg.setup_check.diagnosis import diagnose
    from shapepose_fg.setup_check.pictures import other_sizes
    from shapepose_fg.setup_check.report import report_of
    from shapepose_fg.setup_check.table import setup_report

    size = image_size_of(image_size)
    rig = read_rig(calibration, up=cast("Axis | None", up), unit=cast("Unit | None", unit), image_size=size)
    with tempfile.TemporaryDirectory(prefix="shapepose-fg-") as folder:
        recording = read_detections(detections, rig, skeleton, InFolder(Path(folder)))
        for each in recording.notes:
            note(each)
        sizes = () if videos is None else other_sizes(videos, rig)
        report = report_of(diagnose(recording, rig, frame_range(frames, len(recording))), rig, sizes)
    if as_json:
        print(json.dumps(report.as_dict(), indent=2, allow_nan=False))
    else:
        show(setup_report(report))
    if len(report.findings) > 0:
        raise typer.Exit(1)
