"""The figures of README.md and docs/evaluation.md, as Markdown: python scripts/reproduce_tables.py [--update].

Scenes come from fixed seeds. The Shelf tables need the recording (`--data FOLDER`, or SHAPEPOSE_DATA) and are
left out without it; so are those of body fitters without the recorded motions.
`--only shelf` prints the tables whose names begin so. `--update` writes every table between its marks
`<!-- NAME -->` and `<!-- end -->` in the two files, and the figure into docs/images. Takes about two minutes, and
ten more for the fitters.
"""

import argparse
import os
from collections.abc import Callable
from pathlib import Path

import torch
from marked_tables import EVALUATION, IMAGES, README, ROOT, write_table

from shapepose_fg.evaluation import fitter_tables, scene_tables, shelf_tables


def main() -> None:
    """Print every table; with --update write them into the documents too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    )
    parser.add_argument("--only", nargs="*", help="names of tables, or their first words")
    parser.add_argument("--update", action="store_true", help="write the tables into the documents")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    trials = [scene_tables.Trial(seed) for seed in (scene_tables.DEMO, *scene_tables.SEEDS)]
    shelf = arguments.data / "data" / "shelf"
    tables: dict[str, Callable[[], list[str]]] = {
        "scenes": lambda: scene_tables.scene_table(trials),
        "alternation": lambda: scene_tables.alternation_table(trials),
        "covariances": lambda: scene_tables.covariance_table(trials),
        "cameras": scene_tables.camera_table,
    }
    if shelf.is_dir():
        tables |= {
            "shelf": lambda: shelf_tables.shelf_table(shelf_tables.shelf_steps(shelf)),
            "shelf limbs": lambda: shelf_tables.limb_table(shelf_tables.shelf_steps(shelf)),
        }
        tables |= {
            "contradictions": lambda: shelf_tables.contradiction_table(shelf),
            "sigma": lambda: shelf_tables.sigma_table(shelf),
        }
    else:
        print(f"(no Shelf recording in {shelf}: its tables are left out)\n")
    images = IMAGES if arguments.update else None
    tables |= fitter_tables.tables(arguments.data, images)
    for name, table in tables.items():
        if arguments.only is None or any(f"{name} ".startswith(f"{only} ") for only in arguments.only):
            text = "\n".join(table())
            print(f"{name}\n\n{text}\n", flush=True)
            if arguments.update:
                write_table(name, text, README, EVALUATION)


if __name__ == "__main__":
    main()
