"""Reads a detector's skeleton from TOML: its keypoints, limbs, mirror pairs, anchor and body
points.
"""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field

from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.joint_names import layouts_called
from shapepose_fg.core.skeleton import MID_HIP, SKELETONS, Skeleton
from shapepose_fg.core.storage.files import read_toml
from shapepose_fg.core.validation import validated

_Pair = Annotated[list[str], Field(min_length=2, max_length=2)]
_FACE_AND_TOES = {
    "REye", "LEye", "REar", "LEar", "Head", "LBigToe", "RBigToe", "LSmallToe", "RSmallToe", "LHeel",
    "RHeel", "left_hand", "right_hand", "left_foot", "right_foot",
}  # fmt: skip
"""Body points that are not core joints."""
_HIPS = ({"RHip", "LHip"}, {"right_hip", "left_hip"})


class _File(BaseModel, strict=True, extra="forbid"):
    name: Annotated[str, Field(min_length=1)]
    keypoints: Annotated[list[str], Field(min_length=3)]
    limbs: list[_Pair]
    mirror: Annotated[list[_Pair], Field(min_length=1)]
    anchor: str | _Pair
    core: list[str] | None = None
    middles: dict[str, _Pair] = {}
    body: dict[str, str] = {}


def find_skeleton(wanted: Skeleton | str | Path | None) -> Skeleton | None:
    """A skeleton from a `Skeleton`, from a name (`joint_names.layouts_called`), or from a TOML
    file.
    """
    if wanted is None or isinstance(wanted, Skeleton):
        return wanted
    name = str(wanted)
    if name in SKELETONS:
        return SKELETONS[name]
    if not Path(name).is_file():
        called = layouts_called(name)
        if len(called) == 1:
            return called[0]
        names = " ".join(each.name for each in called) or " ".join(SKELETONS)
        what = (
            "several skeletons have this name; give"
            if called
            else ("this is neither a file nor a known skeleton; give")
        )
        raise InputError(
            f"{name}: {what} {'one of' if called else 'a TOML file, or one of'} {names}"
        )
    return read_skeleton(name)


def read_skeleton(path: str | Path) -> Skeleton:
    """Read a skeleton's TOML file; its joints get the names of their body points.

    InputError, one sentence that names the file, the key and the cure.
    """
    path = Path(path)
    file = validated(_File, read_toml(path), path, "docs/joints.md describes the file")
    # The body point of each joint, by the joint's name in the file.
    points = {
        joint: file.body.get(joint, joint) for joint in (*file.keypoints, *file.middles) if joint
    }
    unknown = [name for name in file.body if name not in points]
    if unknown:
        raise InputError(
            f"{path}: body.{unknown[0]} is not a keypoint of {file.name}; it has {' '.join(points)}"
        )
    for joint, point in points.items():
        if point not in BODY_POINTS:
            raise InputError(
                f"{path}: the body has no point {point!r}; write under [body] which of its points"
                f" {joint} is"
                f' ({" ".join(BODY_POINTS)}), or "" to ignore the keypoint'
            )

    def pair(names: list[str]) -> tuple[str, str]:
        return points.get(names[0], names[0]), points.get(names[1], names[1])

    anchor = (
        points.get(file.anchor, file.anchor) if isinstance(file.anchor, str) else pair(file.anchor)
    )
    if not isinstance(anchor, str) and set(anchor) not in _HIPS:
        raise InputError(
            f"{path}: an anchor of two joints must be the right and the left hip; for another "
            "midpoint, define it under [middles] and give its name as the anchor"
        )
    core = [points.get(joint, joint) for joint in file.core or ()]
    if file.core is None:
        core = [point for point in points.values() if point not in _FACE_AND_TOES]
        core += [] if isinstance(anchor, str) else [MID_HIP]
    with naming(path):
        return Skeleton.of(
            file.name,
            [points.get(joint, "") for joint in file.keypoints],
            [pair(limb) for limb in file.limbs],
            anchor=anchor,
            mirror=[pair(both) for both in file.mirror],
            core=core,
            middles={points[joint]: pair(ends) for joint, ends in file.middles.items()},
        )
