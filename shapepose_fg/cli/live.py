"""The command `live`: people as they are, from detections as they come in."""

from typing import TYPE_CHECKING

from shapepose_fg.cli.options import INPUT, RESULT, RUN, TIME, CameraOptions, check_workers, grouped, option
from shapepose_fg.cli.terminal import note
from shapepose_fg.core.errors import naming

if TYPE_CHECKING:
    from shapepose_fg.live.online import OnlineReconstructor


@grouped
def live(
    cameras: CameraOptions,
    detections: str | None = option(INPUT, "File or pipe of JSON lines, tcp://:PORT, or .mcap; standard input."),
    skeleton: str | None = option(INPUT, "The detector's skeleton, or a TOML file of it.", metavar="NAME"),
    lag: float = option(TIME, "How much later refined people follow, seconds.", 0.3),
    output: list[str] | None = option(
        RESULT, "File of JSON lines, tcp://:PORT, .mcap, .rrd, or rerun to look; standard output; may be repeated."
    ),
    workers: int = option(RUN, "Processes that refine; 1: none but this one.", 2),
) -> None:
    """Follow people while a detector runs: a line per camera and picture in, lines of people out.

    In: OpenPose's JSON of a frame in one line, with "camera" and "time_s" beside "people". Out: "now" after each
    frame, "settled" when its people are refined. Ends with the input. A socket listens on this machine only,
    unless another is named (tcp://0.0.0.0:PORT); .mcap holds ROS 2 messages. `rerun` starts that viewer,
    rerun+http://HOST:9876/proxy is one that runs.
    """
    from shapepose_fg.core.skeleton import BODY_25
    from shapepose_fg.io.skeleton_file import find_skeleton
    from shapepose_fg.live.ends import published, views
    from shapepose_fg.live.online import OnlineReconstructor

    check_workers(workers)
    rig, joints = cameras.rig(), find_skeleton(skeleton) or BODY_25
    frames, said = 0, 0
    with (
        naming("--lag, --calibration", "change them"),
        published(output or (), rig, note) as publish,
        OnlineReconstructor(rig, skeleton=joints, lag_s=lag, workers=workers) as people,
    ):
        for view in views(detections, rig, joints, note):
            with naming(detections or "standard input"):
                people.push_view(*view)
            if people.report().frames > frames:
                frames = people.report().frames
                publish("now", people.people())
                publish("settled", people.settled())
            said = _say(people, said)
        publish("settled", people.finish())
        report = people.report()
    note(f"{report.frames} frames, {report.late} of them late; {report.dropped} came too late or twice")


def _say(people: "OnlineReconstructor", said: int) -> int:
    """Tell what was noticed of cameras since; returns how much has been told."""
    events = people.said()
    for each in events[said:]:
        note(f"{each.time_s:.2f} s: camera {each.camera} {each.state.name.lower()}")
    return len(events)
