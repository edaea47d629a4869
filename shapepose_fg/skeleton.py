"""What a detector's joints are called, how limbs join them, and which are left and right of each other."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Skeleton:
    """The joints of one detector, in its own order."""

    name: str
    """For messages and files."""
    joints: tuple[str, ...]
    """The J joint names, as OpenPose writes them."""
    limbs: tuple[tuple[int, int], ...]
    """The L pairs of joints between which part affinities are given, in the detector's order."""
    parents: tuple[int, ...]
    """(J,) the joint that a joint is grown from; -1 for the root, which is the anchor of a person."""
    mirror: tuple[int, ...]
    """(J,) the same joint on the other side of the body; a joint in the middle is its own mirror."""
    core: tuple[int, ...]
    """The body parts by which a person is recognised: trunk, arms and legs, without face and toes."""

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
    def hips(self) -> tuple[int, int]:
        """The two joints beside the root that mirror each other, right first."""
        beside = [j for j in range(len(self)) if self.parents[j] == self.root and self.mirror[j] != j]
        return beside[0], beside[1]

    @cached_property
    def tree_levels(self) -> tuple[NDArray[np.intp], ...]:
        """Joints by their distance from the root: level 0 is the root alone, level 1 its children, ..."""
        depth = np.zeros(len(self), dtype=int)
        for joint in range(len(self)):
            node = joint
            while self.parents[node] >= 0:
                node = self.parents[node]
                depth[joint] += 1
        return tuple(np.flatnonzero(depth == level) for level in range(depth.max() + 1))

    @cached_property
    def adjacency(self) -> NDArray[np.intp]:
        """(J, J) 1 where a limb joins two joints."""
        joined = np.zeros((len(self), len(self)), dtype=np.intp)
        first, second = np.array(self.limbs).T
        joined[first, second] = joined[second, first] = 1
        return joined

    @cached_property
    def tree_neighbours(self) -> NDArray[np.intp]:
        """(J, N) parent and children of each joint in the tree, filled up with -1."""
        children = [[j for j in range(len(self)) if self.parents[j] == joint] for joint in range(len(self))]
        lists = [[p for p in (self.parents[joint],) if p >= 0] + children[joint] for joint in range(len(self))]
        table = np.full((len(self), max(len(row) for row in lists)), -1, dtype=np.intp)
        for joint, row in enumerate(lists):
            table[joint, : len(row)] = row
        return table


def _limbs(text: str) -> tuple[tuple[int, int], ...]:
    """Limbs from their usual notation: "1-8 9-10"."""
    pairs = (limb.split("-") for limb in text.split())
    return tuple((int(first), int(second)) for first, second in pairs)


BODY_25 = Skeleton(
    name="BODY_25",
    joints=tuple(
        "Nose Neck RShoulder RElbow RWrist LShoulder LElbow LWrist MidHip RHip RKnee RAnkle LHip LKnee "
        "LAnkle REye LEye REar LEar LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel".split()
    ),
    limbs=_limbs(
        "1-8 9-10 10-11 8-9 8-12 12-13 13-14 1-2 2-3 3-4 2-17 1-5 5-6 6-7 5-18 1-0 0-15 0-16 15-17 16-18 "
        "14-19 19-20 14-21 11-22 22-23 11-24"
    ),
    parents=(1, 8, 1, 2, 3, 1, 5, 6, -1, 8, 9, 10, 8, 12, 13, 0, 0, 15, 16, 14, 19, 14, 11, 22, 11),
    mirror=(0, 1, 5, 6, 7, 2, 3, 4, 8, 12, 13, 14, 9, 10, 11, 16, 15, 18, 17, 22, 23, 24, 19, 20, 21),
    core=tuple(range(15)),
)
"""OpenPose's BODY_25: the skeleton of the detections and of the results."""

SMPL_24 = tuple(
    "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot "
    "right_foot neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow "
    "left_wrist right_wrist left_hand right_hand".split()
)
"""The 24 joints of SMPL's kinematic tree, in SMPL's order."""
