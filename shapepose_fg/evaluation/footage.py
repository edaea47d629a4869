"""The real recordings that figures are of: cameras, detections, and when their frames were taken."""

from dataclasses import dataclass
from pathlib import Path

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detection_table import DetectionTable
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct

SHELF_FPS, SINGLE_FPS = 25.0, 60.0
"""Frames a second of Shelf, and of Pose2Sim's demo recording of one man."""


@dataclass(frozen=True)
class Footage:
    """A recording."""

    rig: Rig
    """Its cameras."""
    detections: DetectionTable
    """Of every frame."""
    fps: float
    """Frames a second."""

    @property
    def times(self) -> FrameTimes:
        """When its frames were taken."""
        return FrameTimes.from_fps(self.fps, len(self.detections))

    def reconstruct(self, config: PipelineConfig | None = None, frames: range | None = None) -> Reconstruction:
        """Its people; only in `frames`, if given."""
        return reconstruct(self.detections, self.rig, config, frames=frames, times=self.times)


def shelf_footage(folder: Path) -> Footage:
    """Shelf from its folder in the repository of Zhang et al. 2020. InputError where it is not that."""
    rig = read_rig(folder / "calibration.json")
    return Footage(rig, read_detections(folder, rig), SHELF_FPS)


def single_footage(folder: Path) -> Footage:
    """Pose2Sim's demo recording, with its detections in OpenPose's format. InputError where it is not that."""
    rig = read_rig(folder / "rig.json")
    return Footage(rig, read_detections(folder / "openpose", rig), SINGLE_FPS)
