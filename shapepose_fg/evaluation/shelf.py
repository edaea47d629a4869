"""Shelf's annotation in the terms of a reconstruction: limbs, actors, and BODY_25 as its joints."""

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.shelf_annotation import SHELF_JOINTS

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
