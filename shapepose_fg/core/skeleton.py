"""Joints of a detector: their names, limbs and mirror pairs."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shapepose_fg.core.arrays import Index

LONGEST_NAME = 64
"""Maximum number of characters of a joint's name."""


def check_joint_names(names: Iterable[str]) -> None:
    """Raise ValueError for a name that would break the lines of text files, or that spreadsheets
    read as a formula.
    """
    for name in names:
        if not (0 < len(name) <= LONGEST_NAME and name.isprintable() and name[0] not in "=+-@"):
            raise ValueError(
                f"joint_names must have 1 to {LONGEST_NAME} printable characters and not begin "
                f"with = + - or @, got {name[:LONGEST_NAME]!r}"
            )


@dataclass(frozen=True)
class Skeleton:
    """The joints of one detector, in its own order."""

    name: str
    """Name of the skeleton, for messages and files."""
    joints: tuple[str, ...]
    """The names of the J joints, spelled as in OpenPose."""
    limbs: tuple[tuple[int, int], ...]
    """The L pairs of joints with part affinities, in the detector's order."""
    parents: tuple[int, ...]
    """(J,) parent of each joint in the tree in which people are assembled; -1 for the root, the
    anchor of a person."""
    mirror: tuple[int, ...]
    """(J,) index of the corresponding joint on the other side of the body; a joint on the midline
    has its own index."""
    core: tuple[int, ...]
    """The joints by which a person is recognised: trunk, arms and legs, without face and toes."""
    middles: tuple[tuple[int, int, int], ...] = ()
    """Joints that the detector does not output: (joint, first, second), the midpoint of two that it
    outputs."""
    keypoints: tuple[int, ...] | None = None
    """(K,) index of the joint of each keypoint that the detector writes, -1 for one that is ignored
    (such as hands and face); None if the keypoints are the joints, in this order."""

    @classmethod
    def of(
        cls,
        name: str,
        keypoints: Sequence[str],
        limbs: Sequence[tuple[str, str]],
        *,
        anchor: str | tuple[str, str],
        mirror: Sequence[tuple[str, str]],
        core: Sequence[str],
        middles: Mapping[str, tuple[str, str]] | None = None,
        parents: Mapping[str, str] | None = None,
        passed_over: int = 0,
    ) -> "Skeleton":
        """Make a skeleton from names.

        `keypoints` are the detector's, in its order; Keypoints named "", and `passed_over` further
        ones at the end, are ignored. `middles` are computed as midpoints of two keypoints. `anchor`
        is a joint, or the names of two joints with the midpoint "MidHip". `mirror` are pairs of
        joints on both sides of the body. By default, `parents` are found along the limbs, from the
        anchor outwards. ValueError names what is inconsistent.
        """
        middles = dict(middles or {})
        if not isinstance(anchor, str):
            middles[MID_HIP] = anchor
            limbs = [*limbs, *((MID_HIP, end) for end in anchor)]
            anchor = MID_HIP
        joints = (*(joint for joint in keypoints if joint), *middles)
        check_joint_names(joints)
        place = {joint: index for index, joint in enumerate(joints)}
        twice = next((joint for joint, count in Counter(joints).items() if count > 1), None)
        if twice is not None:
            raise ValueError(f"{name}: joint {twice} occurs twice; give each its own name")
        pairs = [*limbs, *mirror, *middles.values()]
        for joint in (anchor, *core, *(end for pair in pairs for end in pair)):
            if joint not in place:
                raise ValueError(f"{name} has no joint {joint!r}; it has {' '.join(joints)}")
        made = set(keypoints)
        for joint, ends in middles.items():
            for late in set(ends) - made:
                raise ValueError(
                    f"{name}: the midpoint {joint} uses {late}, which must be a keypoint or an "
                    "earlier midpoint"
                )
            made.add(joint)
        if len(core) == 0:
            raise ValueError(
                f"{name}: core must have at least one joint, by which a person is found; name one"
            )
        other = {place[a]: place[b] for a, b in (*mirror, *((b, a) for a, b in mirror))}
        edges = tuple((place[a], place[b]) for a, b in limbs)
        grown = _grown(place[anchor], edges, len(joints))
        if parents is not None:
            grown = [place.get(parents.get(joint, ""), -1) for joint in joints]
        lost = [joints[j] for j, parent in enumerate(grown) if parent < 0 and joints[j] != anchor]
        if lost:
            raise ValueError(
                f"{name}: no limbs connect the anchor {anchor} with {' '.join(lost)}; add limbs"
            )
        skeleton = cls(
            name=name,
            joints=joints,
            limbs=edges,
            parents=tuple(grown),
            mirror=tuple(other.get(index, index) for index in range(len(joints))),
            core=tuple(place[joint] for joint in core),
            middles=tuple((place[joint], place[a], place[b]) for joint, (a, b) in middles.items()),
            keypoints=(
                *(place[joint] if joint else -1 for joint in keypoints),
                *[-1] * passed_over,
            ),
        )
        beside = [
            j for j in range(len(joints)) if grown[j] == place[anchor] and skeleton.mirror[j] != j
        ]
        if len(beside) < 2:
            raise ValueError(
                f"{name}: two joints next to the anchor {anchor} must be left and right, such as "
                "hips; choose another anchor"
            )
        return skeleton

    def __len__(self) -> int:
        return len(self.joints)

    def index(self, name: str) -> int:
        """Index of the joint called `name`; ValueError with the known names if there is none."""
        if name not in self.joints:
            raise ValueError(f"{self.name} has no joint {name!r}; it has {' '.join(self.joints)}")
        return self.joints.index(name)

    @property
    def root(self) -> int:
        """The joint that anchors a person."""
        return self.parents.index(-1)

    @property
    def anchor(self) -> tuple[int, ...]:
        """Joints that determine the position of a person: the root joint; if it is a computed
        midpoint, its two joints.
        """
        return next(
            ((first, second) for joint, first, second in self.middles if joint == self.root),
            (self.root,),
        )

    @property
    def keypoint_count(self) -> int:
        """K, the number of keypoints of a person in the detector's files."""
        return len(self) if self.keypoints is None else len(self.keypoints)

    @property
    def hips(self) -> tuple[int, int]:
        """The two mirrored joints next to the root."""
        beside = [
            j for j in range(len(self)) if self.parents[j] == self.root and self.mirror[j] != j
        ]
        return beside[0], beside[1]

    @cached_property
    def tree_levels(self) -> tuple[Index, ...]:
        """Joints by their distance from the root: level 0 is the root, level 1 its children, and so
        on.
        """
        levels = [np.array([self.root])]
        while len(children := np.flatnonzero(np.isin(self.parents, levels[-1]))) > 0:
            levels.append(children)
        return tuple(levels)

    @cached_property
    def adjacency(self) -> Index:
        """(J, J) adjacency matrix: 1 if a limb connects two joints."""
        joined = np.zeros((len(self), len(self)), dtype=np.intp)
        first, second = np.array(self.limbs).T
        joined[first, second] = joined[second, first] = 1
        return joined

    @cached_property
    def tree_neighbours(self) -> Index:
        """(J, N) parent and children of each joint in the tree, padded with -1."""
        parents = np.array(self.parents)
        lists = [
            [*parents[[j]][parents[[j]] >= 0], *np.flatnonzero(parents == j)]
            for j in range(len(self))
        ]
        most = max(map(len, lists))
        return np.array([row + [-1] * (most - len(row)) for row in lists], dtype=np.intp)


