"""The command `detect`: computes 2D detections in videos or pictures of calibrated or uncalibrated
cameras.
"""

import shlex
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Interval

from shapepose_fg.cli.options import (
    INPUT,
    RESULT,
    RUN,
    TIME,
    CameraOptions,
    chosen_cameras,
    frame_range,
    frames_option,
    grouped,
    next_reconstruct,
    option,
)
from shapepose_fg.cli.pictures import PictureOptions
from shapepose_fg.cli.stopping import Stopped
from shapepose_fg.cli.terminal import note, progress, show, table
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.output_folder import only_run_in

if TYPE_CHECKING:
    from rich.console import RenderableType

    from shapepose_fg.detection2d.opening import Network
    from shapepose_fg.detection2d.recording import DetectionRun

_NETWORK = "Network"


@dataclass(frozen=True, kw_only=True)
class NetworkOptions:
    """Options: the detection network, and how it is executed."""

    network: str | None = option(
        _NETWORK,
        "ONNX file, TOML file of a network, or name of a downloaded network.",
        metavar="FILE|NAME",
    )
    download: str | None = option(
        _NETWORK,
        "Download a network by name, once: rtmpose-s, rtmpose-m or rtmpose-x.",
        metavar="NAME",
    )
    boxes: str | None = option(
        _NETWORK, "Person detector for RTMPose: a YOLOX network.", metavar="FILE|NAME"
    )
    layout: str | None = option(
        _NETWORK,
        "Keypoint layout of an OpenPose network: tf-pose, openpose-coco, openpose-body25.",
        metavar="NAME",
    )
    long_side: Annotated[int, Interval(ge=128, le=4096)] | None = option(
        _NETWORK, "Longer side of the input of an OpenPose network, pixels (656)."
    )
    backend: Literal["opencv", "onnxruntime"] | None = option(
        RUN, "Backend of an OpenPose network: opencv (default) or onnxruntime."
    )
    device: str = option(
        RUN, "Device of onnxruntime: cpu, cuda, cuda:1, rocm, coreml.", "cpu", metavar="NAME"
    )

    def load(self) -> "Network":
        """The network, downloaded if requested; InputError if options contradict each other."""
        from shapepose_fg.detection2d.download import named_file, named_networks
        from shapepose_fg.detection2d.opening import open_network

        if self.network is None and self.download is None:
            raise InputError(
                "--network, --download: missing; give --download rtmpose-m the first time, or "
                "--network FILE"
            )
        if self.download is not None and self.download not in (names := named_networks()):
            raise InputError(
                f"--download {self.download}: there is no network of this name; give one of "
                f"{' '.join(names)}"
            )
        if self.network is not None and self.download not in (None, self.network, self.boxes):
            raise InputError(
                f"--download {self.download}: this is neither the name of --network nor of "
                "--boxes; leave it out"
            )
        if self.backend == "opencv" and self.device != "cpu":
            raise InputError(
                f"--device {self.device}: opencv runs on the CPU only; leave out --backend"
            )
        openpose = {"layout": self.layout, "long_side": self.long_side, "backend": self.backend}
        with progress("downloading the network", "bytes") as fetched:
            found = partial(named_file, fetch=self.download is not None, say=note, progress=fetched)
            network = self.network or self.download or ""
            return open_network(network, self.boxes, found, self.device, **openpose)


@dataclass(frozen=True, kw_only=True)
class ClockOptions:
    """Options: times of the pictures."""

    fps: list[str] | None = option(
        TIME, "Frame rate, Hz, if the files do not contain it.", metavar="RATE|CAMERA=RATE"
    )
    start: list[str] | None = option(
        TIME, "Time of a camera's first frame: 0.2s, or 12f.", metavar="CAMERA=TIME"
    )
    frames: str | None = frames_option()


