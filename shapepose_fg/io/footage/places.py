"""Which video or folder of pictures is which camera's."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.camera_names import match_names

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
    pairs = [_pair(text) for text in given]
    if all(pair is None for pair in pairs) and len(given) == 1:
        return _in_folder(Path(given[0]), cameras)
    named: dict[str, Path] = {}
    for text, pair in zip(given, pairs, strict=True):
        if pair is None:
            raise InputError(f"--videos {text}: give one folder, or CAMERA=PATH for each camera, not both")
        name, path = pair
        if name not in cameras:
            raise InputError(
                f"--videos {text}: the calibration has no camera {name!r}; it has {' '.join(cameras)}"
            )
        if name in named:
            raise InputError(f"--videos {text}: camera {name} is given twice; give each its own")
        named[name] = path
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


def _pair(text: str) -> tuple[str, Path] | None:
    """Camera and path of CAMERA=PATH; None where `text` is a path alone."""
    name, separator, path = text.partition("=")
    return (name.strip(), Path(path)) if separator and not Path(text).exists() else None


def _in_folder(folder: Path, cameras: Sequence[str]) -> FootagePlaces:
    """What a folder holds of each camera, told by the names."""
    if folder.is_file():
        raise InputError(
            f"{folder}: this is one file; give the folder with the footage of all cameras, or CAMERA=PATH for each"
        )
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; check the path of the videos")
    offered = _offered(folder)
    names = [_name(each) for each in offered]
    exact = [[path for path, name in zip(offered, names, strict=True) if name == camera] for camera in cameras]
    for camera, found in zip(cameras, exact, strict=True):
        if len(found) > 1:
            what = " and ".join(path.name for path in found)
            raise InputError(
                f"{folder}: {what} could all be camera {camera}'s; give --videos {camera}=PATH for each"
            )
    if all(len(found) == 1 for found in exact):
        return FootagePlaces(tuple(found[0] for found in exact))
    if all(len(found) == 0 for found in exact):
        chosen = match_names(cameras, names)
        if chosen is not None:
            paths = tuple(offered[index] for index in chosen)
            told = ", ".join(f"{camera} is {path.name}" for camera, path in zip(cameras, paths, strict=True))
            return FootagePlaces(paths, (f"{folder}: cameras were told by parts of the names: {told}",))
        inner = [folder / name for name in _INNER if (folder / name).is_dir()]
        if len(inner) == 1:
            return _in_folder(inner[0], cameras)
    missing = next(camera for camera, found in zip(cameras, exact, strict=True) if len(found) == 0)
    holds = " ".join(path.name for path in offered[:8]) or "no video, picture or folder of pictures"
    more = f" and {len(offered) - 8} more" if len(offered) > 8 else ""
    raise InputError(
        f"{folder}: nothing here is named after camera {missing}, it holds {holds}{more}; name a video or a folder"
        f" of pictures after each camera, or give --videos {missing}=PATH for each"
    )


def _offered(folder: Path) -> list[Path]:
    """Videos, pictures, and folders that hold pictures, in the order of their names."""
    entries = [each for each in sorted(folder.iterdir()) if not each.name.startswith(".")]
    return [each for each in entries if _is_footage(each)]


def _is_footage(path: Path) -> bool:
    if path.is_dir():
        return any(each.suffix.lower() in PICTURES for each in path.iterdir())
    return path.suffix.lower() in VIDEOS | PICTURES


def _name(path: Path) -> str:
    """What is compared with a camera's name."""
    return path.name if path.is_dir() else path.stem
