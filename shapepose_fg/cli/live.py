"""The command `live`: online reconstruction from detections as they arrive."""

import os
import stat
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from shapepose_fg.cli.options import (
    INPUT,
    RESULT,
    RUN,
    TIME,
    CameraOptions,
    Workers,
    grouped,
    option,
)
from shapepose_fg.cli.terminal import note
from shapepose_fg.core.errors import InputError, naming

if TYPE_CHECKING:
    from shapepose_fg.live.online import CameraChange, OnlineReconstructor


@grouped
def live(
    cameras: CameraOptions,
    detections: str | None = option(
        INPUT, "File or pipe of JSON lines, tcp://:PORT, or .mcap; by default standard input."
    ),
    skeleton: str | None = option(
        INPUT,
        "Keypoint layout of the detector: a name such as COCO_17, or a TOML file.",
        metavar="NAME",
    ),
    lag: float = option(TIME, "Delay of the refined people, seconds.", 0.3),
    output: list[str] | None = option(
        RESULT,
        "File of JSON lines, tcp://:PORT, .mcap, .rrd, or rerun for the viewer; by default standard"
        " output; may be repeated.",
    ),
    covariances: Literal["none", "joints", "all"] = option(
        RESULT, "Covariances in lines and .mcap: none, of joints, or also of velocities.", "joints"
    ),
    workers: Workers = option(RUN, "Number of processes, with this one.", 2),
) -> None:
    """Reconstruct people while a detector runs: reads a line per camera and picture, writes lines
    of people.

    Input: OpenPose's JSON of a frame in one line, with "camera" and "time_s" beside "people".

    Output: "now" after each frame, and "settled" when its people have been refined.

    The command ends with the input; invalid lines are skipped with a note. A socket accepts
    connections from this machine only, unless an address is given (tcp://0.0.0.0:PORT). An .mcap
    file has ROS 2 messages. `rerun` starts the viewer; rerun+http://HOST:9876/proxy connects to a
    running one.
    """
    from shapepose_fg.core.skeleton import BODY_25
    from shapepose_fg.io.skeleton_file import find_skeleton
    from shapepose_fg.live.inputs import feed
    from shapepose_fg.live.notes import SparingNotes
    from shapepose_fg.live.online import OnlineReconstructor
    from shapepose_fg.live.outputs import published

    rig, joints = cameras.rig(), find_skeleton(skeleton) or BODY_25
    _check_files(detections, output or ())
    with (
        SparingNotes(note) as of_lines,
        SparingNotes(note) as of_readers,
        SparingNotes(note) as of_cameras,
        naming("--lag, --calibration", "change them"),
        published(output or (), rig, of_readers, covariances) as publish,
        OnlineReconstructor(rig, skeleton=joints, lag_s=lag, workers=workers) as people,
    ):
        frames, jumps, status = 0, 0, None
        is_file = _is_file(detections)

        def push(*view: Any) -> None:
            nonlocal frames, jumps, status
            people.push_view(*view)
            report = people.report()
            if report.frames > frames:
                frames = report.frames
                # Also without people, so that readers notice when everybody has left.
                publish("now", people.people(), [people.newest_s])
                publish("settled", people.settled(), ())
                if is_file:
                    people.catch_up()
            if report.jumps > jumps:
                jumps = report.jumps
                of_cameras(f"the times of all cameras jumped to {view[2]:.2f} s")
            status = _say(people, status, of_cameras)

        if os.isatty(0) if detections is None else detections.startswith("tcp:"):
            note(f"reads from {detections or 'this terminal'} until Ctrl-C")
        try:
            feed(detections, rig, joints, of_lines, push)
        except InputError:
            publish("settled", people.finish(), ())
            raise
        publish("settled", people.finish(), ())
        report = people.report()
    out = f"{report.dropped} measurements were dropped (late, repeated, or at the wrong time)"
    if report.unrefined > 0:
        out += f"; {report.unrefined} frames were not refined, because solving did not keep up"
    note(f"{report.frames} frames, {report.late} of them late; {out}")
    if report.jumps > report.frames / 2:
        note(f"the times jumped at {report.jumps} frames: time_s must be in seconds")


def _check_files(detections: str | None, outputs: Sequence[str]) -> None:
    """Raise InputError if the input is a missing file, or if it is an output, too: outputs are
    emptied when they are opened.
    """
    if detections is not None and detections != "-" and not detections.startswith("tcp:"):
        if Path(detections).is_dir():
            raise InputError(f"{detections}: this is a folder; give a file or a pipe")
        if not Path(detections).exists():
            raise InputError(f"{detections}: there is no such file; check the path")
    if not _is_file(detections):
        return
    given = os.fstat(0) if detections in (None, "-") else Path(detections).stat()
    for each in outputs:
        if Path(each).is_file() and os.path.samestat(given, Path(each).stat()):
            raise InputError(f"--output {each}: this is the input; give another file")


def _is_file(detections: str | None) -> bool:
    """Whether the input is a file on disk: it can wait for windows to be solved."""
    try:
        mode = os.fstat(0).st_mode if detections in (None, "-") else Path(detections).stat().st_mode
    except OSError:
        return False
    return stat.S_ISREG(mode)


def _say(
    people: "OnlineReconstructor", last: "CameraChange | None", note: Callable[[str], None]
) -> "CameraChange | None":
    """Print changes of the cameras' statuses since `last`, the last printed ones; returns the
    current ones.
    """
    events = people.camera_changes()
    if len(events) == 0 or events[-1] is last:
        return last
    new = next((n for n, each in enumerate(reversed(events)) if each is last), len(events))
    for each in events[len(events) - new :]:
        note(
            f"{each.time_s:.2f} s: camera {each.camera} {each.state.name.lower().replace('_', ' ')}"
        )
    return events[-1]
