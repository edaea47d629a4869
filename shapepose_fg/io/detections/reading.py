"""Reads 2D detections of every camera from a folder: finds the files, recognises the format, and
makes one table.

A format of your own is an entry in `FORMATS` and a function that reads it.
"""

import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25, Skeleton
from shapepose_fg.core.storage.kept_arrays import InMemory, KeptArrays
from shapepose_fg.io.camera_names import in_any_form, listing, match_by_parts
from shapepose_fg.io.detection_table import DetectionTable
from shapepose_fg.io.detections.arrays import (
    cameras_of_freemocap,
    read_freemocap,
    read_hdf5,
    what_it_is,
)
from shapepose_fg.io.detections.association_text import read_association_text
from shapepose_fg.io.detections.csv_people import (
    cameras_of_caliscope,
    is_caliscope,
    is_deeplabcut,
    read_caliscope,
    read_deeplabcut,
)
from shapepose_fg.io.detections.json_people import read_json_people
from shapepose_fg.io.detections.keypoint_layout import skeleton_of_people
from shapepose_fg.io.detections.people import (
    CameraPeople,
    DeclaredJoints,
    KeptPeople,
    candidates_of,
    score_rule,
)
from shapepose_fg.io.detections.view_streams import ViewStream, assemble
from shapepose_fg.io.detections.yolo import label_files, read_yolo
from shapepose_fg.io.footage.placement import FOOTAGE, UNFINISHED, UNFINISHED_SETTINGS
from shapepose_fg.io.skeleton_file import find_skeleton


@dataclass(frozen=True)
class DetectionFormat:
    """A format of detections, with one file or folder per camera."""

    name: str
    """Name of the format, for messages and documentation."""
    names: tuple[str, ...]
    """Name patterns of a camera's file, or (without a suffix) of its folder; {} stands for the
    camera's name."""
    read: Callable[[Path, Camera], CameraPeople | ViewStream]
    """Function that reads one camera: people, or candidates with affinities; InputError naming
    file, place and cure."""


JSON = DetectionFormat(
    "JSON of OpenPose, Pose2Sim, MMPose, AlphaPose, or COCO's keypoint results",
    ("{}", "{}_json", "{}.json", "results_{}.json", "{}_results.json", "alphapose-results_{}.json"),
    lambda place, camera: _read_folder(place, camera),
)
CSV = DetectionFormat(
    "CSV of DeepLabCut and AniPose", ("{}.csv",), lambda place, camera: read_deeplabcut(place)
)
HDF5 = DetectionFormat(
    "HDF5 of SLEAP, DeepLabCut and AniPose",
    ("{}.h5", "{}.analysis.h5"),
    lambda place, camera: read_hdf5(place),
)
TEXT = DetectionFormat("4D Association's text", ("{}.txt",), read_association_text)
FORMATS = [TEXT, JSON, CSV, HDF5]
"""Known formats. The first one with a matching file or folder for some camera is used for all
cameras."""
_FOLDERS = ("detection", "output_data/raw_data", "raw_data")
"""Subfolders with detections in the recordings of 4D Association and FreeMoCap."""
_PROGRAM_S = re.compile(r"^(alphapose-)?results_|_results$|_json$|\.analysis$|DLC[_A-Za-z].*")
"""Pattern of affixes that programs add to the name of a camera or video; the part after DLC
contains other numbers."""
_FREEMOCAP_FILES = re.compile(
    r"2dData_numCams_numFrames_numTrackedPoints_pixelXY\.npy$|^mediaPipeData_2d\.npy$"
)


