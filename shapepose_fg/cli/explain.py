"""The command `explain`: explains why a joint of a result is where it is."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from shapepose_fg.cli.options import INPUT, TIME, argument, grouped, json_option, option
from shapepose_fg.cli.terminal import show, table
from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from shapepose_fg.pipeline.explanation import Explanation


@grouped
def explain(
    results: Path = argument("RESULTS", "Folder of a reconstruction."),
    person: int = argument("PERSON", "Number of the person: `shapepose-fg tracks RESULTS` lists them."),
    joint: str = argument("JOINT", "Name of the joint, such as RWrist."),
    frame: int | None = option(TIME, "Frame number."),
    time: float | None = option(TIME, "Time, seconds: the person's frame nearest to it is explained."),
    detections: Path | None = option(INPUT, "Folder that was reconstructed: names refused detections, too."),
    skeleton: str | None = option(
        INPUT, "The detector's joints, as in the reconstruction: a layout or a TOML file.", metavar="NAME"
    ),
    as_json: bool = json_option(),
) -> None:
    """Say why a joint is where it is: what each camera, the body and motion say, and what is the matter."""
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.core.result_files import results_folder
    from shapepose_fg.io.detections.reading import read_detections
    from shapepose_fg.io.solved_setup import cameras_of
    from shapepose_fg.pipeline.explaining import explain

    if (frame is None) == (time is None):
        raise InputError("--frame, --time: give one of them")
    folder = results_folder(results)
    rig, people = cameras_of(folder), Reconstruction.load(folder)
    seen = None if detections is None else read_detections(detections, rig, skeleton)
    found = explain(people, rig, person=person, joint=joint, frame=frame, time_s=time, detections=seen)
    if as_json:
        print(json.dumps(found.as_dict(), indent=2, allow_nan=False))
    else:
        show(_screen(found))


def _screen(found: "Explanation") -> "RenderableType":
    """Sentences, and a line per camera."""
    from rich.console import Group
    from rich.text import Text

    heads = "camera detection score theirs off sigmas weight used".split()
    rows = [
        (
            view.camera,
            "-" if view.detection_px is None else f"{view.detection_px[0]:.0f} {view.detection_px[1]:.0f}",
            *(("-", "-") if view.detection_px is None else (f"{view.score:.2f}", f"{view.probability:.2f}")),
            "-" if view.off_px is None else f"{view.off_px:.0f} px",
            "-" if view.off_sigma is None else f"{view.off_sigma:.1f}",
            f"{view.share:.0%}",
            view.gate,
        )
        for view in found.views
    ]
    caption = (
        "theirs: probability that it is this person's; off: from where all else has the joint;"
        " weight: share of what is known"
    )
    return Group(*map(Text, found.words), Text(), table(heads, rows, caption=caption))