def _limbs(text: str) -> tuple[tuple[int, int], ...]:
    """Limbs from a text of index pairs: "1-8 9-10"."""
    pairs = (limb.split("-") for limb in text.split())
    return tuple((int(first), int(second)) for first, second in pairs)


def _grown(root: int, limbs: Sequence[tuple[int, int]], count: int) -> list[int]:
    """The parent of each joint in a tree grown from `root` along the limbs; -1 for the root and
    unreachable joints.
    """
    parents, reached = [-1] * count, [root]
    for joint in reached:
        for first, second in limbs:
            for end, other in ((first, second), (second, first)):
                if end == joint and other not in reached:
                    parents[other] = joint
                    reached.append(other)
    return parents


MID_HIP = "MidHip"
"""Name of the anchor of a person if it is computed: the midpoint of the hips."""

BODY_25 = Skeleton(
    name="BODY_25",
    joints=tuple(
        "Nose Neck RShoulder RElbow RWrist LShoulder LElbow LWrist MidHip RHip RKnee RAnkle LHip "
        "LKnee LAnkle REye LEye REar LEar LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel".split()
    ),
    limbs=_limbs(
        "1-8 9-10 10-11 8-9 8-12 12-13 13-14 1-2 2-3 3-4 2-17 1-5 5-6 6-7 5-18 1-0 0-15 0-16 "
        "15-17 16-18 14-19 19-20 14-21 11-22 22-23 11-24"
    ),
    parents=(1, 8, 1, 2, 3, 1, 5, 6, -1, 8, 9, 10, 8, 12, 13, 0, 0, 15, 16, 14, 19, 14, 11, 22, 11),
    mirror=(
        0,
        1,
        5,
        6,
        7,
        2,
        3,
        4,
        8,
        12,
        13,
        14,
        9,
        10,
        11,
        16,
        15,
        18,
        17,
        22,
        23,
        24,
        19,
        20,
        21,
    ),
    core=tuple(range(15)),
)
"""OpenPose's BODY_25, the reference skeleton of this package."""

