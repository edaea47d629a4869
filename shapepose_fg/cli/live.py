"""The command `live`: people as JSON lines, as detections come in as JSON lines."""

import json
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from shapepose_fg.cli.options import INPUT, RESULT, RUN, TIME, CameraOptions, check_workers, grouped, option
from shapepose_fg.cli.terminal import note
from shapepose_fg.core.errors import naming

if TYPE_CHECKING:
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.live.online import OnlineReconstructor


@grouped
def live(
    cameras: CameraOptions,
    detections: Path | None = option(INPUT, "File or pipe of JSON lines; standard input by default."),
    skeleton: str | None = option(INPUT, "The detector's skeleton, or a TOML file of it.", metavar="NAME"),
    lag: float = option(TIME, "How much later refined people follow, seconds.", 0.3),
    output: Path | None = option(RESULT, "File of JSON lines; standard output by default."),
    workers: int = option(RUN, "Processes that refine; 1: none but this one.", 2),
) -> None:
    """Follow people while a detector runs: a line per camera and picture in, lines of people out.

    In: OpenPose's JSON of a frame in one line, with "camera" and "time_s" beside "people". Out: "now" after each
    frame, "settled" when its people are refined. Ends with the input.
    """
    from shapepose_fg.core.skeleton import BODY_25
    from shapepose_fg.io.detections.lines import read_view_line
    from shapepose_fg.io.skeleton_file import find_skeleton
    from shapepose_fg.live.online import OnlineReconstructor

    check_workers(workers)
    rig, joints = cameras.rig(), find_skeleton(skeleton) or BODY_25
    with ExitStack() as files, naming("--lag, --calibration", "change them"):
        source = files.enter_context(detections.open(encoding="utf-8")) if detections is not None else sys.stdin
        sink = files.enter_context(output.open("w", encoding="utf-8")) if output is not None else sys.stdout
        people = files.enter_context(OnlineReconstructor(rig, skeleton=joints, lag_s=lag, workers=workers))
        place, frames, said = detections or "standard input", 0, 0
        for number, line in enumerate(source, start=1):
            if not line.strip():
                continue
            view = read_view_line(line, f"{place}, line {number}", rig, joints)
            people.push_view(*view)
            if people.report().frames > frames:
                frames = people.report().frames
                _write(sink, _lines("now", people.people()))
                _write(sink, _lines("settled", people.settled()))
            said = _say(people, said)
        _write(sink, _lines("settled", people.finish()))
        report = people.report()
    note(f"{report.frames} frames, {report.late} of them late; {report.dropped} came too late or twice")


def _say(people: "OnlineReconstructor", said: int) -> int:
    """Tell what was noticed of cameras since; returns how much has been told."""
    events = people.said()
    for each in events[said:]:
        note(f"{each.time_s:.2f} s: camera {each.camera} {each.state.name.lower()}")
    return len(events)


def _write(sink: IO[str], lines: Iterator[dict[str, Any]]) -> None:
    for line in lines:
        sink.write(json.dumps(line, allow_nan=False) + "\n")
    sink.flush()


def _lines(kind: str, people: "Reconstruction") -> Iterator[dict[str, Any]]:
    """A line per frame: metres, m², m/s; null where unknown."""
    for time_s in np.unique(people.time_s).tolist():
        here = people.rows(people.time_s == time_s)
        rows = [
            {
                "person": int(here.person[n]),
                "joints": _plain(here.joints[n]),
                "covariance": _plain(here.covariance[n]),
                "velocity": _plain(here.velocity[n]),
                "known": here.known[n].tolist(),
                "status": str(here.status[n]),
                "body": {name: _plain(getattr(here, name)[n]) for name in _BODY},
            }
            for n in range(len(here))
        ]
        yield {"kind": kind, "time_s": time_s, "people": rows}


_BODY = ("betas", "global_orient", "body_pose", "transl")


def _plain(values: np.ndarray) -> Any:
    """Nested lists of numbers of 6 digits, null where one of an innermost list is unknown."""
    if values.ndim > 1:
        return [_plain(each) for each in values]
    return [float(f"{value:.6g}") for value in values] if np.isfinite(values).all() else None
