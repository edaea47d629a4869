"""Which files of a folder are which camera's."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.camera_names import listing, told_by_parts
from shapepose_fg.io.detections.formats import FORMATS

_EXPECTED = (
    "give the folder with <camera>.txt (4D Association), <camera>/ or <camera>_json/ with a JSON file per frame"
    " (OpenPose, Pose2Sim, MMPose), or <camera>.json (COCO's results, AlphaPose, MMPose)"
)


@dataclass(frozen=True)
class Places:
    """Where each camera's detections are."""

    paths: Sequence[Path]
    """A file or folder for each camera of the rig, in its order."""
    notes: tuple[str, ...] = ()
    """What was taken to be what."""


def find_places(path: Path, rig: Rig) -> Places:
    """Find every camera's detections in the folder `path`; InputError naming the camera that is missing."""
    if path.is_file():
        raise InputError(f"{path}: this is a file; give the folder that holds the detections of all cameras")
    if not path.is_dir():
        raise InputError(f"{path}: there is no such folder; check the path of the detections")
    folder = path / "detection" if (path / "detection").is_dir() else path
    entries = sorted(each for each in folder.iterdir() if not each.name.startswith("."))
    holds = listing([each.name for each in entries])
    for patterns in dict.fromkeys(each.names for each in FORMATS):
        found = [_named(folder, name, patterns) for name in rig.names]
        missing = [name for name, place in zip(rig.names, found, strict=True) if place is None]
        if len(missing) < len(rig):
            if missing:
                raise InputError(
                    f'{folder / patterns[0].format(missing[0])}: the detections of camera "{missing[0]}" are'
                    f" missing, {folder} holds {holds}; add them, or take the camera out of the calibration"
                )
            return Places([place for place in found if place is not None])
    # `walk_Miqus_1_23087_json` of camera `23087`, `cam01_json` of camera `int_cam1`.
    offered = [each for each in entries if each.is_dir() or each.suffix == ".json"]
    names = [each.name.removesuffix(".json").removesuffix("_json") for each in offered]
    told = told_by_parts(folder, rig.names, offered, names)
    if told is None:
        raise InputError(
            f"{folder}: no detections of the cameras {' '.join(rig.names)} here, only {holds}; {_EXPECTED}"
        )
    return Places(told[0], (told[1],))


def _named(folder: Path, name: str, patterns: Sequence[str]) -> Path | None:
    """What is called after a camera: a file, or a folder where the pattern has no ending."""
    for pattern in patterns:
        place = folder / pattern.format(name)
        if place.is_file() if Path(pattern).suffix else place.is_dir():
            return place
    return None
