"""Draws bodies, skeletons, detections and labels on the original, distorted pictures of a camera,
at any size.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index, Mask, Real, Whole
from shapepose_fg.core.camera import Camera
from shapepose_fg.core.drawing import bones_of, colour_of, vertex_normals
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.core.rendering import NEAR_M, shaded
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.io.footage.footage import Picture
from shapepose_fg.io.footage.placement import Placement

Colour = tuple[int, int, int]
"""Blue, green, red, 0 to 255."""

GATED: Colour = (40, 40, 255)
"""Colour of detections that were not used."""
_WHITE: Colour = (255, 255, 255)
_DARK: Colour = (30, 30, 30)
_OPACITY = 0.45
"""Opacity of bodies, so that the picture behind them stays visible."""
_FINE = 8
"""Number of fractional bits of pixel coordinates in OpenCV's drawing functions."""
_REACH = 0.5
"""Distance outside the picture, as a share of its size, beyond which points are not drawn: the
distortion is not calibrated there, and its polynomial may map them back into the picture."""


@dataclass(frozen=True)
class PictureView:
    """A camera's pictures, with the size at which they are drawn."""

    camera: Camera
    """The camera, with its lens."""
    placement: Placement
    """Position of calibrated pixels in the camera's pictures."""
    size: tuple[int, int]
    """Width and height of the canvas, pixels: the picture, enlarged or reduced."""

    @property
    def scale(self) -> Array:
        """(2,) canvas pixels per pixel of the picture, x and y."""
        return np.array(self.size) / self.placement.picture_size

    def project(self, points: Real) -> tuple[Array, Array]:
        """Canvas pixels (..., 2) and depths (...,), metres, of `points` (..., 3) in the world.

        Pixels are NaN behind the camera, and far outside the picture.
        """
        xy, depth = self.camera.project(np.asarray(points, dtype=np.float64))
        xy[~(depth > NEAR_M)] = np.nan
        return self.through_lens(xy), depth

    def through_lens(self, xy: Real) -> Array:
        """Canvas pixels (..., 2) for undistorted pixels, such as those of observations."""
        flat = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        size = np.array(self.camera.image_size)
        with np.errstate(invalid="ignore"):
            near = np.all((flat > -_REACH * size) & (flat < (1 + _REACH) * size), axis=1)
        drawn = np.full(flat.shape, np.nan)
        on_picture = self.placement.to_picture(self.camera.distort(flat[near]))
        drawn[near] = (on_picture + 0.5) * self.scale - 0.5
        return drawn.reshape(np.shape(xy))


def blue_green_red(person: int) -> Colour:
    """The colour of an identity, the same in all visualisations."""
    red, green, blue = (round(255 * part) for part in colour_of(person))
    return blue, green, red


def stroke_of(size: tuple[int, int]) -> int:
    """Line width of bones for a picture of `size`, pixels."""
    return max(2, round(max(size) / 320))


def draw_bodies(
    picture: Picture,
    view: PictureView,
    vertices: Real,
    faces: Whole,
    colours: Sequence[Colour],
) -> Picture:
    """Draw the surfaces `vertices` (P, Nv, 3), metres in the world, one colour each, lit from the
    camera.
    """
    if len(vertices) == 0:
        return picture
    points, corners = _joined(vertices, faces)
    normals = vertex_normals(points, corners)
    light = 0.35 + 0.65 * np.clip(-(normals @ view.camera.wTc[:3, 2]), 0.0, 1.0)
    own = np.repeat(np.array(colours, dtype=np.float64) / 255, vertices.shape[1], axis=0)
    surface = 255 * shaded(*view.project(points), corners, light[:, None] * own, view.size)
    met = (surface >= 0).all(axis=2)
    drawn = picture.copy()
    drawn[met] = ((1 - _OPACITY) * picture[met] + _OPACITY * surface[met]).astype(np.uint8)
    return drawn


@dataclass(frozen=True)
class Skeletons:
    """People's joints in one frame."""

    joints: Array
    """(P, J, 3) metres; NaN if unknown."""
    seen: Mask
    """(P, J) whether a view detected the joint in this frame; other joints are inferred."""
    bones: Index
    """(B, 2) pairs of joints connected by lines."""
    colours: Sequence[Colour]
    """(P,) colour of each person."""
    labels: Sequence[str]
    """(P,) label above each person."""

    @classmethod
    def of(cls, people: Reconstruction) -> "Skeletons":
        """Skeletons of the rows of one frame."""
        numbers = people.person.tolist()
        return cls(
            joints=people.joints,
            seen=np.isin(people.known, (Known.SEEN, Known.UNKNOWN)),
            bones=bones_of(tuple(people.joint_names.tolist())),
            colours=[blue_green_red(each) for each in numbers],
            labels=[f"person {each}" for each in numbers],
        )


