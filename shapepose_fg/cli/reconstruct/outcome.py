"""What came of a recording; free of torch and of files, so that processes tell it each other."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Ended:
    """What came of a recording that was reconstructed; plain data."""

    frames: int
    """How many frames were reconstructed."""
    rows: int
    """Rows of people.npz."""
    people: int | None
    """How many there are over time; None without time."""
    warnings: tuple[str, ...]
    """What looks wrong with cameras and detections."""
