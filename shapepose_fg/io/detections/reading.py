"""2D detections of every camera, from a folder: which files are whose, which format they are, one table of all."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25, SKELETONS, Skeleton
from shapepose_fg.core.storage.kept_arrays import InMemory, KeptArrays
from shapepose_fg.io.detection_table import DetectionTable
from shapepose_fg.io.detections.association_text import read_association_text
from shapepose_fg.io.detections.frame_files import frame_files, read_frame_files
from shapepose_fg.io.detections.one_file import is_one_file, read_one_file
from shapepose_fg.io.detections.people import CameraPeople, candidates_of
from shapepose_fg.io.detections.places import find_places
from shapepose_fg.io.detections.read_people import ReadPeople, read_whole
from shapepose_fg.io.detections.scores import Scores, as_probabilities
from shapepose_fg.io.detections.view_streams import assemble
from shapepose_fg.io.skeleton_file import find_skeleton


def read_detections(
    path: str | Path, rig: Rig, skeleton: Skeleton | str | Path | None = None, kept: KeptArrays | None = None
) -> DetectionTable:
    """Read what every camera of `rig` saw from the folder `path`, undistorted.

    The formats are told by the files (docs/conventions.md): `<camera>.txt` of 4D Association; a folder per camera
    with a JSON file per frame (OpenPose, Pose2Sim, MMPose); a JSON file per camera (COCO's results, AlphaPose,
    MMPose). Cameras that the rig does not have are passed over. `skeleton` is a `Skeleton`, the name of one in
    `SKELETONS`, or a TOML file that describes it; without it the number of keypoints tells. `notes` of the table
    say what was made of the files. `kept` holds the recording, in memory by default: with an empty `InFolder` it
    may be larger than that. Raises InputError, one sentence that names file, place and cure.
    """
    kept = InMemory() if kept is None else kept
    places = find_places(Path(path), rig)
    wanted = find_skeleton(skeleton)
    if places.kind == "text":
        table = _read_texts(places.paths, rig, wanted, kept)
        return replace(table, notes=(*places.notes, *table.notes))
    people = [read_whole(_camera(each), kept, f"camera-{n:04d}") for n, each in enumerate(places.paths)]
    found = _Found(people, _skeleton_of(people, wanted))
    first, last = found.span()
    rule = as_probabilities(found.scores(), (block.keypoints for each in people for block in each.blocks()))
    found.refuse_normalised()
    views = [
        candidates_of(each.with_scores(rule), found.skeleton, *(_own_span(each.camera) or (first, last)))
        for each in people
    ]
    table = assemble(views, rig, found.skeleton, kept)
    notes = () if rule.note is None else (rule.note,)
    return replace(
        table, notes=(*places.notes, *notes, *found.beginning(), *found.gaps(), *found.middles(), *table.notes)
    )


def _read_texts(texts: Sequence[Path], rig: Rig, wanted: Skeleton | None, kept: KeptArrays) -> DetectionTable:
    """4D Association's text of every camera."""
    read = [read_association_text(text, camera) for text, camera in zip(texts, rig.cameras, strict=True)]
    skeleton = read[0][1]
    for text, (_, each) in zip(texts, read, strict=True):
        if each.name != skeleton.name:
            raise InputError(
                f"{text} has the joints of {each.name}, {texts[0]} those of {skeleton.name}; give the detections"
                " of one model for all cameras"
            )
    if wanted is not None and wanted.joints != skeleton.joints:
        raise InputError(f"{texts[0]}: these are joints of {skeleton.name}, not of {wanted.name}")
    table = assemble([view for view, _ in read], rig, skeleton, kept)
    made = [skeleton.joints[joint] for joint, _, _ in skeleton.middles]
    if len(made) > 0:
        note = f"{skeleton.name} has no {' and no '.join(made)}: made between the two that one neighbour links"
        table = replace(table, notes=(note, *table.notes))
    return table


