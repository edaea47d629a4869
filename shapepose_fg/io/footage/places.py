"""Finds the video or folder of pictures of each camera."""

from collections.abc import Sequence
from pathlib import Path

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.camera_names import composed, listing, match_by_parts

VIDEOS = frozenset(".mp4 .m4v .mov .avi .mkv .webm .mpg .mpeg .ts .mts .m2ts .wmv".split())
"""File extensions of videos."""
PICTURES = frozenset(".jpg .jpeg .png .bmp .tif .tiff .webp".split())
"""File extensions of pictures."""
_INNER = ("videos", "images", "video", "image")
"""Names of subfolders with footage in other programs' projects."""


def per_camera(
    option: str, given: Sequence[str], cameras: Sequence[str], *, one_for_all: bool = False
) -> list[str | None]:
    """(V,) the value of an option for each camera: CAMERA=VALUE, or if `one_for_all` is set one
    VALUE for all.

    InputError for unknown cameras, and for duplicates.
    """
    values: dict[str, str] = {}
    rest: str | None = None
    for text in given:
        cuts = [place for place, letter in enumerate(text) if letter == "="]
        cut = next((place for place in cuts if text[:place] in cameras), cuts[0] if cuts else None)
        if cut is None and one_for_all and rest is None:
            rest = text
            continue
        if cut is None:
            raise InputError(
                f"{option} {text}: must be CAMERA=VALUE, such as {option} {cameras[0]}=VALUE"
            )
        name = text[:cut]
        if name not in cameras:
            known = " ".join(cameras)
            raise InputError(f"{option} {text}: there is no camera {name!r}; there are {known}")
        if name in values:
            raise InputError(f"{option} {text}: camera {name} is given twice; give it once")
        values[name] = text[cut + 1 :]
    return [values.get(name, rest) for name in cameras]


def find_footage(given: Sequence[str], cameras: Sequence[str]) -> tuple[list[Path], list[str]]:
    """A video, a picture, or a folder of pictures for each camera, and notes on inferred names.

    `given` is one folder with an entry named after each camera, or CAMERA=PATH for each of them.
    InputError naming the camera that is missing, or what is ambiguous.
    """
    if len(given) == 1 and ("=" not in given[0] or Path(given[0]).exists()):
        return _in_folder(Path(given[0]), cameras)
    named = dict(zip(cameras, per_camera("--videos", given, cameras), strict=True))
    for name, path in named.items():
        if path is None:
            raise InputError(
                f"--videos: there is no footage for camera {name}; add --videos {name}=PATH, or "
                "leave the camera out with --without"
            )
        if not Path(path).exists():
            raise InputError(f"{path}: there is no such file or folder; check the path")
    return [Path(path or "") for path in named.values()], []


def names_of_footage(given: Sequence[str]) -> list[str]:
    """Names of cameras from the arguments of `find_footage`: the names before `=`, or the videos of
    a folder, or its other footage if it has no videos. InputError if there are none.
    """
    if len(given) > 1 or ("=" in given[0] and not Path(given[0]).exists()):
        return [text.partition("=")[0] for text in given]
    folder = Path(given[0])
    entries = sorted(folder.iterdir()) if folder.is_dir() else []
    offered = [each for each in entries if not each.name.startswith(".") and _is_footage(each)]
    videos = [each for each in offered if each.suffix.lower() in VIDEOS] or offered
    if len(videos) == 0:
        raise InputError(
            f"{folder}: there are no videos or pictures; give the folder with those of all cameras"
        )
    return [each.name if each.is_dir() else each.stem for each in videos]


def _in_folder(folder: Path, cameras: Sequence[str]) -> tuple[list[Path], list[str]]:
    """The entries of a folder for each camera, by their names: videos, pictures, and folders with
    pictures.
    """
    if folder.is_file():
        raise InputError(
            f"{folder}: this is one file; give the folder with the footage of all cameras, or "
            "CAMERA=PATH for each"
        )
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; check the path")
    entries = [each for each in sorted(folder.iterdir()) if not each.name.startswith(".")]
    offered = [each for each in entries if _is_footage(each)]
    names = [composed(each.name if each.is_dir() else each.stem) for each in offered]
    exact = [
        [path for path, name in zip(offered, names, strict=True) if name == composed(camera)]
        for camera in cameras
    ]
    for camera, found in zip(cameras, exact, strict=True):
        if len(found) > 1:
            what = " and ".join(path.name for path in found)
            raise InputError(
                f"{folder}: {what} all match camera {camera}; give --videos {camera}=PATH for each"
            )
    if all(exact):
        return [found[0] for found in exact], []
    if not any(exact):
        matched = match_by_parts(folder, cameras, offered, names)
        if matched is not None:
            return matched
        inner = [folder / name for name in _INNER if (folder / name).is_dir()]
        if len(inner) == 1:
            return _in_folder(inner[0], cameras)
    missing = next(camera for camera, found in zip(cameras, exact, strict=True) if len(found) == 0)
    holds = listing([path.name for path in offered], "no video, picture or folder of pictures")
    cure = (
        "name a video or a folder of pictures after each camera, or give --videos "
        f"{missing}=PATH for each"
    )
    raise InputError(
        f"{folder}: nothing in it is named after camera {missing}; it contains {holds}; {cure}"
    )


def _is_footage(path: Path) -> bool:
    if path.is_dir():
        return any(each.suffix.lower() in PICTURES for each in path.iterdir())
    return path.suffix.lower() in VIDEOS | PICTURES
