"""Writes 2D detections for other programs: 4D Association's text with its calibration, and
OpenPose's JSON.

Both formats have distorted pixels, so detections are distorted again if the rig has distortion.
"""

import json
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.storage.files import write_atomically, write_content
from shapepose_fg.io.detections.association_text import TEXT_SKELETONS, TextSkeleton
from shapepose_fg.io.detections.view_streams import MARGIN
from shapepose_fg.proposal.people_2d import group_people


def write_association(recording: DetectionSequence, rig: Rig, folder: str | Path) -> None:
    """Write calibration.json and detection/<camera>.txt into `folder`, as 4D Association reads
    them.

    Positions (relative to the picture) have seven decimals, scores and affinities six. Joints
    outside the picture by a quarter of its size or more are left out, because readers refuse them.
    ValueError if the skeleton is not BODY_25, if there is no frame, if a lens does not have five
    coefficients, or if z does not point up in the world, as the format requires.
    """
    _check(recording)
    for camera in rig.cameras:
        if camera.lens != "perspective" or camera.distortion[5:].any():
            raise ValueError(
                f"the format has five distortion coefficients, but camera {camera.name} has "
                "another lens model"
            )
    if rig.up != "z":
        raise ValueError(
            f"the format has z up, but in this rig {rig.up} is up; rotate the world and the truth "
            "first"
        )
    folder, calibration = Path(folder), dict[str, Any]()
    for camera in rig.cameras:
        entry = {
            "K": camera.K.ravel().tolist(),
            "RT": camera.cTw.ravel().tolist(),
            "imgSize": [*camera.image_size],
        }
        # Distortion under the key that readers of this format use.
        straight = not camera.distortion.any()
        calibration[camera.name] = entry | (
            {} if straight else {"distCoeff": camera.distortion[:5].tolist()}
        )
    write_content(folder / "calibration.json", json.dumps(calibration, indent=1, allow_nan=False))
    for view, camera in enumerate(rig.cameras):
        content = partial(_write_frames, recording=recording, view=view, camera=camera)
        write_atomically(folder / "detection" / f"{camera.name}.txt", content)


def write_openpose(recording: DetectionSequence, rig: Rig, folder: str | Path) -> None:
    """Write <camera>/<camera>_000000000000_keypoints.json and so on into `folder`: people, as
    OpenPose does.

    Candidates are grouped by `group_people`; groups of fewer than three joints are
    false positives, and are left out. Positions are in pixels with three decimals. ValueError if
    the skeleton is not BODY_25 or if there is no frame; InputError if the folder of a camera
    already has frames.
    """
    _check(recording)
    refuse_leftovers(rig, folder)
    folders = [Path(folder) / camera.name for camera in rig.cameras]
    for each in folders:
        each.mkdir(parents=True, exist_ok=True)
    for frame in range(len(recording)):
        found = recording[frame]
        # Minimum number of joints of a group for it to count as a person, as in
        # OpenPose's default settings.
        people = [members for members in group_people(found) if len(members) >= 3]
        for view, (camera, each) in enumerate(zip(rig.cameras, folders, strict=True)):
            listed = []
            for members in people:
                if found.view[members[0]] == view:
                    keypoints = np.zeros((len(BODY_25), 3))  # missing joints are 0 0 0
                    keypoints[found.joint[members], :2] = camera.distort(found.xy[members]).round(3)
                    keypoints[found.joint[members], 2] = found.confidence[members].round(6)
                    listed.append(
                        {"person_id": [-1], "pose_keypoints_2d": keypoints.ravel().tolist()}
                    )
            # Thousands of small files are not written atomically; readers notice missing or
            # truncated ones.
            file = each / f"{camera.name}_{frame:012d}_keypoints.json"
            file.write_text(json.dumps({"version": 1.3, "people": listed}, allow_nan=False))


def refuse_leftovers(rig: Rig, folder: str | Path) -> None:
    """Raise InputError if `write_openpose` would mix its frames with existing ones; for checking
    before long work.
    """
    for camera in rig.cameras:
        place = Path(folder) / camera.name
        if next(place.glob("*_keypoints.json"), None) is not None:
            raise InputError(
                f"{place}: there are frames of another recording already; delete them first"
            )


def _check(recording: DetectionSequence) -> None:
    """Raise ValueError if a recording cannot be written in these formats."""
    if recording.skeleton.joints != BODY_25.joints:
        raise ValueError(f"only BODY_25 can be written, not {recording.skeleton.name}")
    if len(recording) == 0:
        raise ValueError("there is no frame to write; these formats need at least one")


def _write_frames(
    stream: BinaryIO, recording: DetectionSequence, view: int, camera: Camera
) -> None:
    """Write the text of one camera frame by frame, because the recording may be larger than
    memory.
    """
    kind, size = TEXT_SKELETONS[BODY_25.name], np.array(camera.image_size, dtype=np.float64)
    stream.write(f"{kind.number} {len(recording)}\n".encode())
    for frame in range(len(recording)):
        found = recording[frame]
        found = found.only(found.view == view)
        xy = camera.distort(found.xy)
        near = np.all((xy > -MARGIN * size) & (xy < (1 + MARGIN) * size), axis=1)
        found, xy = found.only(near), xy[near]
        lines = association_lines(
            kind, found.joint, xy / (size - 1), found.confidence, found.pairs, found.affinity
        )
        stream.write("".join(f"{line}\n" for line in lines).encode())


def association_lines(
    kind: TextSkeleton,
    joint: Index,
    fractions: Array,
    confidence: Array,
    pairs: Index,
    affinity: Array,
) -> Iterable[str]:
    """The lines of one frame: candidates joint by joint, then affinities limb by limb.

    `joint` (D,); `fractions` (D, 2), positions relative to the picture's size; `confidence` (D,);
    `pairs` (E, 2) of candidates, the limb's first joint first; `affinity` (E,).
    """
    order = np.argsort(joint, kind="stable")
    x, y = fractions[order].T
    score = confidence[order]
    counts = np.bincount(joint, minlength=len(kind.joints))
    ends = np.cumsum(counts)
    for n, end in zip(counts.tolist(), ends.tolist(), strict=True):
        yield str(n)
        if n > 0:
            block = slice(end - n, end)
            yield from (_numbers(x[block], 7), _numbers(y[block], 7), _numbers(score[block], 6))
    place = np.empty(len(joint), dtype=np.intp)
    place[order] = np.arange(len(joint)) - (ends - counts)[joint[order]]
    first, second = pairs.T
    limb = kind.limb_of[joint[first], joint[second]]
    for index, (a, b) in enumerate(kind.limbs):
        scores = np.zeros((counts[a], counts[b]))
        on_limb = limb == index
        scores[place[first[on_limb]], place[second[on_limb]]] = affinity[on_limb]
        if scores.size > 0:
            yield from (_numbers(row, 6) for row in scores)


def _numbers(values: Array, decimals: int) -> str:
    """Numbers as a line of text; zeros are written as 0, because an affinity matrix consists mostly
    of zeros.
    """
    return " ".join("0" if value == 0 else f"{value:.{decimals}f}" for value in values.tolist())
