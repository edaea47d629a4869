"""The command `explain`: explains which measurements determine a joint of a result."""

from pathlib import Path
from typing import TYPE_CHECKING

from shapepose_fg.cli.options import INPUT, TIME, argument, grouped, json_option, option
from shapepose_fg.cli.terminal import show, show_json, table
from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from shapepose_fg.results.explanation import Explanation


@grouped
def explain(
    results: Path = argument("RESULTS", "Folder of a reconstruction."),
    person: int = argument(
        "PERSON", "Number of the person: `shapepose-fg tracks RESULTS` lists them."
    ),
    joint: str = argument("JOINT", "Name of the joint, such as RWrist."),
    frame: int | None = option(TIME, "Frame number."),
    time: float | None = option(TIME, "Time, seconds; the nearest frame of the person is used."),
    detections: Path | None = option(
        INPUT, "Folder of detections that was reconstructed: lists rejected detections, too."
    ),
    skeleton: str | None = option(
        INPUT,
        "Keypoint layout of the detector, as in the reconstruction: a name or a TOML file.",
        metavar="NAME",
    ),
    as_json: bool = json_option(),
) -> None:
    """Explain why a joint is where it is: the shares of cameras, body and motion, and any problems
    found.
    """
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.core.result_files import results_folder
    from shapepose_fg.io.calibration.reading import cameras_of
    from shapepose_fg.io.detections.reading import read_detections
    from shapepose_fg.results.explain import explain

    if (frame is None) == (time is None):
        raise InputError("--frame and --time: give one of them")
    folder = results_folder(results)
    rig, people = cameras_of(folder), Reconstruction.load(folder)
    seen = None if detections is None else read_detections(detections, rig, skeleton)
    found = explain(
        people, rig, person=person, joint=joint, frame=frame, time_s=time, detections=seen
    )
    if as_json:
        show_json(found.as_dict())
    else:
        show(_screen(found))


def _screen(found: "Explanation") -> "RenderableType":
    """Sentences, and a table with a line per camera."""
    from rich.console import Group
    from rich.text import Text

    heads = "camera detection score probability off sigmas weight gate".split()
    rows = [
        (
            view.camera,
            "-"
            if view.detection_px is None
            else f"{view.detection_px[0]:.0f} {view.detection_px[1]:.0f}",
            *(
                ("-", "-")
                if view.detection_px is None
                else (f"{view.score:.2f}", f"{view.probability:.2f}")
            ),
            "-" if view.off_px is None else f"{view.off_px:.0f} px",
            "-" if view.off_sigma is None else f"{view.off_sigma:.1f}",
            f"{view.share:.0%}",
            view.gate,
        )
        for view in found.views
    ]
    caption = (
        "probability: of belonging to this person; off: distance from where all other "
        "measurements place the joint; weight: share of the joint's information"
    )
    return Group(*map(Text, found.words), Text(), table(heads, rows, caption=caption))
