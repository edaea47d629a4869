"""Hands that were held stay held when bodies of other shapes repeat a dance."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from shapepose_fg.simulation.performance import Performance

Array = NDArray[np.float64]

_ARMS = ((13, 16, 18, 20, 22), (14, 17, 19, 21, 23))
"""Collar, shoulder, elbow, wrist, hand: left, right."""
_HELD_M, _FREE_M = 0.17, 0.27
"""Hands nearer than the first are held, farther than the second they are not: the recordings' limbs and those of
drawn bodies leave 10 to 20 cm between hands that touched."""
_TOUCH_M = 0.07
"""Distance between the knuckles of two hands that hold each other."""
_STRETCH = 0.995
"""An arm is never quite straight."""


def hold_hands(lead: Performance, follow: Performance, fps: float) -> tuple[Performance, Performance]:
    """Bring together hands of two people that are nearly together and stay so for a while, each half of the way.

    Only shoulders and elbows turn: the elbow bends by the law of cosines, the shoulder turns the arm along the
    shortest arc. Each hand goes to the other's nearest one.
    """
    if len(lead) == 0:
        return lead, follow
    pull = _pull(lead, follow, fps)
    for _ in range(2):  # the hand's own length turns with the arm: the second pass takes up what is left
        hands = [person.joints[:, [22, 23]] for person in (lead, follow)]
        apart = hands[1][:, None] - hands[0][:, :, None]  # (T, 2, 2, 3) from the lead's hands to the follow's
        gap = np.linalg.norm(apart, axis=-1)
        step = (pull * np.maximum(1.0 - _TOUCH_M / np.maximum(gap, 1e-6), 0.0) / 2)[..., None] * apart
        lead = _reach(lead, step.sum(axis=2))
        follow = _reach(follow, -step.sum(axis=1))
    return lead, follow


def _pull(lead: Performance, follow: Performance, fps: float) -> Array:
    """(T, 2, 2) how firmly each hand of the lead holds each of the follow's, 0 to 1, smooth in time."""
    gap = np.linalg.norm(lead.joints[:, [22, 23], None] - follow.joints[:, None, [22, 23]], axis=-1)
    near = np.clip((_FREE_M - gap) / (_FREE_M - _HELD_M), 0.0, 1.0)
    nearest = np.exp(-gap / 0.02)
    # A hand that is near to both of the other's hands holds the nearer one.
    share = nearest / np.maximum(
        np.maximum(nearest.sum(axis=1, keepdims=True), nearest.sum(axis=2, keepdims=True)), 1e-300
    )
    return gaussian_filter1d(near * share, 0.12 * fps, axis=0, mode="nearest")


def _reach(person: Performance, steps: Array) -> Performance:
    """Move the hands by `steps` (T, 2, 3) metres, left and right, as far as the arms go."""
    rotations, joints = person.rotations.copy(), person.joints.copy()
    world = rotations[:, 0]
    for joint in (3, 6, 9):
        world = world @ rotations[:, joint]
    for side, (collar, shoulder, elbow, wrist, hand) in enumerate(_ARMS):
        girdle = world @ rotations[:, collar]
        upper = girdle @ rotations[:, shoulder]
        fore = upper @ rotations[:, elbow]
        root, middle, end = (joints[:, joint] for joint in (shoulder, elbow, wrist))
        target = end + steps[:, side]
        bend = _bend(middle - root, end - middle, np.linalg.norm(target - root, axis=1))
        swing = _shortest(middle - root + np.einsum("tij,tj->ti", bend, end - middle), target - root)
        upper, fore = swing @ upper, swing @ bend @ fore
        rotations[:, shoulder] = np.swapaxes(girdle, -1, -2) @ upper
        rotations[:, elbow] = np.swapaxes(upper, -1, -2) @ fore
        bones = ((shoulder, elbow, upper), (elbow, wrist, fore), (wrist, hand, fore @ rotations[:, wrist]))
        for parent, joint, turned in bones:
            joints[:, joint] = joints[:, parent] + turned @ (person.rest[joint] - person.rest[parent])
    return replace(person, rotations=rotations, joints=joints)


def _bend(upper: Array, lower: Array, distance: Array) -> Array:
    """Rotation (T, 3, 3) of the forearm `lower` (T, 3) after which the arm is `distance` (T,) long."""
    a, b = np.linalg.norm(upper, axis=1), np.linalg.norm(lower, axis=1)
    axis = np.cross(upper, lower)
    size = np.linalg.norm(axis, axis=1)
    now = np.arctan2(size, (upper * lower).sum(axis=1))
    length = np.clip(distance, np.abs(a - b) + 0.12, _STRETCH * (a + b))
    then = np.arccos(np.clip((length**2 - a**2 - b**2) / (2 * a * b), -1.0, 1.0))
    # The axis of an arm that is straight is not known: such an arm does not bend.
    weight = np.clip(size / (a * b) / 0.05, 0.0, 1.0)
    change = (weight * (then - now) / np.maximum(size, 1e-9))[:, None] * axis
    return Rotation.from_rotvec(change).as_matrix()


def _shortest(before: Array, after: Array) -> Array:
    """Rotation (T, 3, 3) along the shortest arc from direction `before` to `after`, (T, 3) each."""
    axis = np.cross(before, after)
    size = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(size, (before * after).sum(axis=1))
    return Rotation.from_rotvec((angle / np.maximum(size, 1e-12))[:, None] * axis).as_matrix()