def read_detections(
    path: str | Path,
    rig: Rig,
    skeleton: Skeleton | str | Path | DeclaredJoints | None = None,
    kept: KeptArrays | None = None,
    own_frames: bool = False,
) -> DetectionTable:
    """Read the detections of every camera of `rig` from the folder `path`, undistorted.

    The formats are `FORMATS`, recognised by the files (docs/detection_files.md). Files of
    cameras that are not in the rig are ignored. `skeleton` is a `Skeleton`, the name of one in
    `SKELETONS`, or a TOML file that describes it; by default it is determined by joint names in
    the files, by a project's declaration, or by the number of keypoints. `notes` of the table
    list how the files were interpreted. The recording is stored in `kept`, by default in
    memory; with an empty `InFolder` it may be larger than memory. With `own_frames`, cameras
    may have different numbers of frames. Raises InputError, one sentence that names file, place
    and cure.
    """
    kept = InMemory() if kept is None else kept
    form, places, notes = find_places(Path(path), rig)
    declared = skeleton if isinstance(skeleton, DeclaredJoints) else None
    wanted = None if isinstance(skeleton, DeclaredJoints) else find_skeleton(skeleton)
    streams, people, first = list[ViewStream](), list[KeptPeople](), 0
    for n, (place, camera) in enumerate(zip(places, rig.cameras, strict=True)):
        read = form.read(place, camera)
        if isinstance(read, CameraPeople):
            people.append(KeptPeople(read, kept, f"camera-{n:04d}"))
        else:
            streams.append(read)
    if len(people) > 0:
        skeleton, skeleton_notes = skeleton_of_people(people, wanted, declared)
        how = "the midpoint of two joints, if both were detected"
        streams, stream_notes, first = _streams_of(people, skeleton)
        notes += [*stream_notes, *skeleton_notes]
    else:
        skeleton, how = (
            _skeleton_of_streams(streams, wanted),
            "the midpoint of the two joints that its limbs connect",
        )
    made = [skeleton.joints[joint] for joint, _, _ in skeleton.middles]
    if made:
        each = "it" if len(made) == 1 else "each"
        notes.append(f"{skeleton.name} has no {' and no '.join(made)}: {each} is {how}")
    table = assemble(streams, rig, skeleton, kept, own_frames)
    return replace(table, notes=(*notes, *table.notes), first=first)


def find_places(path: Path, rig: Rig) -> tuple[DetectionFormat, list[Path], list[str]]:
    """The format, the file or folder of each camera (in the rig's order) in the folder `path`, and
    notes on inferred names.

    InputError naming the camera that is missing.
    """
    if path.is_file():
        if (form := _of_all_cameras(path, rig.names)) is not None:
            return form, [path] * len(rig), []
        known = what_it_is(path)
        what = "this is a file" if known is None else f"this is {known}"
        raise InputError(
            f"{path}: {what}; give the folder that holds the detections of all cameras"
        )
    if not path.is_dir():
        raise InputError(f"{path}: there is no such folder; check the path")
    folder, entries = _entries(path)
    holds = listing([each.name for each in entries])
    if (folder / UNFINISHED / UNFINISHED_SETTINGS).is_file():
        raise InputError(
            f"{folder}: `detect` was interrupted and has not finished these detections; start the "
            "same command again to continue"
        )
    for form in FORMATS:
        found = [_named(folder, name, form.names) for name in rig.names]
        places = [place for place in found if place is not None]
        if len(places) == len(rig):
            return form, places, []
        if len(places) > 0:
            missing = rig.names[found.index(None)]
            raise InputError(
                f'{folder / form.names[0].format(missing)}: the detections of camera "{missing}"'
                " are missing,"
                f" {folder} contains {holds}; add them, or leave the camera out with --without"
                f" {shlex.quote(missing)}"
            )
    # Such as `walk_Miqus_1_23087_json` for camera `23087`, or `cam01_json` for camera `int_cam1`.
    for form, offered, names in _offered(entries):
        if (matched := match_by_parts(folder, rig.names, offered, names)) is not None:
            return form, *matched
    whole = [
        (form, each) for each in entries if (form := _of_all_cameras(each, rig.names)) is not None
    ]
    if len(whole) == 1:
        form, file = whole[0]
        return form, [file] * len(rig), []
    if len(whole) > 1:
        names = " ".join(file.name for _, file in whole)
        raise InputError(
            f"{folder}: there are several files of all cameras ({names[:200]}); give one of them"
        )
    for each in entries:
        if each.is_file() and (known := what_it_is(each)) is not None:
            raise InputError(f"{each}: this is {known}")
    raise InputError(
        f"{folder}: there are no detections of the cameras {' '.join(rig.names)}; it contains "
        f"{holds}; give the folder with <camera>.txt (4D Association), <camera>/ or <camera>_json/ "
        "with a JSON file per frame (OpenPose, Pose2Sim, MMPose), or <camera>.json (COCO's "
        "results, AlphaPose, MMPose)"
    )


