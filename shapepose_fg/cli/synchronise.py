"""The command `synchronise`: estimates start times of cameras from people."""

import shlex
from pathlib import Path

import typer

from shapepose_fg.cli.found_cameras import MOST_S, Most, found_clocks, show_clocks
from shapepose_fg.cli.options import (
    RESULT,
    TIME,
    Hertz,
    ProjectOptions,
    check_output_files,
    frames_option,
    grouped,
    json_option,
    next_reconstruct,
    option,
)
from shapepose_fg.cli.terminal import note, show_json


@grouped
def synchronise(
    given: ProjectOptions,
    fps: Hertz | None = option(TIME, "Frame rate of all cameras, Hz; needed without times.csv."),
    most: Most = option(TIME, "Largest offset that is searched, seconds.", MOST_S),
    frames: str | None = frames_option(),
    output: Path | None = option(RESULT, "File for the times of all frames, for --timestamps."),
    as_json: bool = json_option(),
) -> None:
    """Estimate start times of cameras with known poses from the people in the recording, to
    milliseconds.

    Exit code 1 if motion does not determine a camera's offset; then nothing is written.
    """
    from shapepose_fg.io.timestamps import write_timestamps

    check_output_files({"--output": output})
    seen = given.located()
    fps = seen.source.fps if fps is None and seen.source is not None else fps
    rig = seen.still_rig("synchronise")
    found, taken_s = found_clocks(seen.detections, rig, seen.joints, fps, most, frames)
    problems = found.undetermined(rig)
    if output is not None and not problems:
        write_timestamps(output, rig.names, taken_s)
    if as_json:
        show_json(found.as_dict(rig))
    else:
        show_clocks(found, rig)
    note(*problems)
    if problems:
        raise typer.Exit(1)
    if not as_json:
        first = found.offset_s.min()
        starts = zip(rig.names, found.offset_s - first, strict=True)
        words = [word for name, start in starts for word in ("--start", f"{name}={start:.4f}s")]
        print(
            f"for videos: shapepose-fg detect {shlex.join(words)} and the other options as before"
        )
        if output is not None:
            options = seen.given() | seen.calibration_options() | {"--timestamps": output}
            calibration = {"--calibration": seen.calibration, "--output": "results"}
            options = options if given.project is not None else calibration | options
            print(f"{output}: times of {len(taken_s)} frames")
            print(next_reconstruct(options))
