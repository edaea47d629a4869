"""Options for the cameras' videos or pictures, and the opened footage."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shapepose_fg.cli.options import INPUT, option
from shapepose_fg.cli.terminal import note, progress
from shapepose_fg.core.result_files import MOMENTS, results_folder

if TYPE_CHECKING:
    from shapepose_fg.core.camera import Rig
    from shapepose_fg.io.footage.footage import Footage
    from shapepose_fg.io.footage.placement import CameraFootage


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """Options: the cameras' videos or pictures."""

    videos: list[str] | None = option(
        INPUT,
        (
            "Folder with a video, picture or folder of pictures named after each camera; or the "
            "path of one camera."
        ),
        None,
        "--videos",
        "--images",
        metavar="FOLDER|CAMERA=PATH",
    )
    image_placement: list[str] | None = option(
        INPUT,
        "How pictures of another size were made: scale, letterbox, crop, crop-centre; or same.",
        metavar="KIND|CAMERA=KIND",
    )

    def named(self, rig: "Rig") -> list[str]:
        """The cameras with individually given videos; all cameras if there are none."""
        names = {each.partition("=")[0].strip() for each in self.videos or [] if "=" in each}
        return [name for name in rig.names if name in names] or list(rig.names)

    def names(self) -> list[str]:
        """The names of the cameras with videos or pictures."""
        from shapepose_fg.io.footage.places import names_of_footage

        return list(names_of_footage(self.videos or []))

    def opened(self, names: Sequence[str]) -> "dict[str, Footage]":
        """The footage of each camera; each video is decoded once, to count its frames."""
        from shapepose_fg.io.footage.places import find_footage

        given = self.videos or []
        places, notes = find_footage(given, names)
        note(*notes)
        return {name: opened(name, path) for name, path in zip(names, places, strict=True)}

    def of_result(
        self,
        results: Path,
        run: Mapping[str, Any],
        rig: "Rig",
        drawn: Sequence[str],
        detections: Path | None = None,
    ) -> "list[tuple[CameraFootage, Footage]]":
        """The pictures of the cameras `drawn` for the result in `results`; `run` is the content of
        its run.json (see `pictures_of`).
        """
        from shapepose_fg.io.footage.placement import FOOTAGE
        from shapepose_fg.io.recording import read_moments
        from shapepose_fg.viz.overlay.result_pictures import pictures_of

        folder = results_folder(results)
        if detections is None and (folder / FOOTAGE).is_file():
            detections = folder
        moments = read_moments(folder / MOMENTS) if (folder / MOMENTS).is_file() else {}
        return pictures_of(
            run,
            rig,
            drawn,
            self.videos,
            detections,
            self.image_placement or (),
            moments,
            opened,
            note,
        )


def opened(name: str, path: Path) -> "Footage":
    """A camera's footage; a video is decoded once, to count its frames, with a progress bar.
    Notes are printed.
    """
    from shapepose_fg.io.footage.footage import open_footage

    with progress(f"reading {name}") as done:
        footage = open_footage(path, done)
    note(*footage.notes)
    return footage