_MIDDLES = {"Neck": ("RShoulder", "LShoulder"), MID_HIP: ("RHip", "LHip")}
"""BODY_25's joints on the midline, as midpoints of two others, for skeletons without them."""
_GROWN_FROM = dict(zip(BODY_25.joints, (BODY_25.joints[parent] for parent in BODY_25.parents),
                       strict=True)) | {
    "Head": "Neck", "head": "Neck", "neck": "Neck", "left_collar": "Neck", "right_collar": "Neck",
    "spine1": MID_HIP, "spine2": MID_HIP, "spine3": MID_HIP,
    "left_hand": "LWrist", "right_hand": "RWrist", "left_foot": "LAnkle", "right_foot": "RAnkle",
}  # fmt: skip
"""Parent joint of each body point; if a skeleton lacks it, the parent's parent is used."""


def body_skeleton(name: str, keypoints: Sequence[str], passed_over: int = 0) -> Skeleton:
    """Skeleton of a detector from the body points of its `keypoints`: those of BODY_25, HALPE's top
    of the head (`Head`), or SMPL_24's `head`, `neck`, spine, collars, hands and feet.

    Keypoints named "", and `passed_over` further ones at the end, are ignored. Missing Neck and
    MidHip are computed as midpoints. ValueError if shoulders or hips are missing.
    """
    given = [point for point in keypoints if point]
    lacking = [each for ends in _MIDDLES.values() for each in ends if each not in given]
    if lacking:
        problem = (
            f"there is no {' and no '.join(lacking)}, but both shoulders and both hips are needed"
        )
        raise ValueError(f"{name}: {problem}")
    middles = {joint: ends for joint, ends in _MIDDLES.items() if joint not in given}
    joints, names = (*given, *middles), BODY_25.joints
    parents = dict[str, str]()
    for joint in joints:
        parent = _GROWN_FROM[joint]
        while parent not in joints:
            parent = _GROWN_FROM[parent]
        if joint != MID_HIP:
            parents[joint] = parent
    limbs = [
        (names[a], names[b]) for a, b in BODY_25.limbs if names[a] in joints and names[b] in joints
    ]
    limbs += [
        (parent, joint)
        for joint, parent in parents.items()
        if (parent, joint) not in limbs and (joint, parent) not in limbs
    ]
    sides = [(joint, joint.replace("R", "L", 1).replace("right_", "left_")) for joint in joints]
    return Skeleton.of(
        name,
        keypoints,
        limbs,
        anchor=MID_HIP,
        mirror=[(right, left) for right, left in sides if right != left and left in joints],
        core=[names[joint] for joint in BODY_25.core if names[joint] in joints],
        middles=middles,
        parents=parents,
        passed_over=passed_over,
    )


def _layout(name: str, keypoints: str, passed_over: int = 0) -> Skeleton:
    """A skeleton from a text of its keypoints; - is a keypoint that is ignored."""
    return body_skeleton(
        name, ["" if point == "-" else point for point in keypoints.split()], passed_over
    )