def draw_skeletons(picture: Picture, view: PictureView, people: Skeletons) -> None:
    """Draw bones, joints (dark if they are inferred) and labels on `picture`."""
    stroke = stroke_of(view.size)
    # Number of straight segments in which a bone is drawn, because lens distortion curves
    # it.
    part = np.linspace(0.0, 1.0, 8 + 1)[:, None]
    tops = []
    for joints, seen, colour in zip(people.joints, people.seen, people.colours, strict=True):
        ends = joints[people.bones]
        lines, _ = view.project(ends[:, :1] * (1 - part) + ends[:, 1:] * part)
        lines = lines[np.isfinite(lines).all(axis=(1, 2))]
        for width, paint in ((stroke + 2, _DARK), (stroke, colour)):
            draw_lines(picture, lines, paint, width)
        xy, _ = view.project(joints)
        known = np.isfinite(xy).all(axis=1)
        radius = round((stroke + 0.5) * (1 << _FINE))
        for centre, filled in zip(_fine(xy[known]).tolist(), seen[known].tolist(), strict=True):
            cv2.circle(picture, centre, radius, _WHITE if filled else _DARK, -1, cv2.LINE_AA, _FINE)
            cv2.circle(picture, centre, radius, colour, max(1, stroke // 2), cv2.LINE_AA, _FINE)
        tops.append(_top(xy[known], view.size))
    # Labels last, so that limbs do not cross them.
    for top, colour, label in zip(tops, people.colours, people.labels, strict=True):
        if top is not None:
            draw_label(picture, label, (top[0], top[1] - 5 * stroke), colour)


def draw_lines(picture: Picture, xy: Array, colour: Colour, width: int = 1) -> None:
    """Draw polylines through the canvas pixels `xy` (L, K, 2)."""
    cv2.polylines(picture, list(_fine(xy)), False, colour, width, cv2.LINE_AA, _FINE)


def _top(xy: Array, size: tuple[int, int]) -> tuple[float, float] | None:
    """Position for a label: horizontal centre of a person's joints `xy` (K, 2), and the highest of
    them; None outside the picture.
    """
    inside = np.all((xy >= 0) & (xy < np.array(size)), axis=1)
    if not inside.any():
        return None
    xy = xy[inside]
    return float((xy[:, 0].min() + xy[:, 0].max()) / 2), float(xy[:, 1].min())


def draw_detections(picture: Picture, xy: Array, used: Mask, colours: Whole) -> None:
    """Draw detections at canvas pixels `xy` (K, 2): used ones as squares in `colours` (K, 3),
    others as red crosses.
    """
    reach = max(2, stroke_of(picture.shape[1::-1]))
    visible = np.isfinite(xy).all(axis=1) & (np.abs(xy) < 30000).all(axis=1)
    drawn = np.rint(xy[visible]).astype(int).tolist(), used[visible].tolist(), colours[visible]
    for at, good, colour in zip(*drawn, strict=True):
        kind, size, pens = cv2.MARKER_TILTED_CROSS, 3 * reach, (max(3, reach), max(1, reach // 2))
        if good:
            kind, size, pens = cv2.MARKER_SQUARE, 2 * reach, (3, 1)
        for width, paint in zip(pens, (_DARK, (colour + 255) / 2 if good else GATED), strict=True):
            cv2.drawMarker(picture, at, tuple(paint), kind, size, width, cv2.LINE_AA)


def draw_label(
    picture: Picture, text: str, at: tuple[float, float], colour: Colour, *, centred: bool = True
) -> None:
    """Write `text` on a filled box with its lower edge at `at`, moved into the picture if
    necessary.
    """
    height, width = picture.shape[:2]
    size = max(0.4, max(height, width) / 1500)
    thick = max(1, round(1.6 * size))
    (across, tall), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, thick)
    pad = max(2, round(5 * size))
    left = round(at[0] - (across / 2 + pad if centred else 0))
    left = max(0, min(left, width - across - 2 * pad))
    bottom = max(tall + below + 2 * pad, min(round(at[1]), height - 1))
    top = bottom - tall - below - 2 * pad
    cv2.rectangle(picture, (left, top), (left + across + 2 * pad, bottom), colour, -1)
    light = np.dot(colour, (0.114, 0.587, 0.299)) > 150
    place, ink = (left + pad, bottom - pad - below), _DARK if light else _WHITE
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, ink, thick, cv2.LINE_AA)


def _fine(xy: Array) -> NDArray[np.int32]:
    """Convert pixels to the fixed-point coordinates of OpenCV's drawing functions."""
    return np.round(np.clip(xy, -30000, 30000) * (1 << _FINE)).astype(np.int32)


def write_picture(path: Path, picture: Picture) -> None:
    """Write a picture in the format of its suffix, .png or .jpg."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, 90] if path.suffix == ".jpg" else []
    done, content = cv2.imencode(path.suffix, picture, quality)
    if not done:
        raise InputError(f"{path}: pictures cannot be written in this format; use .png or .jpg")
    write_atomically(path, lambda stream: stream.write(content.tobytes()))


def _joined(vertices: Real, faces: Whole) -> tuple[Array, Index]:
    """Merge bodies (P, Nv, 3) with common `faces` (F, 3) to one mesh: vertices (P Nv, 3) and faces
    (P F, 3).
    """
    people, count = vertices.shape[:2]
    every = faces[None] + count * np.arange(people)[:, None, None]
    return vertices.reshape(people * count, 3).astype(np.float64), every.reshape(
        people * len(faces), 3
    )
