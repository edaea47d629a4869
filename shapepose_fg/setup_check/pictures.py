"""Whether pictures have the size that the calibration says."""

from collections.abc import Sequence

from shapepose_fg.core.camera import Rig
from shapepose_fg.io.footage.footage import glance, open_footage
from shapepose_fg.io.footage.places import VIDEOS, find_footage
from shapepose_fg.setup_check.changes import Kind
from shapepose_fg.setup_check.diagnosis import Finding


def other_sizes(given: Sequence[str], rig: Rig) -> tuple[Finding, ...]:
    """Cameras whose videos, or pictures, are not of the calibrated size; `given` as `find_footage` takes it."""
    found = []
    for view, path in enumerate(find_footage(given, rig.names)[0]):
        is_video = path.suffix.lower() in VIDEOS and path.is_file()
        width, height = glance(path)[0] if is_video else open_footage(path).size
        if (width, height) != rig.cameras[view].image_size:
            found.append(Finding(Kind.PICTURE_SIZE, (view,), shift_px=((float(width), float(height)),)))
    return tuple(found)
