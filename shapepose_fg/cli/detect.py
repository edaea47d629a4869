"""The command `detect`: videos or pictures of calibrated cameras to 2D detections."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from shapepose_fg.cli.options import ImageSizeOption, UnitOption, UpOption, frame_range, image_size_of
from shapepose_fg.cli.terminal import note, progress, show
from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from shapepose_fg.core.camera import Axis, Rig
    from shapepose_fg.detection2d.detector import CameraDetector
    from shapepose_fg.detection2d.network import Backend
    from shapepose_fg.detection2d.recording import DetectionReport, DetectionRun
    from shapepose_fg.io.calibration import Unit
    from shapepose_fg.io.footage.footage import Footage
    from shapepose_fg.io.footage.lockstep import Lockstep

# Everything else is imported inside the command: `--help` must not wait for it.


def detect(
    calibration: Annotated[Path, typer.Option(help="Cameras: a file, or a folder, of one of the formats known.")],
    videos: Annotated[
        list[str],
        typer.Option(
            "--videos",
            "--images",
            metavar="FOLDER|CAMERA=PATH",
            help="Folder with a video, a picture, or a folder of pictures named after each camera; or each one's"
            " own, given once for each camera.",
        ),
    ],
    network: Annotated[
        str, typer.Option(metavar="FILE|NAME", help="ONNX file of a network of OpenPose's kind, or a named one.")
    ],
    output: Annotated[Path, typer.Option(help="Folder for the detections; made if it is not there.")],
    layout: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="How to read the network: tf-pose, openpose-coco, openpose-body25."),
    ] = None,
    download: Annotated[
        bool, typer.Option("--download", help="Fetch a named network that is not here yet.")
    ] = False,
    network_address: Annotated[
        str | None, typer.Option(metavar="URL", help="Where to fetch it from; its checksum decides.")
    ] = None,
    fps: Annotated[
        list[str] | None,
        typer.Option(metavar="RATE|CAMERA=RATE", help="Frames a second, where the files are silent or wrong."),
    ] = None,
    start: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CAMERA=TIME", help="When its first frame was taken: 0.2s, or 12f (its own frames); else 0."
        ),
    ] = None,
    image_placement: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND|CAMERA=KIND",
            help="How pictures of another size than the calibration's came about: scale, letterbox, crop,"
            " crop-centre.",
        ),
    ] = None,
    frames: Annotated[
        str | None, typer.Option(metavar="A:B", help="Moments A to B-1 only; either may be left out.")
    ] = None,
    long_side: Annotated[
        int, typer.Option(help="Longer side of what the network is shown, pixels: more finds smaller people.")
    ] = 656,
    backend: Annotated[
        str, typer.Option(metavar="NAME", help="What runs the network: opencv or onnxruntime.")
    ] = "opencv",
    up: UpOption = None,
    unit: UnitOption = None,
    image_size: ImageSizeOption = None,
) -> None:
    """Detect people's joints in videos or pictures, for `reconstruct`: candidates with part affinities.

    Pictures of rolled cameras are turned upright first; the calibration knows how. A run that is stopped goes on
    where it was when it is started again.
    """
    if backend not in ("opencv", "onnxruntime"):
        raise InputError(f"--backend {backend}: must be opencv or onnxruntime")
    if not 128 <= long_side <= 4096:
        raise InputError(f"--long-side {long_side}: must be 128 to 4096 pixels")
    from shapepose_fg.detection2d.detector import CameraDetector, DetectionConfig
    from shapepose_fg.detection2d.download import find_network
    from shapepose_fg.detection2d.network import HeatMapNetwork
    from shapepose_fg.detection2d.recording import DetectionRun, run_detection
    from shapepose_fg.io.calibration import read_rig
    from shapepose_fg.io.footage.given import clocks_of, per_camera, placements_of
    from shapepose_fg.io.footage.lockstep import align

    rig = read_rig(
        calibration,
        up=cast("Axis | None", up),
        unit=cast("Unit | None", unit),
        image_size=image_size_of(image_size),
    )
    with progress("fetching the network", "bytes") as fetched:
        file = find_network(network, download=download, address=network_address, progress=fetched)
    loaded = HeatMapNetwork.load(file, layout, cast("Backend", backend))
    footage = _open(videos, rig)
    sizes = {name: each.size for name, each in zip(rig.names, footage, strict=True)}
    placements, concluded = placements_of(image_placement or [], sizes, rig)
    for each in concluded:
        note(each)
    rates = per_camera("--fps", fps or [], rig, one_for_all=True)
    starts = per_camera("--start", start or [], rig, one_for_all=False)
    clocks, has_clock = clocks_of(footage, rates, starts, rig)
    moments = align(clocks, has_clock)
    moments = _part(moments, frame_range(frames, len(moments)))
    for each in moments.notes:
        note(each)
    config = DetectionConfig(long_side=long_side)
    detectors = [
        CameraDetector.of(camera, rig.up_vector, placements[camera.name], loaded, config) for camera in rig.cameras
    ]
    if loaded.only_size is not None:
        note(_shown_small(detectors, loaded.only_size))
    run = DetectionRun(rig, footage, detectors, moments, output)
    begin = time.perf_counter()
    with progress("detecting", "pictures") as done:
        try:
            report = run_detection(run, done)
        except KeyboardInterrupt:
            note("stopped; the same command goes on from here")
            raise
    for name, failed in zip(rig.names, report.unreadable, strict=True):
        if failed > 0:
            note(f"camera {name}: {failed} of {report.moments} pictures cannot be read; it sees nobody there")
    show(_summary(run, report, time.perf_counter() - begin))
    print(_next_command(run, calibration, up, unit, image_size))


def _open(videos: Sequence[str], rig: "Rig") -> "list[Footage]":
    """The footage of every camera, looked through."""
    from shapepose_fg.io.footage.footage import open_footage
    from shapepose_fg.io.footage.places import find_footage

    places = find_footage(videos, rig.names)
    for each in places.notes:
        note(each)
    footage = []
    for name, path in zip(rig.names, places.paths, strict=True):
        with progress(f"looking through {name}") as done:
            footage.append(open_footage(path, done))
        for each in footage[-1].notes:
            note(each)
    return footage


def _shown_small(detectors: "Sequence[CameraDetector]", size: tuple[int, int]) -> str:
    """How large a network that takes one size only is shown the pictures."""
    smallest = min(detector.view.scale for detector in detectors)
    return (
        f"here the network takes pictures of {size[0]} x {size[1]} only, so they are shown to it at down to"
        f" {100 * smallest:.0f} % of their size; --backend opencv takes any"
    )


def _part(moments: "Lockstep", span: range) -> "Lockstep":
    """The moments of `span` only."""
    from dataclasses import replace

    part = slice(span.start, span.stop)
    time_s = None if moments.time_s is None else moments.time_s[part]
    return replace(moments, picture=moments.picture[part], time_s=time_s)


def _summary(run: "DetectionRun", report: "DetectionReport", seconds: float) -> "Table":
    """What was detected in each camera's pictures, and how long it took."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for name in ("camera", "pictures", "size", "turned", "network", "candidates"):
        table.add_column(name, justify="left" if name == "camera" else "right")
    for view, (name, footage, detector) in enumerate(zip(run.rig.names, run.footage, run.detectors, strict=True)):
        pictures = int((run.moments.picture[:, view] >= 0).sum()) - report.unreadable[view]
        turned = detector.view.turn_deg
        table.add_row(
            name,
            str(pictures),
            f"{footage.size[0]} x {footage.size[1]}",
            f"{turned:.0f}°" if abs(turned) > 0.5 else "-",
            f"{detector.view.size[0]} x {detector.view.size[1]}",
            f"{report.candidates[view] / max(pictures, 1):.1f}",
        )
    total = max(report.moments * len(run.rig), 1)
    speed = f"{seconds:.1f} s, {1e3 * seconds / total:.0f} ms a picture"
    table.caption = f"{report.moments} frames of {len(run.rig)} cameras in {speed}"
    table.caption_justify = "left"
    return table


def _next_command(
    run: "DetectionRun", calibration: Path, up: str | None, unit: str | None, size: str | None
) -> str:
    """How to go on, as a line to copy."""
    import shlex

    options = {"--calibration": calibration, "--detections": run.output, "--up": up, "--unit": unit}
    options |= {"--image-size": size}
    if run.moments.time_s is not None and len(run.moments) > 1:
        options["--timestamps"] = run.output / "times.csv"
    options["--output"] = "results"
    words = [word for name, value in options.items() if value is not None for word in (name, str(value))]
    return f"next: {shlex.join(['shapepose-fg', 'reconstruct', *words])}"