@grouped
def detect(
    cameras: CameraOptions,
    pictures: PictureOptions,
    network: NetworkOptions,
    clock: ClockOptions,
    project: Path | None = option(
        INPUT, "Pose2Sim project: use its cameras and videos, write detections into pose/."
    ),
    output: Path | None = option(RESULT, "Folder for the detections; created if missing."),
) -> None:
    """Detect people's joints in videos or pictures, for `reconstruct`: by RTMPose, or another
    network in ONNX.

    With a calibration, pictures of rolled cameras are rotated upright first. Without one, cameras
    are named after their videos, for `calibrate`. An interrupted run continues when the same
    command is started again.
    """
    if project is not None:
        from shapepose_fg.io.pose2sim_project import footage_of

        calibration, videos, pose = footage_of(project)
        cameras = replace(cameras, calibration=cameras.calibration or calibration)
        pictures, output = (
            replace(pictures, videos=pictures.videos or [str(videos)]),
            output or pose,
        )
    if pictures.videos is None or output is None:
        missing = "--videos" if pictures.videos is None else "--output"
        raise InputError(
            f"{missing}: missing; give it, or --project with the folder of a Pose2Sim project"
        )
    from shapepose_fg.core.frame_sets import align, own_frames
    from shapepose_fg.detection2d.recording import CameraDetector, DetectionRun, run_detection
    from shapepose_fg.io.footage.clocks import clocks_of
    from shapepose_fg.io.footage.placement import FOOTAGE, placements_of
    from shapepose_fg.io.lenses import pictures_only

    known = cameras.rig() if cameras.calibration is not None else None
    loaded = network.load()
    opened = pictures.opened(
        chosen_cameras(pictures.names(), cameras.cameras, cameras.without)
        if known is None
        else known.names
    )
    footage, sizes = list(opened.values()), {name: each.size for name, each in opened.items()}
    rig = known or pictures_only(list(sizes), list(sizes.values()))
    placements, concluded = placements_of(pictures.image_placement or [], sizes, rig)
    note(*concluded)
    clocks = clocks_of(footage, clock.fps or [], clock.start or [], rig.names)
    # Pictures with the same number belong together. Start times of videos are known only if the
    # user gives them.
    timed = clock.start is not None or all(each.path.is_dir() for each in footage)
    moments = align(*clocks) if timed else own_frames(*clocks)
    span = frame_range(clock.frames, len(moments))
    time_s = None if moments.time_s is None else moments.time_s[span]
    moments = replace(moments, picture=moments.picture[span], time_s=time_s)
    note(*moments.notes)
    detectors = [
        CameraDetector.of(camera, rig.up_vector, each, placements[camera.name], loaded)
        for camera, each in zip(rig.cameras, footage, strict=True)
    ]
    run = DetectionRun(detectors, moments, output)
    files = [f"{name}{suffix}" for name in rig.names for suffix in (".txt", ".json")]
    begin = time.perf_counter()
    with only_run_in(output, (*files, FOOTAGE)), progress("detecting", "pictures") as done:
        try:
            joints, unreadable = run_detection(run, done)
        except Stopped as stop:
            raise Stopped(stop.number, "run the same command again to continue") from None
    for name, failed in zip(rig.names, unreadable, strict=True):
        if failed > 0:
            note(
                f"camera {name}: {failed} of {len(moments)} pictures cannot be read; they have "
                "no detections"
            )
    show(_summary(run, joints, unreadable, time.perf_counter() - begin))
    print(_next_command(run, cameras, project, loaded))


def _summary(
    run: "DetectionRun", joints: list[int], unreadable: list[int], seconds: float
) -> "RenderableType":
    """Number of detections in each camera's pictures, and the time taken."""
    rows = []
    for view, each in enumerate(run.cameras):
        pictures = int((run.moments.picture[:, view] >= 0).sum()) - unreadable[view]
        turned = f"{each.view.turn_deg:.0f}°" if abs(each.view.turn_deg) > 0.5 else "-"
        size, shown = (
            f"{width} x {height}" for width, height in (each.footage.size, each.view.size)
        )
        found = f"{joints[view] / max(pictures, 1):.1f}"
        rows.append((each.camera.name, str(pictures), size, turned, shown, found))
    frames, views = run.moments.picture.shape
    speed = f"{1e3 * seconds / max(frames * views, 1):.0f} ms a picture"
    caption = f"{frames} frames of {views} cameras in {seconds:.1f} s, {speed}"
    return table("camera pictures size rotated input joints".split(), rows, caption=caption)


def _next_command(
    run: "DetectionRun", cameras: CameraOptions, project: Path | None, network: "Network"
) -> str:
    """The next command, as a line that can be copied into any shell."""
    output = run.output
    if cameras.calibration is None:
        folder = output.resolve()
        words = ["shapepose-fg", "calibrate", "--detections", folder, "--focal"]
        words += ["--field-of-view", "65"]  # of a phone, along the longer side of a video
        words += [
            "--times",
            folder.parent / "times.csv",
            "--output",
            folder.parent / "calibration.json",
        ]
        return f"next: {shlex.join(map(str, words))}"
    results = output.resolve().parent / "results"
    files = {"--calibration": cameras.calibration, "--detections": output, "--output": results}
    if project is not None and output.resolve().parent == project.resolve():
        files = {"--project": project}
    skeleton = Path(network.settings["network"].get("skeleton") or "")
    files |= {"--skeleton": skeleton} if skeleton.is_file() else {}
    options = {name: file.resolve() for name, file in files.items() if file is not None}
    return next_reconstruct(options | cameras.calibration_options())