_COCO = (
    "Nose LEye REye LEar REar LShoulder RShoulder LElbow RElbow LWrist RWrist LHip RHip LKnee "
    "RKnee LAnkle RAnkle"
)
_HALPE = f"{_COCO} Head Neck MidHip LBigToe RBigToe LSmallToe RSmallToe LHeel RHeel"
_FEET = "LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel"
_ARMS = "RShoulder RElbow RWrist LShoulder LElbow LWrist"
_LEGS = "RHip RKnee RAnkle LHip LKnee LAnkle"

COCO_17 = _layout("COCO_17", _COCO)
"""COCO's 17 keypoints; Neck and MidHip are computed."""
COCO_18 = _layout("COCO_18", f"Nose Neck {_ARMS} {_LEGS} REye LEye REar LEar")
"""OpenPose's COCO model; MidHip is computed."""
HALPE_26 = _layout("HALPE_26", _HALPE)
"""HALPE's body with feet, AlphaPose's and RTMPose's."""
"""HALPE's whole body; face and hands are ignored."""
COCO_133 = _layout("COCO_133", f"{_COCO} {_FEET}", passed_over=110)
"""COCO-WholeBody; Neck and MidHip are computed, face and hands are ignored."""
BODY_25B = _layout("BODY_25B", f"{_COCO} head Head {_FEET}")
"""OpenPose's BODY_25B: COCO's joints, MPII's upper neck and top of the head, feet."""

SKELETONS = {
    each.name: each
    for each in (
        BODY_25,
        COCO_17,
        COCO_18,
        HALPE_26,
        COCO_133,
        _layout("HALPE_136", _HALPE, passed_over=110),
        BODY_25B,
        _layout("BODY_135", f"{_COCO} head Head {_FEET}", passed_over=110),
        _layout("COCO_23", f"{_COCO} {_FEET}"),
        _layout("HALPE_68", _HALPE, passed_over=42),
        _layout(
            "H36M_17",
            "MidHip RHip RKnee RAnkle LHip LKnee LAnkle spine2 Neck head Head LShoulder LElbow "
            "LWrist RShoulder RElbow RWrist",
        ),
        _layout("POSETRACK_17", f"Nose head Head {_COCO.split(maxsplit=3)[3]}"),
        _layout("MPI_INF_3DHP_17", f"Head Neck {_ARMS} {_LEGS} MidHip spine2 head"),
        _layout(
            "MPII_16",
            "RAnkle RKnee RHip LHip LKnee LAnkle MidHip Neck head Head RWrist RElbow RShoulder "
            "LShoulder LElbow LWrist",
        ),
        _layout("MPI_15", f"Head Neck {_ARMS} {_LEGS} spine3"),
        _layout(
            "JHMDB_15",
            (
                "Neck spine1 - RShoulder LShoulder RHip LHip RElbow LElbow RKnee LKnee RWrist "
                "LWrist RAnkle LAnkle"
            ),
        ),
        _layout(
            "CROWDPOSE_14",
            (
                "LShoulder RShoulder LElbow RElbow LWrist RWrist LHip RHip LKnee RKnee LAnkle "
                "RAnkle Head Neck"
            ),
        ),
        _layout("AIC_14", f"{_ARMS} {_LEGS} Head Neck"),
        _layout(
            "LSP_14",
            (
                "RAnkle RKnee RHip LHip LKnee LAnkle RWrist RElbow RShoulder LShoulder LElbow "
                "LWrist Neck Head"
            ),
        ),
        _layout(
            "BLAZEPOSE_33",
            "Nose - LEye - - REye - LEar REar - - LShoulder RShoulder LElbow RElbow LWrist RWrist"
            " - - - - - - LHip RHip LKnee RKnee LAnkle RAnkle LHeel RHeel LBigToe RBigToe",
        ),
    )
}
"""Known skeletons of detection files; among those with the same number of keypoints, the most
common comes first."""

SMPL_24 = tuple(
    "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 "
    "left_foot right_foot neck left_collar right_collar head left_shoulder right_shoulder "
    "left_elbow right_elbow left_wrist right_wrist left_hand right_hand".split()
)
"""The 24 joints of SMPL's kinematic tree, in SMPL's order."""


def smpl_joints(names: str) -> tuple[int, ...]:
    """Indices in `SMPL_24` of joints, whose names are separated by spaces."""
    return tuple(map(SMPL_24.index, names.split()))
