"""The command `check-calibration`: checks whether cameras and detections fit each other."""

import tempfile
from pathlib import Path

import typer

from shapepose_fg.cli.options import (
    ProjectOptions,
    TimeOptions,
    frame_range,
    frames_option,
    grouped,
    json_option,
)
from shapepose_fg.cli.pictures import PictureOptions
from shapepose_fg.cli.terminal import show, show_json


@grouped
def check_calibration(
    given: ProjectOptions,
    pictures: PictureOptions,
    rate: TimeOptions,
    frames: str | None = frames_option(),
    as_json: bool = json_option(),
) -> None:
    """Check whether cameras and detections fit: turned, exchanged or late cameras, wrong units, in
    words.

    Exit code 1 if something looks wrong, otherwise 0. Of videos and pictures, only the sizes are
    compared.
    """
    from shapepose_fg.cameras.check.diagnosis import detected_sizes, other_sizes
    from shapepose_fg.cameras.check.report import check_setup
    from shapepose_fg.cli.setup_table import setup_report
    from shapepose_fg.io.footage.placement import FOOTAGE

    seen = given.located()
    rig = seen.still_rig("check-calibration")
    with tempfile.TemporaryDirectory(prefix="shapepose-fg-") as folder:
        recording, _ = rate.read(seen.detections, seen.joints, rig, Path(folder))
        sizes = () if pictures.videos is None else other_sizes(pictures.videos, rig)
        if pictures.videos is None and (used := seen.detections / FOOTAGE).is_file():
            sizes = detected_sizes(used, rig)
        report = check_setup(
            recording, rig, frame_range(frames, len(recording), recording.first), sizes
        )
    if as_json:
        show_json(report.as_dict())
    else:
        show(setup_report(report))
    if len(report.findings) > 0:
        raise typer.Exit(1)
