"""What the simulated detector draws from, as measured on a sample."""

from typing import Any

from shapepose_fg.core.camera import Rig
from shapepose_fg.simulation.measurement.affinities import affinity_tables
from shapepose_fg.simulation.measurement.classes import GROUP, GROUPS, LEVELS, joint_states
from shapepose_fg.simulation.measurement.confusions import capture, false_candidates, merging, swaps
from shapepose_fg.simulation.measurement.errors import confidence_tables, error_tables
from shapepose_fg.simulation.measurement.memories import joint_correlation, memories
from shapepose_fg.simulation.measurement.misses import miss_tables
from shapepose_fg.simulation.measurement.people import RAMP
from shapepose_fg.simulation.measurement.sample import Sample


def statistics(sample: Sample, rig: Rig, fps: float) -> dict[str, Any]:
    """What the simulated detector draws from; lengths in metres, times in seconds."""
    expected = sample.expected
    state = joint_states(expected)
    confidence = confidence_tables(expected, state)
    errors = error_tables(expected, state)
    return {
        "states": ["visible", "hidden by itself", "hidden by another person"],
        "levels": LEVELS.tolist(),
        **miss_tables(expected, state, GROUP[expected["joint"]], len(GROUPS)),
        **confidence,
        **errors,
        "facing": RAMP.tolist(),
        "memory": memories(expected, state, errors, fps),
        "joint_correlation": joint_correlation(expected, state, errors, rig),
        "swap": swaps(expected),
        "capture": capture(sample.captured),
        "merge": merging(sample, rig),
        "false": false_candidates(sample, rig, fps),
        "affinity": affinity_tables(sample.pairs),
    }
