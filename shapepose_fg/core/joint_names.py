"""Names of joints in other programs, and the body points that they stand for."""

import re
from collections.abc import Sequence

from shapepose_fg.core.skeleton import LONGEST_NAME, SKELETONS, Skeleton, body_skeleton

_ALIASES = {
    "BODY_25": "body25 openpose openposebody25",
    "BODY_25B": "body25b",
    "BODY_135": "body135",
    "COCO_17": "coco coco17 cocokeypoints person body ochuman humanart body17 yolo yolopose",
    "COCO_18": "coco coco18 openposecoco cocoopenpose",
    "COCO_23": "coco23 cocofoot",
    "COCO_133": (
        "coco133 coco133wrist cocowholebody wholebody wholebodywrist ubody ubody2d ubody3d h3wb "
        "halpe"
    ),
    "HALPE_26": "halpe halpe26 bodywithfeet body26",
    "HALPE_68": "halpe halpe68 halpe68noface",
    "HALPE_136": "halpe halpe136",
    "H36M_17": "h36m h36m17 human36m",
    "MPI_INF_3DHP_17": "mpiinf3dhp 3dhp",
    "POSETRACK_17": "posetrack posetrack17 posetrack18",
    "MPII_16": "mpii mpii16",
    "MPI_15": "mpi mpii mpi15",
    "JHMDB_15": "jhmdb",
    "CROWDPOSE_14": "crowdpose crowdpose14",
    "AIC_14": "aic aichallenger",
    "LSP_14": "lsp lsp14 lspet",
    "BLAZEPOSE_33": "blazepose mediapipe mediapipepose blazepose33",
}
"""Names of each layout in other programs, without case and separators. OpenPose's and Pose2Sim's
COCO and MPII are not COCO's and MMPose's: the number of keypoints distinguishes them."""


def layouts_called(name: str) -> list[Skeleton]:
    """The known skeletons that a layout's `name` may stand for in any program; empty for an unknown
    name.
    """
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    return [
        skeleton
        for known, skeleton in SKELETONS.items()
        if plain and plain in (known.lower().replace("_", ""), *_ALIASES.get(known, "").split())
    ]


_SIDED = {
    "Shoulder": "shoulder sho",
    "Elbow": "elbow elb",
    "Wrist": "wrist wri",
    "Hip": "hip",
    "Knee": "knee kne",
    "Ankle": "ankle ank",
    "Eye": "eye",
    "Ear": "ear",
    "BigToe": "bigtoe toe toes footindex hallux",
    "SmallToe": "smalltoe littletoe pinkytoe fifthtoe",
    "Heel": "heel",
    "collar": "collar clavicle",
    "foot": "foot forefoot",
    "hand": "hand",
}
"""Joints on both sides of the body: our name without the side, and the names in other programs."""
_MIDDLE = {
    "Nose": "nose",
    "Neck": "neck neckbase baseneck shoulder shoulders thorax sternum spineshoulder",
    "MidHip": "hip hips pelvis root spinebase basespine",
    "Head": "head headtop tophead topofhead vertex",
    "head": "upperneck headbottom neckupper neckbase necknose noseneck",
    "spine1": "spine1 belly abdomen navel spinenavel spinenaval",
    "spine2": "spine2 spine torso spinemid",
    "spine3": "spine3 chest spinechest",
}
"""Joints on the midline of the body: our name, and the names in other programs."""
_PART_OF_SIDE = {word: part for part, words in _SIDED.items() for word in words.split()}
_BONES = {
    **dict.fromkeys(("upleg", "thigh", "upperleg"), "Hip"),
    **dict.fromkeys(("leg", "calf", "shin", "lowerleg"), "Knee"),
    **dict.fromkeys(("arm", "upperarm"), "Shoulder"),
    **dict.fromkeys(("forearm", "lowerarm"), "Elbow"),
}
"""Joints named after the bone that starts there, as by Apple and Mixamo."""
_LEFT_OUT = {
    "mid",
    "middle",
    "center",
    "centre",
    "joint",
    "jc",
    "c",
    "of",
    "the",
    "keypoint",
    "landmark",
}
"""Words that are ignored in names; a joint without a side is on the midline."""
_SIDES = {"l": "L", "left": "L", "r": "R", "right": "R"}


