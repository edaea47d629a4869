"""2D detections of every camera, from a folder: which files are whose, which format they are, one table of all."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25, SKELETONS, Skeleton
from shapepose_fg.core.storage.kept_arrays import InMemory, KeptArrays
from shapepose_fg.io.detection_table import DetectionTable
from shapepose_fg.io.detections.formats import FORMATS
from shapepose_fg.io.detections.people import CameraPeople, KeptPeople, ScoreRule, candidates_of
from shapepose_fg.io.detections.places import find_places
from shapepose_fg.io.detections.view_streams import ViewStream, assemble
from shapepose_fg.io.skeleton_file import find_skeleton

_MOST_FRAMES = 2_000_000
"""No recording is as long: ids of pictures that are not frames' numbers."""


def read_detections(
    path: str | Path, rig: Rig, skeleton: Skeleton | str | Path | None = None, kept: KeptArrays | None = None
) -> DetectionTable:
    """Read what every camera of `rig` saw from the folder `path`, undistorted.

    The formats are `FORMATS`, told by the files (docs/conventions.md). Cameras that the rig does not have are
    passed over. `skeleton` is a `Skeleton`, the name of one in `SKELETONS`, or a TOML file that describes it;
    without it the number of keypoints tells. `notes` of the table say what was made of the files. `kept` holds the
    recording, in memory by default: with an empty `InFolder` it may be larger than that. Raises InputError, one
    sentence that names file, place and cure.
    """
    kept = InMemory() if kept is None else kept
    places = find_places(Path(path), rig)
    wanted = find_skeleton(skeleton)
    streams, people = list[ViewStream](), list[KeptPeople]()
    for n, (place, camera) in enumerate(zip(places.paths, rig.cameras, strict=True)):
        read = next(each for each in FORMATS if each.recognise(place)).read(place, camera)
        if isinstance(read, CameraPeople):
            people.append(KeptPeople(read, kept, f"camera-{n:04d}"))
        else:
            streams.append(read)
    if len(people) > 0 and len(streams) > 0:
        raise InputError(f"{path}: some cameras have people and some candidates; give one format for all cameras")
    table = _of_people(people, rig, wanted, kept) if len(people) > 0 else _of_streams(streams, rig, wanted, kept)
    return replace(table, notes=(*places.notes, *table.notes))


def _of_streams(
    streams: Sequence[ViewStream], rig: Rig, wanted: Skeleton | None, kept: KeptArrays
) -> DetectionTable:
    """Candidates of every camera."""
    first = streams[0]
    skeleton = first.skeleton or wanted or BODY_25
    for each in streams[1:]:
        other = each.skeleton or skeleton
        if other.name != skeleton.name:
            raise InputError(
                f"{each.source} has the joints of {other.name}, {first.source} those of {skeleton.name}; give the"
                " detections of one model for all cameras"
            )
    if wanted is not None and wanted.joints != skeleton.joints:
        raise InputError(f"{first.source}: these are joints of {skeleton.name}, not of {wanted.name}")
    table = assemble(streams, rig, skeleton, kept)
    return replace(table, notes=(*_made(skeleton, "made between the two that one neighbour links"), *table.notes))


def _of_people(
    people: Sequence[KeptPeople], rig: Rig, wanted: Skeleton | None, kept: KeptArrays
) -> DetectionTable:
    """People of every camera."""
    skeleton = _skeleton_of(people, wanted)
    first, last = _span([each.camera for each in people])
    rule = ScoreRule.of(people)
    for each in people:
        if each.farthest is not None and each.farthest <= 1:
            raise InputError(
                f"{each.camera.source}: recognised as {each.camera.program}, but all keypoints lie between -1"
                f" and 1, and pixels were expected; {each.camera.rerun}"
            )
    notes = [] if rule.note is None else [rule.note]
    if first > 0 and not all(each.camera.every_frame for each in people):
        notes.append(f"frame 0 is number {first} of the files")
    streams = []
    for each in people:
        # A camera that lists every one of its frames must list those of the others.
        span = (each.camera.first, each.camera.last) if each.camera.every_frame else (first, last)
        streams.append(candidates_of(each, rule, skeleton, *span))
        notes += _gaps(each.camera)
    notes += _made(skeleton, "made as middles, where a person's two ends were seen")
    table = assemble(streams, rig, skeleton, kept)
    return replace(table, notes=(*notes, *table.notes))


def _span(cameras: Sequence[CameraPeople]) -> tuple[int, int]:
    """Numbers of the first and last frame that any camera lists."""
    listed = [each for each in cameras if each.last >= each.first]
    if len(listed) == 0:
        raise InputError(
            f"{cameras[0].source}: recognised as {cameras[0].program}, where no camera lists a frame;"
            " give detections of people"
        )
    first, last = min(each.first for each in listed), max(each.last for each in listed)
    if last - first >= _MOST_FRAMES:
        raise InputError(
            f"{listed[0].source}: recognised as {listed[0].program}, whose frames would run from {first} to"
            f" {last}; number the pictures by their frames"
        )
    return first, last


def _gaps(camera: CameraPeople) -> list[str]:
    """Which frames in between a camera lacks."""
    if len(camera.gaps) == 0:
        return []
    count = sum(last - first + 1 for first, last in camera.gaps)
    (first, last), more = camera.gaps[0], ", and others" if len(camera.gaps) > 1 else ""
    where = f"frame {first}" if first == last else f"frames {first} to {last}"
    have = "frames have" if count > 1 else "frame has"
    return [f"{camera.source}: {count} {have} no file ({where}{more}); nobody is seen there"]


def _made(skeleton: Skeleton, how: str) -> list[str]:
    """Which joints the reader made itself."""
    made = [skeleton.joints[joint] for joint, _, _ in skeleton.middles]
    return [f"{skeleton.name} has no {' and no '.join(made)}: {how}"] if made else []


def _skeleton_of(people: Sequence[KeptPeople], wanted: Skeleton | None) -> Skeleton:
    """The skeleton that all files have, by the number of keypoints."""
    counts: dict[int, CameraPeople] = {}
    for each in people:
        if each.keypoint_count is not None:
            counts.setdefault(each.keypoint_count, each.camera)
    if len(counts) > 1:
        (one, first), (other, second) = list(counts.items())[:2]
        raise InputError(
            f"{first.source} has people of {one} keypoints, {second.source} of {other}; give the detections of one"
            " model for all cameras"
        )
    if len(counts) == 0:
        return wanted or BODY_25
    count, camera = next(iter(counts.items()))
    place = f"{camera.source}: recognised as {camera.program} with {count} keypoints a person"
    if wanted is not None and wanted.keypoint_count != count:
        raise InputError(
            f"{place}, but {wanted.name} has {wanted.keypoint_count}; name the detector's own skeleton"
        )
    found = wanted or next((each for each in SKELETONS.values() if each.keypoint_count == count), None)
    if found is None:
        listing = ", ".join(f"{known.keypoint_count} ({known.name})" for known in SKELETONS.values())
        what = "MPI's: run OpenPose with --model_pose BODY_25" if count == 15 else "not known here"
        raise InputError(
            f"{place}, which is {what}, or describe them in a skeleton file (--skeleton); known are {listing}"
        )
    return found
