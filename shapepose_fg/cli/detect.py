"""The command `detect`: videos or pictures of calibrated cameras to 2D detections."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

from shapepose_fg.cli.options import (
    INPUT,
    REQUIRED,
    RESULT,
    RUN,
    TIME,
    CameraOptions,
    frame_range,
    frames_option,
    grouped,
    option,
)
from shapepose_fg.cli.pictures import PictureOptions
from shapepose_fg.cli.terminal import note, progress, show, table
from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from shapepose_fg.detection2d.detector import CameraDetector
    from shapepose_fg.detection2d.network import Backend, HeatMapNetwork
    from shapepose_fg.detection2d.recording import DetectionReport, DetectionRun

_NETWORK = "Network"


@dataclass(frozen=True, kw_only=True)
class NetworkOptions:
    """The network that detects, and how it is run."""

    network: str = option(_NETWORK, "ONNX file like OpenPose's, or a named one.", REQUIRED, metavar="FILE|NAME")
    layout: str | None = option(_NETWORK, "Its kind: tf-pose, openpose-coco, openpose-body25.", metavar="NAME")
    download: bool = option(_NETWORK, "Fetch a named network that is not here yet.", False, "--download")
    network_address: str | None = option(_NETWORK, "Where to fetch it from; its checksum decides.", metavar="URL")
    long_side: int = option(_NETWORK, "Longer side of what it is shown, pixels: more finds smaller people.", 656)
    backend: str = option(RUN, "What runs the network: opencv or onnxruntime.", "opencv", metavar="NAME")

    def check(self) -> None:
        """Refuse what makes no sense."""
        if self.backend not in ("opencv", "onnxruntime"):
            raise InputError(f"--backend {self.backend}: must be opencv or onnxruntime")
        if not 128 <= self.long_side <= 4096:
            raise InputError(f"--long-side {self.long_side}: must be 128 to 4096 pixels")

    def load(self) -> "HeatMapNetwork":
        """The network, fetched if need be."""
        from shapepose_fg.detection2d.download import find_network
        from shapepose_fg.detection2d.network import HeatMapNetwork

        with progress("fetching the network", "bytes") as fetched:
            address = self.network_address
            file = find_network(self.network, download=self.download, address=address, progress=fetched)
        return HeatMapNetwork.load(file, self.layout, cast("Backend", self.backend))


@dataclass(frozen=True, kw_only=True)
class ClockOptions:
    """When pictures were taken."""

    fps: list[str] | None = option(TIME, "Frames a second, where files do not say.", metavar="RATE|CAMERA=RATE")
    start: list[str] | None = option(
        TIME, "When its first frame was taken: 0.2s, or 12f frames.", metavar="CAMERA=TIME"
    )
    frames: str | None = frames_option()


@grouped
def detect(
    cameras: CameraOptions,
    pictures: PictureOptions,
    network: NetworkOptions,
    clock: ClockOptions,
    project: Path | None = option(INPUT, "A Pose2Sim project: its cameras and videos; detections go into pose/."),
    output: Path | None = option(RESULT, "Folder for the detections; made if it is not there."),
) -> None:
    """Detect people's joints in videos or pictures, for `reconstruct`: candidates with part affinities.

    Pictures of rolled cameras are turned upright first; the calibration knows how. A run that is stopped goes on
    where it was when it is started again.
    """
    network.check()
    if project is not None:
        from shapepose_fg.io.pose2sim_project import footage_of

        calibration, videos, pose = footage_of(project)
        cameras = replace(cameras, calibration=cameras.calibration or calibration)
        pictures, output = replace(pictures, videos=pictures.videos or [str(videos)]), output or pose
    if pictures.videos is None or output is None:
        option_missing = "--videos" if pictures.videos is None else "--output"
        raise InputError(
            f"{option_missing}: missing; give the cameras' videos or pictures, and a folder to write to"
        )
    from shapepose_fg.detection2d.detector import CameraDetector
    from shapepose_fg.detection2d.recording import DetectionRun, run_detection
    from shapepose_fg.io.footage.lockstep import align, clocks_of
    from shapepose_fg.io.footage.placement import placements_of

    rig = cameras.rig()
    loaded = network.load()
    footage = pictures.opened(rig)
    sizes = {name: each.size for name, each in zip(rig.names, footage, strict=True)}
    placements, concluded = placements_of(pictures.image_placement or [], sizes, rig)
    note(*concluded)
    moments = align(*clocks_of(footage, clock.fps or [], clock.start or [], rig.names))
    span = frame_range(clock.frames, len(moments))
    part = slice(span.start, span.stop)
    time_s = None if moments.time_s is None else moments.time_s[part]
    moments = replace(moments, picture=moments.picture[part], time_s=time_s)
    note(*moments.notes)
    detectors = [
        CameraDetector.of(camera, rig.up_vector, placements[camera.name], loaded, network.long_side)
        for camera in rig.cameras
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
            note(f"camera {name}: {failed} of {report.moments} pictures cannot be read; nothing is detected there")
    show(_summary(run, report, time.perf_counter() - begin))
    print(_next_command(output, cameras, project))


def _shown_small(detectors: "Sequence[CameraDetector]", size: tuple[int, int]) -> str:
    """How large a network that takes one size only is shown the pictures."""
    smallest = min(detector.view.scale for detector in detectors)
    return (
        f"here the network takes pictures of {size[0]} x {size[1]} only, so they are shown to it at down to"
        f" {100 * smallest:.0f} % of their size; --backend opencv takes any"
    )


def _summary(run: "DetectionRun", report: "DetectionReport", seconds: float) -> "Table":
    """What was detected in each camera's pictures, and how long it took."""
    rows = []
    for view, (name, footage, detector) in enumerate(zip(run.rig.names, run.footage, run.detectors, strict=True)):
        pictures = int((run.moments.picture[:, view] >= 0).sum()) - report.unreadable[view]
        turned, size = detector.view.turn_deg, detector.view.size
        row = (name, str(pictures), f"{footage.size[0]} x {footage.size[1]}")
        row += (f"{turned:.0f}°" if abs(turned) > 0.5 else "-", f"{size[0]} x {size[1]}")
        rows.append((*row, f"{report.candidates[view] / max(pictures, 1):.1f}"))
    total = max(report.moments * len(run.rig), 1)
    speed = f"{seconds:.1f} s, {1e3 * seconds / total:.0f} ms a picture"
    caption = f"{report.moments} frames of {len(run.rig)} cameras in {speed}"
    return table("camera pictures size turned network candidates".split(), rows, caption=caption)


def _next_command(output: Path, cameras: CameraOptions, project: Path | None) -> str:
    """How to go on, as a line to copy, wherever it is pasted."""
    import shlex

    files = {
        "--calibration": cameras.calibration,
        "--detections": output,
        "--output": output.resolve().parent / "results",
    }
    if project is not None and output.resolve().parent == project.resolve():
        files = {"--project": project}
    options = {name: file.resolve() for name, file in files.items() if file is not None}
    options |= {"--up": cameras.up, "--unit": cameras.unit, "--image-size": cameras.image_size}
    words = [word for name, value in options.items() if value is not None for word in (name, str(value))]
    return f"next: {shlex.join(['shapepose-fg', 'reconstruct', *words])}"
