"""Tables and figures of docs/simulation.md: python scripts/reproduce_simulation.py [--only NAME ...] [--update].

`detector` sets the simulated detector beside the real one, `difficulty` reconstructs the named sequences,
`visibility` compares the quick depth buffer with an exact one. The first needs the Shelf recording, the second the
recorded motions (`--data FOLDER`, or SHAPEPOSE_DATA); what is not there is left out. `--update` writes the tables
between their marks `<!-- NAME -->` and `<!-- end -->`, and the figures into docs/images. Takes about ten minutes:
two, seven and one. What the detector draws from is made by `measure_detector.py`.
"""

import argparse
import os
from collections.abc import Callable
from pathlib import Path

import torch
from marked_tables import IMAGES, ROOT, SIMULATION, write_table

from shapepose_fg.evaluation import sequence_difficulty, visibility_agreement
from shapepose_fg.simulation.measurement.comparison import compare, table


def main() -> None:
    """Print every table; with --update write them, and the figures, into the documents too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    )
    names = ("detector", "difficulty", "visibility")
    parser.add_argument("--only", nargs="*", choices=names, default=names, help="names of tables")
    parser.add_argument("--stride", type=int, default=20, help="difficulty: reconstruct every so-many-th frame")
    parser.add_argument("--split", choices=("tune", "report"), action="append", help="difficulty: both by default")
    parser.add_argument("--update", action="store_true", help="write tables and figures into the documents")
    arguments = parser.parse_args()
    if arguments.update and arguments.split and "difficulty" in arguments.only:
        parser.error("a table of one split is not written: leave out --split or --update")
    torch.set_num_threads(1)
    shelf = arguments.data / "data" / "shelf"
    motions = arguments.data / "data" / "cmu_mocap" / "cmu_smpl24.npz"
    images = IMAGES if arguments.update else None
    splits = arguments.split or ("tune", "report")
    tables: dict[str, tuple[Path | None, Callable[[], list[str]]]] = {
        "detector": (shelf, lambda: detector(shelf, images)),
        "difficulty": (motions, lambda: sequence_difficulty.table(motions, splits, arguments.stride)),
        "visibility": (None, visibility_agreement.table),
    }
    for name in arguments.only:
        needed, make = tables[name]
        if needed is not None and not needed.exists():
            print(f"{name}: left out, {needed} is not there (--data FOLDER, or SHAPEPOSE_DATA)\n")
            continue
        text = "\n".join(make())
        print(f"{name}\n\n{text}\n", flush=True)
        if arguments.update:
            write_table(name, text, SIMULATION)


def detector(shelf: Path, images: Path | None) -> list[str]:
    """The simulated detector beside the real one; figures into the folder `images`, if given."""
    both, each = compare(shelf)
    if images is not None:
        from shapepose_fg.simulation.measurement.figures import draw_figures

        draw_figures(images, both)
    return table(both, each)


if __name__ == "__main__":
    main()
