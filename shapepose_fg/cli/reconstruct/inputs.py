"""What `shapepose-fg reconstruct` is told by its options, and by a Pose2Sim project: places, times, people."""

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from shapepose_fg.cli.terminal import note
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.output_folder import prepare_output

if TYPE_CHECKING:
    from shapepose_fg.body.fitting.fitter import BodyFitter
    from shapepose_fg.body.shapes import SubjectShapes
    from shapepose_fg.core.camera import Rig
    from shapepose_fg.core.frame_times import FrameTimes
    from shapepose_fg.core.storage.kept_arrays import InFolder
    from shapepose_fg.io.pose2sim_project import Pose2SimProject
    from shapepose_fg.pipeline.pipeline import PipelineConfig


def project_of(folder: Path, tell: Callable[[str], None] = note) -> "Pose2SimProject":
    """The Pose2Sim project in a folder; `tell` is given what was taken to be what."""
    from shapepose_fg.io.pose2sim_project import read_pose2sim_project

    found = read_pose2sim_project(folder)
    for each in found.notes:
        tell(each)
    return found


def places(
    calibration: Path | None, detections: Path | None, output: Path | None, project: "Pose2SimProject | None"
) -> tuple[Path, Path, Path]:
    """Cameras, detections and the folder of results, as the options say, else the project."""
    if project is not None:
        return calibration or project.calibration, detections or project.detections, output or project.output
    options = {"--calibration": calibration, "--detections": detections, "--output": output}
    missing = [name for name, value in options.items() if value is None]
    if calibration is None or detections is None or output is None:
        listed = " and ".join([", ".join(missing[:-1]), missing[-1]] if len(missing) > 1 else missing)
        raise InputError(f"{listed}: missing; give them, or --project with the folder of a Pose2Sim project")
    return calibration, detections, output


@contextmanager
def recording_folder(output: Path) -> "Iterator[InFolder]":
    """Where what the cameras saw is kept while the block runs: files in `output`.

    What a killed run left there is removed. They are not in memory, because they may be larger than that.
    """
    from shapepose_fg.core.storage.kept_arrays import InFolder

    folder = output / _RECORDING
    shutil.rmtree(folder, ignore_errors=True)
    try:
        yield InFolder(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


_RECORDING = ".detections"


def times_of(fps: float | None, timestamps: Path | None, rig: "Rig", frames: int) -> "FrameTimes | None":
    """When the frames were taken, as the options say it; None where they do not."""
    from shapepose_fg.core.frame_times import FrameTimes
    from shapepose_fg.io.timestamps import read_timestamps

    if timestamps is not None:
        return read_timestamps(timestamps, rig, frames)
    return None if fps is None else FrameTimes.from_fps(fps, frames)


def cuts_of(text: str | None) -> tuple[int, ...]:
    """The frames that `A,B,...` names."""
    try:
        return () if text is None else tuple(int(word) for word in re.split(r"[,\s]+", text.strip()))
    except ValueError:
        raise InputError(
            f"--cuts {text}: must be rising frame numbers with commas between, such as 300,600"
        ) from None


def possible_cuts(cuts: tuple[int, ...], count: int) -> tuple[int, ...]:
    """`cuts`, if a recording of `count` frames can have them."""
    from shapepose_fg.core.frame_times import check_cuts

    try:
        return check_cuts(cuts, count)
    except ValueError:
        raise InputError(
            f"--cuts {','.join(map(str, cuts))}: must be rising frame numbers between 1 and {count - 1}, such as"
            " 300,600"
        ) from None


def known_shapes(file: Path, body: Path | None) -> "SubjectShapes":
    """The people that `file` knows, on the body in use; nobody where there is no such file yet."""
    from shapepose_fg.body.fitting.weights import fingerprint
    from shapepose_fg.body.model.body_model import BodyModel
    from shapepose_fg.body.shapes import SubjectShapes

    whose = fingerprint(BodyModel.default() if body is None else BodyModel.load(body))
    if file.exists():
        return SubjectShapes.load(file, whose)
    prepare_output(file.parent)
    return SubjectShapes.empty(whose)


def fitter_of(body: Path | None, settings: "PipelineConfig", joints: tuple[str, ...]) -> "BodyFitter | None":
    """The body fitter with the model of the file `body`; without one, the pipeline takes its own."""
    if body is None:
        return None
    from shapepose_fg.body.fitting.fitters import make_fitter
    from shapepose_fg.body.model.body_model import BodyModel

    return make_fitter(settings.body, BodyModel.load(body).with_keypoints(joints))
