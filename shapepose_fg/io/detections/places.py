"""Which files of a folder are which camera's."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.camera_names import match_names

_EXPECTED = (
    "give the folder with <camera>.txt (4D Association), <camera>/ or <camera>_json/ with a JSON file per frame"
    " (OpenPose, Pose2Sim, MMPose), or <camera>.json (COCO's results, AlphaPose, MMPose)"
)


@dataclass(frozen=True)
class Places:
    """Where each camera's detections are."""

    kind: Literal["text", "people"]
    """Whether they are 4D Association's text, or people in JSON."""
    paths: Sequence[Path]
    """A file or folder for each camera of the rig, in its order."""
    notes: tuple[str, ...] = ()
    """What was taken to be what."""


def find_places(path: Path, rig: Rig) -> Places:
    """Find every camera's detections in the folder `path`; InputError naming the camera that is missing."""
    folder = _folder(path)
    texts = [folder / f"{name}.txt" for name in rig.names]
    if any(text.is_file() for text in texts):
        _complete(texts, rig, folder)
        return Places("text", texts)
    found = [_named(folder, name) for name in rig.names]
    if all(each is None for each in found):
        alike = _alike(folder, rig)
        if alike is not None:
            return alike
        names = " ".join(rig.names)
        raise InputError(
            f"{folder}: no detections of the cameras {names} here, only {_listing(folder)}; {_EXPECTED}"
        )
    places = [each or folder / name for each, name in zip(found, rig.names, strict=True)]
    _complete(places, rig, folder)
    return Places("people", places)


def _folder(path: Path) -> Path:
    """The folder that holds the detections of `path`."""
    if path.is_file():
        raise InputError(f"{path}: this is a file; give the folder that holds the detections of all cameras")
    if not path.is_dir():
        raise InputError(f"{path}: there is no such folder; check the path of the detections")
    inner = path / "detection"
    return inner if inner.is_dir() else path


def _named(folder: Path, name: str) -> Path | None:
    """What is called after a camera: its folder, or the file with all its frames."""
    for candidate in (folder / name, folder / f"{name}_json"):
        if candidate.is_dir():
            return candidate
    for file in (f"{name}.json", f"results_{name}.json", f"{name}_results.json", f"alphapose-results_{name}.json"):
        if (folder / file).is_file():
            return folder / file
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
    return Places("people", places, (f"{folder}: cameras were told by parts of the names: {pairs}",))


def _complete(places: list[Path], rig: Rig, folder: Path) -> None:
    """Refuse a recording in which a camera of the rig is missing."""
    for name, place in zip(rig.names, places, strict=True):
        if not place.exists():
            raise InputError(
                f'{place}: the detections of camera "{name}" are missing, {folder} holds {_listing(folder)};'
                " add them, or take the camera out of the calibration"
            )


def _listing(folder: Path) -> str:
    """The first names in a folder, for a message."""
    names = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    if len(names) == 0:
        return "nothing"
    return " ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
