"""Where results of other systems lie, so that they are scored beside ours: a folder for each recording."""

from pathlib import Path

from shapepose_fg.evaluation.experiments.scale import Stretch
from shapepose_fg.evaluation.other_results.reading import read_people
from shapepose_fg.reconstruction import Reconstruction

FILTERED, RAW = "pose2sim", "pose2sim-raw"
"""Pose2Sim with time (gaps interpolated, outliers rejected, low-pass), and frame by frame."""
SHELF_FPS = 25.0
"""Frames a second of the Shelf recording."""


def folder_name(stretch: Stretch) -> str:
    """The folder of a stretch among those of other systems' results."""
    return f"{stretch.split}-{stretch.name}-{stretch.span.start}-{stretch.span.stop}"


def read_other(others: Path | None, recording: str, kind: str) -> Reconstruction | None:
    """What another system made of a recording; None where there is nothing."""
    if others is None or not (others / recording / kind).is_dir():
        return None
    return read_people(others / recording / kind)