def _words(name: str) -> list[str]:
    """The words of a name in lower case: l and hip for `LHip`, left and hip for `left_hip` and
    `leftHip`.
    """
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)]


def _side_and_part(words: Sequence[str]) -> tuple[str, str]:
    """Split a joint's words into its side ("L", "R" or "") and the remaining words, joined."""
    words = [word for word in words if word not in _LEFT_OUT]
    sides = [word for word in words if word in _SIDES]
    if len(sides) == 1:
        return _SIDES[sides[0]], "".join(
            word for word in words if word not in _SIDES and word != "1"
        )
    plain = "".join(words)
    for side in ("left", "right", "l", "r"):  # as in lshoulder, shoulderleft
        for rest in (
            plain.removeprefix(side),
            plain.removesuffix(side) if len(side) > 1 else plain,
        ):
            if rest != plain and rest in _PART_OF_SIDE:
                return _SIDES[side], rest
    return "", plain


def body_points(names: Sequence[str]) -> list[str]:
    """The body point of each of a file's joint `names`; "" for names without one.

    Case, separators and the position of the side are ignored. Ambiguous names are resolved by the
    others: "foot" is the ankle if no ankle is named, and "head" is the top of the head if no top is
    named. Bone names stand for the joint at which the bone starts, if a thigh is named.
    """
    short = (name[:LONGEST_NAME] for name in names)
    every = [_words(re.sub(r"\(.*?\)", "", name) or name) for name in short]
    while len(every) > 1 and min(map(len, every)) > 1 and len({words[0] for words in every}) == 1:
        if every[0][0] in _SIDES:
            break
        every = [
            words[1:] for words in every
        ]  # a prefix of all names is the name of the person or model
    split = [_side_and_part(words) for words in every]
    parts = {part for _, part in split}
    middle = {word: part for part, words in _MIDDLE.items() for word in words.split()}
    if parts & {
        "thorax",
        "sternum",
        "spineshoulder",
    }:  # in Human3.6M and MPII, "neck" is its upper end
        middle |= {"neckbase": "head", "neck": "neck"}
    else:
        middle |= {"neckbase": "Neck"}
    if parts & {"headtop", "tophead", "topofhead", "vertex"}:
        middle |= {"head": "head"}
    sided = dict(_PART_OF_SIDE)
    sided |= {} if parts & {"ankle", "ank"} else {"foot": "Ankle"}
    sided |= {} if parts & {"wrist", "wri"} else {"hand": "Wrist"}
    sided |= _BONES if parts & {"upleg", "thigh", "upperleg"} else {}
    sided |= (
        {"shoulder": "collar"} if parts & {"upleg", "thigh"} and parts & {"arm", "upperarm"} else {}
    )
    found, used = list[str](), set[str]()
    own = {"Head", "head"} <= set(names)  # our own names "Head" and "head" differ only in case
    for name, (side, part) in zip(names, split, strict=True):
        point = name if own and name in ("Head", "head") else middle.get(part, "")
        if side:
            point = sided.get(part, "")
            long = {"L": "left_", "R": "right_"}[side]
            point = point and (long + point if point[0].islower() else side + point)
        found.append("" if point in used else point)
        used.add(point)
    return found


def skeleton_of_names(names: Sequence[str]) -> tuple[Skeleton, list[str]]:
    """The skeleton of a file that names its joints, and the `names` that are ignored.

    A known skeleton is returned if it has the same order. ValueError if required joints are
    missing.
    """
    points = body_points(names)
    passed = [name for name, point in zip(names, points, strict=True) if not point]
    known = (each for each in SKELETONS.values() if keypoint_names(each) == points)
    return next(known, None) or body_skeleton(f"NAMED_{len(names)}", points), passed


def keypoint_names(skeleton: Skeleton) -> list[str]:
    """The joint of each keypoint in a detector's files, "" if it is ignored."""
    if skeleton.keypoints is None:
        return list(skeleton.joints)
    return ["" if joint < 0 else skeleton.joints[joint] for joint in skeleton.keypoints]


def mirrored(name: str) -> str:
    """Name of the corresponding joint on the other side of the body."""
    for sides in (("left", "right"), ("Left", "Right"), ("L", "R")):
        for one, other in (sides, sides[::-1]):
            if name.startswith(one):
                return other + name.removeprefix(one)
    return name
