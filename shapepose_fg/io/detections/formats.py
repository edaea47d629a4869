"""The formats of 2D detections that are known. One of your own is an entry in `FORMATS` and a function that reads
it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from shapepose_fg.core.camera import Camera
from shapepose_fg.io.detections.association_text import read_association_text
from shapepose_fg.io.detections.frame_files import read_frame_files
from shapepose_fg.io.detections.one_file import is_one_file, read_one_file
from shapepose_fg.io.detections.people import CameraPeople
from shapepose_fg.io.detections.view_streams import ViewStream


@dataclass(frozen=True)
class Format:
    """One way in which detections are written: a file or folder per camera."""

    name: str
    """For messages and documents."""
    names: tuple[str, ...]
    """What a camera's file, or without an ending its folder, is called; {} is the camera."""
    recognise: Callable[[Path], bool]
    """Whether a file or folder that is called so is meant to be of this format, though it may be faulty."""
    read: Callable[[Path, Camera], CameraPeople | ViewStream]
    """What a camera saw: people, or candidates with affinities; InputError naming file, place and cure."""


_JSON = (
    "{}", "{}_json", "{}.json", "results_{}.json", "{}_results.json", "alphapose-results_{}.json",
)  # fmt: skip
FORMATS = [
    Format("4D Association's text", ("{}.txt",), lambda place: place.suffix == ".txt", read_association_text),
    Format(
        "COCO's keypoint results, AlphaPose's JSON, MMPose's JSON of a video",
        _JSON,
        is_one_file,
        lambda place, camera: read_one_file(place),
    ),
    Format(
        "a JSON file per frame of OpenPose, Pose2Sim or MMPose",
        _JSON,
        Path.is_dir,
        lambda place, camera: read_frame_files(place),
    ),
]
"""The first that recognises a camera's file or folder reads it."""
