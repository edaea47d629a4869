"""What the cameras took, in a rerun recording: undistorted, so that people and detections lie on it."""

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Camera
from shapepose_fg.io.export.job import optional
from shapepose_fg.io.export.rerun_people import set_time
from shapepose_fg.io.export.rerun_views import camera_path
from shapepose_fg.io.export.take import Take
from shapepose_fg.io.footage.footage import Footage
from shapepose_fg.io.footage.placement import Placement
from shapepose_fg.io.footage.used import CameraFootage

_QUALITY = 75
"""Of the JPEGs, of 100: a second of four cameras in full HD is about 30 MB."""


def log_pictures(
    stream: Any,
    take: Take,
    pictures: Sequence[tuple[CameraFootage, Footage]],
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """The pictures of a take's frames in the views of its cameras; a frame without a picture has none."""
    rr = optional("rerun", "view")
    if take.rig is None:
        raise ValueError("pictures need cameras")
    done, total = 0, len(pictures) * len(take.frames)
    for used, footage in pictures:
        camera = take.rig.cameras[take.rig.names.index(used.name)]
        maps = undistorting(camera, used.placement)
        path = f"{camera_path(camera.name)}/picture"
        for index, frame in enumerate(take.frames.tolist()):
            place = int(used.places[frame]) if frame < len(used.places) else -1
            picture = footage.at(place) if place >= 0 else None
            set_time(stream, take, index)
            if picture is None:
                stream.log(path, rr.Clear(recursive=False))
            else:
                straight = cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderValue=(90, 90, 90))
                _, jpeg = cv2.imencode(".jpg", straight, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
                stream.log(path, rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg"))
            done += 1
            if progress is not None:
                progress(done, total)


def undistorting(camera: Camera, placement: Placement) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where in a picture each pixel of the calibrated picture without distortion is: columns and rows, (H, W)."""
    width, height = camera.image_size
    column, row = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    pixels = np.stack([column.ravel(), row.ravel()], axis=1)
    there = placement.to_picture(camera.distort(pixels)).reshape(height, width, 2).astype(np.float32)
    return np.ascontiguousarray(there[..., 0]), np.ascontiguousarray(there[..., 1])
