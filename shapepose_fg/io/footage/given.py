"""What options say of each camera: values for all or by name, and how the pictures are placed."""

from collections.abc import Mapping, Sequence

from shapepose_fg.camera import Rig
from shapepose_fg.errors import InputError
from shapepose_fg.io.footage.placement import Placement, PlacementKind, place


def per_camera(option: str, given: Sequence[str], rig: Rig, *, one_for_all: bool) -> list[str | None]:
    """(V,) what an option says of each camera: CAMERA=VALUE, or where it may be one VALUE for all."""
    values: dict[str, str] = {}
    rest: str | None = None
    for text in given:
        name, separator, value = text.rpartition("=")
        if not separator and one_for_all and rest is None:
            rest = text
        elif not separator:
            raise InputError(f"{option} {text}: must be CAMERA=VALUE, such as {option} {rig.names[0]}=VALUE")
        elif name not in rig.names:
            raise InputError(
                f"{option} {text}: the calibration has no camera {name!r}; it has {' '.join(rig.names)}"
            )
        elif name in values:
            raise InputError(f"{option} {text}: camera {name} is given twice; give it once")
        else:
            values[name] = value
    return [values.get(name, rest) for name in rig.names]


def placements_of(
    given: Sequence[str], sizes: Mapping[str, tuple[int, int]], rig: Rig
) -> tuple[dict[str, Placement], list[str]]:
    """Where calibrated pixels lie in the pictures of cameras, `sizes` (width, height), and what was concluded.

    `given` are kinds of placement, for all cameras or CAMERA=KIND.
    """
    words = dict(zip(rig.names, per_camera("--image-placement", given, rig, one_for_all=True), strict=True))
    placements, notes = {}, []
    for camera in rig.cameras:
        word = words[camera.name]
        if word is not None and word not in set(PlacementKind):
            raise InputError(f"--image-placement {word}: must be one of {' '.join(PlacementKind)}")
        if camera.name in sizes:
            wanted = None if word is None else PlacementKind(word)
            placements[camera.name], concluded = place(camera.name, sizes[camera.name], camera.image_size, wanted)
            notes += [] if concluded is None else [concluded]
    return placements, notes
