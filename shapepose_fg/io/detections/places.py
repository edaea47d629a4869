"""Which files of a folder are which camera's."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.camera_names import match_names
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
    for patterns in dict.fromkeys(each.names for each in FORMATS):
        found = [_named(folder, name, patterns) for name in rig.names]
        if any(each is not None for each in found):
            places = [
                each or folder / patterns[0].format(name) for each, name in zip(found, rig.names, strict=True)
            ]
            for name, each in zip(rig.names, places, strict=True):
                if not each.exists():
                    raise InputError(
                        f'{each}: the detections of camera "{name}" are missing, {folder} holds {_listing(folder)};'
                        " add them, or take the camera out of the calibration"
                    )
            return Places(places)
    alike = _alike(folder, rig)
    if alike is None:
        names = " ".join(rig.names)
        raise InputError(
            f"{folder}: no detections of the cameras {names} here, only {_listing(folder)}; {_EXPECTED}"
        )
    return alike


def _named(folder: Path, name: str, patterns: Sequence[str]) -> Path | None:
    """What is called after a camera: a file, or a folder where the pattern has no ending."""
    for pattern in patterns:
        place = folder / pattern.format(name)
        if place.is_file() if Path(pattern).suffix else place.is_dir():
            return place
    return None


def _alike(folder: Path, rig: Rig) -> Places | None:
    """Folders or files that have the cameras' names in theirs (`walk_Miqus_1_23087_json` of camera `23087`), or
    the cameras' numbers (`cam01_json` of camera `int_cam1`).

    Only where it is so for every camera, and nothing else could be meant: else nothing is guessed.
    """
    offered = [each for each in sorted(folder.iterdir()) if each.is_dir() or each.suffix == ".json"]
    offered = [each for each in offered if not each.name.startswith(".")]
    names = [each.name.removesuffix(".json").removesuffix("_json") for each in offered]
    chosen = match_names(rig.names, names)
    if chosen is None:
        return None
    places = [offered[index] for index in chosen]
    pairs = ", ".join(f"{name} is {place.name}" for name, place in zip(rig.names, places, strict=True))
    return Places(places, (f"{folder}: cameras were told by parts of the names: {pairs}",))


def _listing(folder: Path) -> str:
    """The first names in a folder, for a message."""
    names = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    return (" ".join(names[:8]) or "nothing") + (f" and {len(names) - 8} more" if len(names) > 8 else "")
