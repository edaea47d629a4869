"""Finds the pictures of a result, and the picture of each of its frames."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.core.arrays import Index
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.run_summary import MOST_FRAMES
from shapepose_fg.io.footage.footage import Footage, open_footage
from shapepose_fg.io.footage.placement import (
    FOOTAGE,
    CameraFootage,
    placements_of,
    read_used_footage,
)
from shapepose_fg.io.footage.places import find_footage


def pictures_of(
    run: Mapping[str, Any],
    rig: Rig,
    drawn: Sequence[str],
    videos: Sequence[str] | None = None,
    detections: Path | None = None,
    image_placement: Sequence[str] = (),
    moments: Mapping[str, Index] | None = None,
    open_one: Callable[[str, Path], Footage] = lambda _, path: open_footage(path),
    notify: Callable[[str], None] = print,
) -> list[tuple[CameraFootage, Footage]]:
    """The pictures of the cameras `drawn`, with the picture of each frame; InputError if they are
    missing.

    `run` is the content of the result's run.json. Pictures are in `videos` (arguments of
    `find_footage`), at the paths that `detect` wrote into the folder `detections`, or beside the
    inputs of the result. `image_placement` (arguments of `placements_of`) states how pictures of
    another size than the calibration's were made. `moments` has, by camera, (T,) the number of its
    own frame in each frame of the result, if these differ (`read_moments`). `open_one` opens the
    pictures of a camera by name and path; `notify` receives notes on inferred files.
    """
    used = {each.name: each for each in _used_footage(run, detections)}
    unknown = [name for name in drawn if name not in used]
    notes: list[str] = []
    if videos is not None:
        places, notes = find_footage(videos, drawn)
        paths = dict(zip(drawn, places, strict=True))
    elif len(unknown) > 0:
        raise InputError(
            f"the pictures of camera {unknown[0]} are unknown; give --videos, or with "
            "--detections the folder that `shapepose-fg detect` wrote"
        )
    else:
        paths = {name: used[name].path for name in drawn}
    for name, path in paths.items():
        if not path.exists():
            raise InputError(
                f"{path}: the pictures of camera {name} are not there any more; give --videos"
            )
    opened = {name: open_one(name, path) for name, path in paths.items()}
    # The placement recorded by `detect` is valid as long as the pictures have the same size.
    matching = {
        name: used[name].placement
        for name, each in opened.items()
        if name in used and used[name].placement.picture_size == each.size and not image_placement
    }
    for name, placement in matching.items():
        size = rig.cameras[rig.names.index(name)].image_size
        if placement.calibrated_size != size:
            calibrated, stored = (
                f"{width} x {height}" for width, height in (placement.calibrated_size, size)
            )
            raise InputError(
                f"{FOOTAGE}: camera {name} was calibrated for pictures of {calibrated}, but "
                f"cameras.json of the result is for {stored}; give --detections with the folder of "
                "this result, or --image-placement"
            )
    sizes = {name: each.size for name, each in opened.items() if name not in matching}
    placements, concluded = placements_of(image_placement, sizes, rig)
    notes += concluded
    if len(unknown) > 0 and not moments:
        first = run.get("numbered_from")
        picture = "the first picture" if first is None else f"picture {first}"
        notes.append(
            f"frame {first or 0} of the result is assumed to be {picture} of "
            f"{' '.join(unknown)}, and so on"
        )
    for text in notes:
        notify(text)
    pairs = []
    for name, footage in opened.items():
        index = used[name].places if name in used else _counted(footage, "numbered_from" in run)
        if moments and name in moments:
            index = np.append(index, -1)[np.minimum(moments[name], len(index))]
        index = np.where(index < len(footage.number), index, -1)
        pairs.append(
            (CameraFootage(name, footage.path, (placements | matching)[name], index), footage)
        )
    return pairs


def _counted(footage: Footage, numbered: bool) -> Index:
    """(T,) the picture of each frame, -1 if it is missing: found by its number, or counted from the
    first picture.
    """
    first = 0 if numbered else int(footage.number[0])
    count = int(footage.number[-1]) - first + 1
    if count > MOST_FRAMES:
        raise InputError(
            f"{footage.path}: pictures are numbered from {footage.number[0]} to "
            f"{footage.number[-1]}; number them by the frames of the recording"
        )
    index = np.full(count, -1, dtype=np.intp)
    index[footage.number - first] = np.arange(len(footage.number))
    return index


def _used_footage(run: Mapping[str, Any], detections: Path | None) -> list[CameraFootage]:
    """The pictures that `detect` recorded beside the detections from which the result was made."""
    if detections is not None:
        file = detections / FOOTAGE if detections.is_dir() else detections
        if not file.is_file():
            raise InputError(
                f"{file}: there is no such file; give the folder that `shapepose-fg detect` wrote"
            )
        return read_used_footage(file)
    inputs = run.get("inputs")
    texts = [Path(str(each)) for each in (inputs if isinstance(inputs, dict) else ())]
    files = [each.parent / FOOTAGE for each in texts if each.suffix in (".txt", ".json")]
    return next((read_used_footage(file) for file in files if file.is_file()), [])
