"""Shelf's annotation: reads the text format of 4D Association, and maps BODY_25 to its joints."""

from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.bounds import MOST_NUMBER
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.metrics import PlainPeople
from shapepose_fg.io.detections.association_text import NumberStream

SHELF_JOINTS = tuple(
    "RAnkle RKnee RHip LHip LKnee LAnkle RWrist RElbow RShoulder LShoulder LElbow LWrist Neck "
    "HeadTop MidHip".split()
)
"""The 15 annotated joints, in the order of the file."""
LIMB_ENDS = {
    "left upper arm": ("LShoulder", "LElbow"),
    "right upper arm": ("RShoulder", "RElbow"),
    "left lower arm": ("LElbow", "LWrist"),
    "right lower arm": ("RElbow", "RWrist"),
    "left upper leg": ("LHip", "LKnee"),
    "right upper leg": ("RHip", "RKnee"),
    "left lower leg": ("LKnee", "LAnkle"),
    "right lower leg": ("RKnee", "RAnkle"),
    "head": ("Neck", "HeadTop"),
    "torso": ("Neck", "MidHip"),
}
"""The joints at the ends of each limb."""
ACTORS = (0, 1, 2)
"""The scored ids of the annotation: actors 1, 2 and 3."""


def shelf_joints(body25: Array) -> Array:
    """Map BODY_25 joints (N, 25, 3), metres, z up, to Shelf's (N, 15, 3); NaN stays NaN.

    The hips, limbs and MidHip are the joints of the same name. With s and e the midpoints of
    shoulders and ears, Neck is s + 0.5 (e - s) and HeadTop is Neck + 0.125 f + 0.145 z, metres,
    with f the unit vector of (neck - midhip) x (RShoulder - LShoulder). The mapping is fixed:
    tuning it on the annotation would overfit. If one ear is unknown, e is the other ear projected
    on the plane halfway between the shoulders, in which the midpoint of two mirrored ears lies.
    """
    body25 = np.asarray(body25, dtype=np.float64)
    if body25.ndim != 3 or body25.shape[1:] != (25, 3):
        raise ValueError(f"body25 must be (N, 25, 3), got {body25.shape}")
    named = ("RShoulder", "LShoulder", "MidHip", "Neck", "REar", "LEar")
    right, left, midhip, neck, right_ear, left_ear = (
        body25[:, BODY_25.index(name)] for name in named
    )
    shoulders, across = 0.5 * (right + left), _unit(right - left)
    ear = np.where(np.isfinite(right_ear), right_ear, left_ear)
    mirrored = ear - np.sum((ear - shoulders) * across, axis=1, keepdims=True) * across
    middle = 0.5 * (right_ear + left_ear)
    middle = np.where(np.isfinite(middle), middle, mirrored)
    result = np.empty((len(body25), 15, 3))
    result[:, :12] = body25[:, [BODY_25.index(name) for name in SHELF_JOINTS[:12]]]
    result[:, 12] = shoulders + 0.5 * (middle - shoulders)
    result[:, 13] = (
        result[:, 12] + 0.125 * _unit(np.cross(neck - midhip, right - left)) + [0.0, 0.0, 0.145]
    )
    result[:, 14] = midhip
    return result


def _unit(vectors: Array) -> Array:
    """Unit vectors (N, 3); NaN for vectors of length zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, np.nan)


def read_shelf_ground_truth(path: Path | str) -> PlainPeople:
    """Annotated people in `SHELF_JOINTS`: `person` 0, 1, 2 are the actors 1, 2, 3; others are not
    scored, because not everybody is annotated.

    The file has the numbers of joints and of frames, then per frame the number of people, and per
    person an id and the rows x, y, z and confidence of all joints. InputError that names file and
    line for anything else.
    """
    numbers, again = NumberStream(Path(path)), "copy the file again"

    def whole(meaning: str, most: int, count: int = 1) -> list[int]:
        """The next whole numbers, 0 to `most`."""
        values = numbers.numbers(numbers.take(count, f"the file ends before {meaning}"))
        if not ((values == np.rint(values)) & (values >= 0) & (values <= most)).all():
            got = " ".join(f"{value:g}" for value in values)
            raise numbers.refuse(numbers.taken - 1, f"must hold {meaning}, got {got}", again)
        return values.astype(np.int64).tolist()

    joints, frames = whole("the number of joints and of frames", 10**7, 2)
    if joints != len(SHELF_JOINTS):
        said = f"must say {len(SHELF_JOINTS)} joints, got {joints}"
        raise numbers.refuse(0, said, again)
    who, rows = list[tuple[int, int]](), list[Array]()
    for frame in range(frames):
        (people,) = whole(f"the number of people in frame {frame}", 1000)
        for n in range(people):
            (person,) = whole(f"a person's id in frame {frame}", MOST_NUMBER)
            if (frame, person) in who[len(who) - n :]:
                said = f"the id {person} is twice in frame {frame}"
                raise numbers.refuse(numbers.taken - 1, said, again)
            who.append((frame, person))
            ends = f"the file ends within the joints of person {person} in frame {frame}"
            values = numbers.numbers(numbers.take(4 * joints, ends))
            rows.append(values.reshape(4, joints)[:3].T)
    if not numbers.ended:
        said = f"there are more numbers after the {frames} frames that line 1 promises"
        raise numbers.refuse(numbers.taken, said, again)
    frame, person = np.array(who, dtype=np.int64).reshape(-1, 2).T
    xyz = np.stack(rows) if rows else np.zeros((0, joints, 3))
    return PlainPeople(frame, xyz, person, SHELF_JOINTS, complete=False)
