"""The command `overlay`: a result drawn over the videos or pictures that it was made from."""

import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shapepose_fg.cli.options import FramesOption, frame_range
from shapepose_fg.cli.terminal import note, progress
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import ASSUMED_FPS
from shapepose_fg.core.result_files import results_folder

if TYPE_CHECKING:
    from shapepose_fg.body.model.body_model import BodyModel
    from shapepose_fg.core.camera import Rig
    from shapepose_fg.viz.overlay.frames import Overlay

# Everything else is imported inside the command: `--help` must not wait for it.

_GRID = "grid"
"""What the file with all cameras is called."""


def overlay(
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="Folder of a reconstruction.")],
    output: Annotated[
        Path | None, typer.Option(help="Folder for videos and pictures; by default RESULTS/overlay.")
    ] = None,
    videos: Annotated[
        list[str] | None,
        typer.Option(
            "--videos",
            "--images",
            metavar="FOLDER|CAMERA=PATH",
            help="The cameras' videos or pictures, as for `detect`; by default those that were detected in.",
        ),
    ] = None,
    detections: Annotated[
        Path | None,
        typer.Option(help="Folder that `detect` wrote: it says which picture belongs to which frame."),
    ] = None,
    cameras: Annotated[str | None, typer.Option(metavar="A,B", help="Only these cameras.")] = None,
    frames: FramesOption = None,
    stills: Annotated[
        str | None, typer.Option(metavar="A,B", help="Still pictures of these frames instead of a video.")
    ] = None,
    each: Annotated[
        bool, typer.Option("--each/--grid", help="A file for each camera at its own size, or all in one.")
    ] = False,
    bodies: Annotated[bool, typer.Option("--bodies/--no-bodies", help="Draw the bodies' surfaces.")] = False,
    skeletons: Annotated[bool, typer.Option("--skeletons/--no-skeletons", help="Draw joints and bones.")] = True,
    points: Annotated[
        bool, typer.Option("--points/--no-points", help="Draw the 2D detections; red crosses were not used.")
    ] = True,
    width: Annotated[int, typer.Option(help="Width of the grid, pixels.")] = 1920,
    image_placement: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND|CAMERA=KIND", help="As for `detect`, where pictures have another size."),
    ] = None,
) -> None:
    """Draw a result over the videos or pictures that it was made from: mp4, or still pictures.

    Everybody has a colour. Dots are joints that were seen, dark rings joints that were inferred; squares are 2D
    detections that were used, red crosses those that were not.
    """
    if not 160 <= width <= 7680:
        raise InputError(f"--width {width}: must be 160 to 7680 pixels")
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.io.calibration import read_rig
    from shapepose_fg.io.solved_setup import CAMERAS
    from shapepose_fg.viz.overlay.frames import Overlay, OverlayContent
    from shapepose_fg.viz.overlay.result_pictures import pictures_of

    folder = results_folder(results)
    if stills is not None and frames is not None:
        raise InputError("--stills and --frames: both say which frames; give one of them")
    with Reconstruction.open(folder) as people:
        rig = read_rig(folder / CAMERAS)
        drawn = _drawn_cameras(cameras, videos, rig)
        pictures = pictures_of(people.run, rig, drawn, videos, detections, image_placement or [])
        content = OverlayContent(skeletons=skeletons, bodies=bodies, detections=points)
        if points and not people.observed:
            note(f"{folder}: there is no observations.npz, so no detections are drawn")
        over = Overlay(people, rig, pictures, content, _body(people.run) if bodies else None)
        length = max(len(used.places) for used, _ in pictures)
        if stills is not None:
            chosen, fps = _stills(stills, length), None
        else:
            chosen = _recorded(people.run, length) if frames is None else frame_range(frames, length)
            fps = _fps(people.run)
        if len(chosen) == 0:
            raise InputError(f"{folder}: none of its frames has a picture; give the videos that it was made from")
        for path in _write(over, chosen, output or folder / "overlay", each, width, fps):
            print(f"written  {path}")


def _drawn_cameras(text: str | None, videos: Sequence[str] | None, rig: "Rig") -> list[str]:
    """The cameras that are drawn: those that are asked for, or else those whose videos are given one by one."""
    if text is None:
        named = {each.partition("=")[0].strip() for each in videos or [] if "=" in each}
        return [name for name in rig.names if name in named] or list(rig.names)
    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in rig.names:
            raise InputError(f"--cameras {text}: there is no camera {name!r}; there are {' '.join(rig.names)}")
    if len(names) == 0 or len(set(names)) < len(names):
        raise InputError(f"--cameras {text}: must be names of cameras, each once, such as {rig.names[0]}")
    return names


def _body(run: Mapping[str, Any]) -> "BodyModel":
    """The model that the bodies of a result are of."""
    from shapepose_fg.body.model.body_model import BodyModel

    file = run.get("body")
    return BodyModel.default() if file is None else BodyModel.load(Path(str(file)))


def _recorded(run: Mapping[str, Any], length: int) -> range:
    """The frames that a result tells of, people in them or not."""
    told = run.get("frames")
    if isinstance(told, list) and len(told) == 2 and all(isinstance(each, int) for each in told):
        return range(max(0, told[0]), min(told[1], length))
    return range(length)


def _fps(run: Mapping[str, Any]) -> float:
    """Frames a second of the video that is made."""
    told = run.get("time")
    rate = told.get("fps") if isinstance(told, dict) else None
    return float(rate) if isinstance(rate, int | float) and 0.1 <= rate <= 1000 else ASSUMED_FPS


def _stills(text: str, length: int) -> list[int]:
    """The frames of which still pictures are asked for."""
    words = re.split(r"[,\s]+", text.strip())
    if not all(re.fullmatch(r"\d{1,9}", word) and int(word) < length for word in words):
        raise InputError(f"--stills {text}: must be frames 0 to {length - 1}, such as 0,50")
    return [int(word) for word in words]


def _write(
    over: "Overlay", frames: Sequence[int], place: Path, each: bool, width: int, video_fps: float | None
) -> list[Path]:
    """Draw `frames` and write them: a video where a rate is given, else still pictures."""
    from shapepose_fg.viz.overlay.frames import grid, grid_shape
    from shapepose_fg.viz.overlay.output import VideoFile, even, write_picture

    own = [even(footage.size) for _, footage in over.cameras]
    columns, cells = grid_shape(own, width)
    names = [used.name for used, _ in over.cameras] if each else [_GRID]
    sizes = own if each else cells
    paths: list[Path] = []
    videos: list[VideoFile] = []
    with ExitStack() as stack, progress("drawing") as done:
        for at, frame in enumerate(frames):
            drawn = over.draw(frame, sizes)
            pictures = drawn if each else [grid(drawn, columns)]
            if video_fps is not None and len(videos) == 0:
                paths = [place / f"{name}.mp4" for name in names]
                shapes = [(picture.shape[1], picture.shape[0]) for picture in pictures]
                files = zip(paths, shapes, strict=True)
                videos = [stack.enter_context(VideoFile(path, shape, video_fps)) for path, shape in files]
            for index, picture in enumerate(pictures):
                if video_fps is not None:
                    videos[index].add(picture)
                else:
                    paths.append(place / f"{names[index]}_{frame:06d}.jpg")
                    write_picture(paths[-1], picture)
            done(at + 1, len(frames))
    return paths
