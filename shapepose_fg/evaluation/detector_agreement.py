"""The simulated detector beside the real one, as a Markdown table, and its figures."""

from pathlib import Path

from shapepose_fg.simulation.measurement.comparison import compare
from shapepose_fg.simulation.measurement.comparison import table as table_of


def table(shelf: Path, images: Path | None) -> list[str]:
    """Beside the recording in the folder `shelf`; figures into the folder `images`, if given."""
    both, each = compare(shelf)
    if images is not None:
        from shapepose_fg.simulation.measurement.figures import draw_figures

        draw_figures(images, both)
    return table_of(both, each)