def camera_names(path: Path) -> list[str]:
    """Names of cameras, from the files and folders at a path that `read_detections` can read.

    InputError if there are none.
    """
    if path.is_file():
        folder, entries = path.parent, [path]
    elif path.is_dir():
        folder, entries = _entries(path)
    else:
        raise InputError(f"{path}: there is no such folder; check the path")
    for each in entries:
        if _FREEMOCAP_FILES.search(each.name) is not None:
            return cameras_of_freemocap(each)
        if each.suffix.lower() == ".csv" and is_caliscope(each):
            return cameras_of_caliscope(each)
    for empty in (False, True):
        for _, places, names in _offered(entries):
            holds = [
                empty or each.is_file() or _has_json(each) or bool(label_files(each))
                for each in places
            ]
            if any(holds):
                return [name for name, has_files in zip(names, holds, strict=True) if has_files]
    holds = listing([each.name for each in entries])
    cure = "give the folder with a file or folder for each camera"
    raise InputError(f"{folder}: there are no detections; it contains {holds}; {cure}")


def _entries(path: Path) -> tuple[Path, list[Path]]:
    """The folder of the detections, which may be a subfolder of `path`, and its entries."""
    folder = next((each for name in _FOLDERS if (each := path / name).is_dir()), path)
    return folder, sorted(each for each in folder.iterdir() if not each.name.startswith("."))


def _offered(entries: list[Path]) -> list[tuple[DetectionFormat, list[Path], list[str]]]:
    """For each format, the files of a folder that may belong to cameras, and the names of these
    cameras.
    """
    files = [each for each in entries if each.is_file()]
    folders = [each for each in entries if each.is_dir()]
    tables = [each for each in files if each.suffix.lower() == ".csv" and is_deeplabcut(each)]
    kinds = (
        (JSON, folders),
        (TEXT, [each for each in files if each.suffix.lower() == ".txt"]),
        (JSON, [each for each in files if each.suffix.lower() == ".json" and each.name != FOOTAGE]),
        (CSV, _unfiltered(tables)),
        (HDF5, _unfiltered([each for each in files if each.suffix.lower() in (".h5", ".hdf5")])),
    )
    found = []
    for form, places in kinds:
        names = [each.stem if each.is_file() else each.name for each in places]
        found.append((form, places, [_PROGRAM_S.sub("", name) for name in names]))
    return found


def _of_all_cameras(file: Path, names: Sequence[str]) -> DetectionFormat | None:
    """The format of a file with all cameras; None for other files."""
    if file.is_file() and _FREEMOCAP_FILES.search(file.name) is not None:
        return DetectionFormat(
            "",
            (),
            lambda place, camera: read_freemocap(place, names.index(camera.name), len(names)),
        )
    if file.is_file() and file.suffix.lower() == ".csv" and is_caliscope(file):
        return DetectionFormat(
            "", (), lambda place, camera: read_caliscope(place, names.index(camera.name), names)
        )
    return None


def _unfiltered(files: list[Path]) -> list[Path]:
    """Files without DeepLabCut's `_filtered` versions, if unfiltered ones exist."""
    names = {each.name for each in files}
    return [each for each in files if each.name.replace("_filtered", "") not in names - {each.name}]


def _read_folder(place: Path, camera: Camera) -> CameraPeople:
    """Read the people in a camera's folder or file: YOLO's labels, or JSON."""
    if place.is_dir() and not _has_json(place) and len(label_files(place)) > 0:
        return read_yolo(place, camera.image_size)
    return read_json_people(place)


