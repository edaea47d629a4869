"""Camera names and frame numbers from file names."""

import re
import unicodedata
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from shapepose_fg.core.errors import InputError

MOST_FRAME = 10**12
"""Maximum frame number."""
_WORDS = re.compile(r"[^\W\d_]+|\d{1,18}", re.ASCII)
_NUMBERS = re.compile(r"\d+")


def composed(name: str) -> str:
    """A name with composed letters (Unicode NFC). macOS writes decomposed ones, which look the
    same.
    """
    return unicodedata.normalize("NFC", name)


def in_any_form(place: Path) -> Path:
    """The path, or the entry of its folder that has the same name in another Unicode form."""
    if place.name.isascii() or place.exists() or not place.parent.is_dir():
        return place
    entries = place.parent.iterdir()
    return next((each for each in entries if composed(each.name) == composed(place.name)), place)


def match_names(cameras: Sequence[str], names: Sequence[str]) -> list[int] | None:
    """For each camera, the index of its name among `names`, which may be longer or spelled
    differently.

    A name belongs to a camera if it contains the camera's name as a word (`walk_Miqus_1_23087` is
    camera `23087`), if both have only one number and it is equal (`cam01` is camera `int_cam1`), or
    if both are equal after removing the words with which all cameras, or all names, begin and end
    (`2022-09-19_synced_Cam1` is `view_01_json`). None if a camera has no match or several: nothing
    is guessed.
    """
    cameras, names = ([composed(each) for each in listed] for listed in (cameras, names))
    words = [
        re.compile(rf"(?<![A-Za-z0-9]){re.escape(camera)}(?![A-Za-z0-9])") for camera in cameras
    ]
    found = [
        [index for index, name in enumerate(names) if word.search(name) is not None]
        for word in words
    ]
    if all(len(each) == 1 for each in found) and len({each[0] for each in found}) == len(found):
        return [each[0] for each in found]
    for part in (_one_number_each, _own_words):
        wanted, offered = part(cameras), part(names)
        if wanted is not None and offered is not None and set(wanted) <= set(offered):
            return [offered.index(each) for each in wanted]
    return None


def _own_words(names: Sequence[str]) -> list[tuple[str | int, ...]] | None:
    """Words and numbers of each name, in lower case, without those with which all names begin or
    end; None if a name has no words left, or if two are equal.
    """
    words = [
        [int(word) if word.isdigit() else word for word in _WORDS.findall(name.lower())]
        for name in names
    ]
    for _ in range(2):  # from the beginning, then from the end
        while all(each and each[0] == words[0][0] for each in words) and len(words) > 1:
            words = [each[1:] for each in words]
        words = [each[::-1] for each in words]
    found = [tuple(each) for each in words]
    return found if all(found) and len(set(found)) == len(found) else None


def _one_number_each(names: Sequence[str]) -> list[tuple[str | int, ...]] | None:
    """The only number in each name; None if a name has none or several, or if two are equal."""
    found = [_NUMBERS.findall(name) for name in names]
    if any(len(each) != 1 for each in found):
        return None
    numbers: list[tuple[str | int, ...]] = [(int(each[0]),) for each in found]
    return numbers if len(set(numbers)) == len(numbers) else None


def match_by_parts(
    folder: Path, cameras: Sequence[str], paths: Sequence[Path], names: Sequence[str]
) -> tuple[list[Path], list[str]] | None:
    """Identify each camera's path among `paths` by its name among `names` (`match_names`); returns
    the paths and a note. None if the names do not identify the cameras.
    """
    chosen = match_names(cameras, names)
    if chosen is None:
        return None
    found = [paths[index] for index in chosen]
    pairs = ", ".join(
        f"{camera} is {path.name}" for camera, path in zip(cameras, found, strict=True)
    )
    return found, [f"{folder}: cameras were matched by parts of the file names: {pairs}"]


def listing(names: Sequence[str], nothing: str = "nothing") -> str:
    """The first few of some names, for a message; `nothing` if there are none."""
    return (" ".join(names[:8]) or nothing) + (
        f" and {len(names) - 8} more" if len(names) > 8 else ""
    )


def last_number(name: str) -> int | None:
    """The last number in a picture's name, which is the frame number; at most `MOST_FRAME`, None if
    there is none.
    """
    found = _NUMBERS.findall(name)
    return min(int(found[-1][-1000:]), MOST_FRAME) if found else None


def numbered(folder: Path, ending: str) -> list[tuple[int, Path]]:
    """The files of a folder with names that end with a frame number and the pattern `ending`, in
    capitals or not, sorted by number.
    """
    # macOS writes ._000000_keypoints.json beside each copied file.
    files = (
        [each for each in folder.iterdir() if not each.name.startswith(".")]
        if folder.is_dir()
        else []
    )
    found = ((re.search(rf"(\d+){ending}$", each.name, re.IGNORECASE), each) for each in files)
    return sorted(
        (int(match[1]), each) for match, each in found if match is not None and each.is_file()
    )


def in_order(files: Sequence[tuple[int, Path]]) -> list[tuple[int, Path]]:
    """Files sorted by their frame numbers; InputError if a number is invalid or occurs twice."""
    ordered = sorted(files)
    if ordered[-1][0] >= MOST_FRAME:
        raise InputError(
            f"{ordered[-1][1]}: this frame number is too large; number the files by the frames "
            "of the recording"
        )
    for (number, file), (following, other) in pairwise(ordered):
        if following == number:
            raise InputError(
                f"{other}: frame {number} is also in {file.name}; keep one recording per folder"
            )
    return ordered
