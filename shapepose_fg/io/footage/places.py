"""Which video or folder of pictures is which camera's."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.camera_names import listing, told_by_parts

VIDEOS = frozenset(".mp4 .m4v .mov .avi .mkv .webm .mpg .mpeg .ts .mts .m2ts .wmv".split())
"""Endings of videos."""
PICTURES = frozenset(".jpg .jpeg .png .bmp .tif .tiff .webp".split())
"""Endings of pictures."""
_INNER = ("videos", "images", "video", "image")
"""Folders in which other programs' projects keep their footage."""


@dataclass(frozen=True)
class FootagePlaces:
    """Where each camera's footage is."""

    paths: tuple[Path, ...]
    """A video, a picture, or a folder of pictures for each camera, in their order."""
    notes: tuple[str, ...] = ()
    """What was taken to be what."""


def find_footage(given: Sequence[str], cameras: Sequence[str]) -> FootagePlaces:
    """Find every camera's footage.

    `given` is one folder that holds something named after each camera, or CAMERA=PATH for each of them.
    InputError naming the camera that is missing, or what could be meant twice.
    """
    named: dict[str, Path] = {}
    for text in given:
        name, separator, path = text.partition("=")
        name = name.strip()
        if not separator or Path(text).exists():
            if len(given) == 1:
                return _in_folder(Path(text), cameras)
            raise InputError(f"--videos {text}: give one folder, or CAMERA=PATH for each camera, not both")
        if name not in cameras:
            raise InputError(
                f"--videos {text}: the calibration has no camera {name!r}; it has {' '.join(cameras)}"
            )
        if name in named:
            raise InputError(f"--videos {text}: camera {name} is given twice; give each its own")
        named[name] = Path(path)
    missing = [name for name in cameras if name not in named]
    if len(missing) > 0:
        raise InputError(
            f"--videos: nothing is given for camera {missing[0]}; add --videos {missing[0]}=PATH, or take the"
            " camera out of the calibration"
        )
    for path in named.values():
        if not path.exists():
            raise InputError(f"{path}: there is no such file or folder; check the path")
    return FootagePlaces(tuple(named[name] for name in cameras))


def _in_folder(folder: Path, cameras: Sequence[str]) -> FootagePlaces:
    """What a folder holds of each camera, told by the names: videos, pictures, and folders that hold pictures."""
    if folder.is_file():
        raise InputError(
            f"{folder}: this is one file; give the folder with the footage of all cameras, or CAMERA=PATH for each"
        )
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; check the path of the videos")
    entries = [each for each in sorted(folder.iterdir()) if not each.name.startswith(".")]
    offered = [each for each in entries if _is_footage(each)]
    names = [each.name if each.is_dir() else each.stem for each in offered]
    exact = [[path for path, name in zip(offered, names, strict=True) if name == camera] for camera in cameras]
    for camera, found in zip(cameras, exact, strict=True):
        if len(found) > 1:
            what = " and ".join(path.name for path in found)
            raise InputError(
                f"{folder}: {what} could all be camera {camera}'s; give --videos {camera}=PATH for each"
            )
    if all(exact):
        return FootagePlaces(tuple(found[0] for found in exact))
    if not any(exact):
        told = told_by_parts(folder, cameras, offered, names)
        if told is not None:
            return FootagePlaces(told[0], (told[1],))
        inner = [folder / name for name in _INNER if (folder / name).is_dir()]
        if len(inner) == 1:
            return _in_folder(inner[0], cameras)
    missing = next(camera for camera, found in zip(cameras, exact, strict=True) if len(found) == 0)
    holds = listing([path.name for path in offered], "no video, picture or folder of pictures")
    raise InputError(
        f"{folder}: nothing here is named after camera {missing}, it holds {holds}; name a video or a folder"
        f" of pictures after each camera, or give --videos {missing}=PATH for each"
    )


def _is_footage(path: Path) -> bool:
    if path.is_dir():
        return any(each.suffix.lower() in PICTURES for each in path.iterdir())
    return path.suffix.lower() in VIDEOS | PICTURES