def _has_json(folder: Path) -> bool:
    """Whether a folder has JSON files."""
    return any(each.suffix.lower() == ".json" for each in folder.iterdir())


def _named(folder: Path, name: str, patterns: Sequence[str]) -> Path | None:
    """The file named after a camera, its suffix in capitals or not; a folder if the pattern has no
    suffix.
    """
    for pattern in patterns:
        place = in_any_form(folder / pattern.format(name))
        if suffix := Path(pattern).suffix:
            in_capitals = place.with_name(place.name.removesuffix(suffix) + suffix.upper())
            found = [each for each in (place, in_capitals) if each.is_file()]
        else:
            found = [place] if place.is_dir() else []
        if found:
            return found[0]
    return None


def _skeleton_of_streams(streams: Sequence[ViewStream], wanted: Skeleton | None) -> Skeleton:
    """The common skeleton of all candidates."""
    first = streams[0]
    skeleton = first.skeleton or wanted or BODY_25
    for each in streams[1:]:
        other = each.skeleton or skeleton
        if other.name != skeleton.name:
            raise InputError(
                f"{each.source} has the joints of {other.name}, but {first.source} those of "
                f"{skeleton.name}; give the detections of one model for all cameras"
            )
    if wanted is not None and wanted.joints != skeleton.joints:
        raise InputError(
            f"{first.source}: these are joints of {skeleton.name}, not of {wanted.name}; give "
            "that as the skeleton, or none"
        )
    return skeleton


def _streams_of(
    people: Sequence[KeptPeople], skeleton: Skeleton
) -> tuple[list[ViewStream], list[str], int]:
    """The people of every camera as candidates, notes on their scores and frames, and the table's
    `first`.

    If all files list only frames with people, frame numbers are kept, and frames before the first
    listed one are empty.
    """
    cameras = [each.camera for each in people]
    first, last = _span(cameras)
    # Maximum number of frames without people at the beginning. If there are more, frames
    # are counted from the first one with people, with a note.
    empty = first if first <= 200_000 and all(camera.lists_people for camera in cameras) else 0
    first -= empty
    rule, note = score_rule(people)
    for each, camera in zip(people, cameras, strict=True):
        if each.farthest is not None and each.farthest <= 1:
            raise InputError(
                f"{camera.source}: recognised as {camera.program}, but all keypoints are between "
                f"-1 and 1, and pixels are expected; {camera.rerun}"
            )
    notes = [] if note is None else [note]
    if first > 0 and not all(camera.every_frame for camera in cameras):
        notes.append(f"frame 0 has number {first} in the files")
    streams = []
    for each, camera in zip(people, cameras, strict=True):
        # A camera that lists every frame must list the frames of the other cameras.
        span = (camera.first, camera.last) if camera.every_frame else (first, last)
        streams.append(candidates_of(each, rule, skeleton, *span))
        if len(camera.gaps) > 0:
            count = sum(until - since + 1 for since, until in camera.gaps)
            (since, until), more = camera.gaps[0], ", and others" if len(camera.gaps) > 1 else ""
            where = f"frame {since}" if since == until else f"frames {since} to {until}"
            have = "frames have" if count > 1 else "frame has"
            notes.append(
                f"{camera.source}: {count} {have} no file ({where}{more}); no people are read there"
            )
    return streams, notes, empty


def _span(cameras: Sequence[CameraPeople]) -> tuple[int, int]:
    """Numbers of the first and last frame that any camera lists."""
    listed = [each for each in cameras if each.last >= each.first]
    if len(listed) == 0:
        problem = f"recognised as {cameras[0].program}, but no camera has a frame"
        raise InputError(f"{cameras[0].source}: {problem}; give detections of people")
    first, last = min(each.first for each in listed), max(each.last for each in listed)
    # Maximum number of frames of a recording: larger numbers are not frame numbers but ids
    # of pictures.
    if last - first >= 2_000_000:
        problem = (
            f"recognised as {listed[0].program}, but its frames would run from {first} to {last}"
        )
        raise InputError(f"{listed[0].source}: {problem}; number the pictures by their frames")
    return first, last
