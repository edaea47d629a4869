"""Simulation of people with ground truth, of cameras, and of a detector with realistic errors."""

from shapepose_fg.simulation.detector import DetectorConfig, simulate
from shapepose_fg.simulation.scene import Scene, built_in_scene

__all__ = ["DetectorConfig", "Scene", "built_in_scene", "simulate"]
