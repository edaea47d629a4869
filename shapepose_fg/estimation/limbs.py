"""Arms and legs among a detector's joints."""

from collections.abc import Iterable, Sequence

ARMS_AND_LEGS = {
    ("Shoulder", "Elbow"): 0.06, ("Elbow", "Wrist"): 0.05, ("Hip", "Knee"): 0.09,
    ("Knee", "Ankle"): 0.07,
}  # fmt: skip
"""Limbs on either side, from the trunk outwards, and half their widths, metres."""


def on_both_sides(parts: Iterable[tuple[str, ...]], joints: Sequence[str]) -> list[tuple[int, ...]]:
    """Indices of the joints of `parts`, named without side, right and left, if all are
    in `joints`.
    """
    named = [tuple(f"{side}{name}" for name in part) for side in "RL" for part in parts]
    return [tuple(joints.index(name) for name in part) for part in named if {*part} <= {*joints}]
