"""Where a saved result is, as a user says it."""

from pathlib import Path


def results_folder(results: Path) -> Path:
    """The folder of a result, which may be given as its people.npz too."""
    return results.parent if results.name == "people.npz" else results
