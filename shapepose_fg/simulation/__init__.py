"""People with known truth before simulated cameras, and a detector that errs."""

from shapepose_fg.simulation.detector import DetectorConfig, simulate
from shapepose_fg.simulation.scene import Scene, built_in_scene

__all__ = ["DetectorConfig", "Scene", "built_in_scene", "simulate"]