def _camera(place: Path) -> CameraPeople:
    """What one camera saw: all in one file, or a folder of files."""
    if place.is_file():
        return read_one_file(place)
    lists = [each for each in place.glob("*.json") if not each.name.startswith(".")]
    if len(lists) == 1 and is_one_file(lists[0]):
        return read_one_file(lists[0])
    if len(frame_files(place)) == 0 and len(lists) > 1:
        names = " ".join(sorted(each.name for each in lists)[:4])
        raise InputError(f"{place}: several JSON files without frame numbers ({names}); leave the one to be read")
    return read_frame_files(place)


_MOST_FRAMES = 2_000_000
"""No recording is as long: ids of pictures that are not frames' numbers."""


@dataclass(frozen=True)
class _Found:
    """The people of all cameras, in one skeleton."""

    people: Sequence[ReadPeople]
    skeleton: Skeleton

    def span(self) -> tuple[int, int]:
        """Numbers of the first and last frame that any camera lists."""
        cameras = [each.camera for each in self.people]
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

    def scores(self) -> Scores:
        """What is known of all scores."""
        every = [each.scores for each in self.people]
        return Scores(
            sum(each.count for each in every),
            max(each.top for each in every),
            all(each.visibilities for each in every),
        )

    def refuse_normalised(self) -> None:
        """Refuse keypoints that are parts of the picture's size instead of pixels."""
        for each in self.people:
            if each.farthest is not None and each.farthest <= 1:
                raise InputError(
                    f"{each.camera.source}: recognised as {each.camera.program}, but all keypoints lie between -1"
                    f" and 1, and pixels were expected; {each.camera.rerun}"
                )

    def beginning(self) -> list[str]:
        """Which number frame 0 has, where the files may leave out frames before it."""
        first, _ = self.span()
        if first == 0 or all(each.camera.every_frame for each in self.people):
            return []
        return [f"frame 0 is number {first} of the files"]

    def gaps(self) -> list[str]:
        """Which cameras lack frames in between."""
        notes = []
        for each in (each.camera for each in self.people):
            if len(each.gaps) > 0:
                count = sum(last - first + 1 for first, last in each.gaps)
                (first, last), more = each.gaps[0], ", and others" if len(each.gaps) > 1 else ""
                where = f"frame {first}" if first == last else f"frames {first} to {last}"
                have = "frames have" if count > 1 else "frame has"
                notes.append(f"{each.source}: {count} {have} no file ({where}{more}); nobody is seen there")
        return notes

    def middles(self) -> list[str]:
        """What the reader made itself."""
        made = [self.skeleton.joints[joint] for joint, _, _ in self.skeleton.middles]
        if len(made) == 0:
            return []
        name = self.skeleton.name
        return [f"{name} has no {' and no '.join(made)}: made as middles, where a person's two ends were seen"]


def _own_span(people: CameraPeople) -> tuple[int, int] | None:
    """The frames of a camera that lists every one of its frames, which must be those of the others."""
    return (people.first, people.last) if people.every_frame else None


def _skeleton_of(people: Sequence[ReadPeople], wanted: Skeleton | None) -> Skeleton:
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
    count, each = next(iter(counts.items()))
    place = f"{each.source}: recognised as {each.program} with {count} keypoints a person"
    if wanted is not None:
        if wanted.keypoint_count != count:
            raise InputError(
                f"{place}, but {wanted.name} has {wanted.keypoint_count}; name the detector's own skeleton"
            )
        return wanted
    for known in SKELETONS.values():
        if known.keypoint_count == count:
            return known
    listing = ", ".join(f"{known.keypoint_count} ({known.name})" for known in SKELETONS.values())
    what = "MPI's: run OpenPose with --model_pose BODY_25" if count == 15 else "not known here"
    raise InputError(
        f"{place}, which is {what}, or describe them in a skeleton file (--skeleton); known are {listing}"
    )
