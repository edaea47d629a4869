"""Every table of README.md and docs/, and its pictures: python scripts/reproduce_tables.py [--update].

    python scripts/reproduce_tables.py --quick                        # does everything work? two minutes
    python scripts/reproduce_tables.py --list                         # names, and how long each took the last time
    python scripts/reproduce_tables.py --only time shelf --update
    python scripts/reproduce_tables.py --split tune --only time --cases salsa   # choose on tune, report on report

Scenes come from fixed seeds. Recordings and recorded motions are taken from `--data FOLDER` (or SHAPEPOSE_DATA);
what needs them is left out without. Figures are kept in the folder `--results`: a run that was stopped goes on;
what is kept counts as long as default settings and shipped data are the same; after a change of code, `--afresh`.
`--update` writes tables between their marks `<!-- NAME @MADE WITH -->` and `<!-- end -->`, and pictures into
docs/images.
"""

import argparse
import os
from pathlib import Path

import torch
from marked_tables import IMAGES, ROOT, write_table

from shapepose_fg.evaluation.experiments.made_with import made_with
from shapepose_fg.evaluation.experiments.registry import experiments
from shapepose_fg.evaluation.experiments.runner import Kept, measured
from shapepose_fg.evaluation.experiments.scale import Scale

_BESIDE_OTHERS = ("shelf others", "interactions")
"""Tables that have rows of other systems."""


def main() -> None:
    """Measure what was asked for, and print or write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    )
    parser.add_argument("--only", nargs="*", help="names of tables, or their first words")
    parser.add_argument("--cases", nargs="*", help="first words of cases: only these of the tables")
    parser.add_argument("--split", choices=("tune", "report"), default="report", help="of the recorded motions")
    parser.add_argument(
        "--quick", action="store_true", help="a few frames of each but Shelf's own, fitters, simulator"
    )
    parser.add_argument("--list", action="store_true", help="measure nothing, say what there is")
    parser.add_argument("--afresh", action="store_true", help="measure again what is kept")
    parser.add_argument("--kept", action="store_true", help="measure nothing: tables whose figures are all kept")
    parser.add_argument("--results", type=Path, default=ROOT / "build" / "figures", help="where figures are kept")
    parser.add_argument("--others", type=Path, help="folder of results by scripts/run_pose2sim.py")
    parser.add_argument("--update", action="store_true", help="write the tables into the documents")
    arguments = parser.parse_args()
    if arguments.update and (arguments.quick or arguments.cases or arguments.split != "report"):
        parser.error("--update: of all cases at full scale, split report; leave out the other options")
    torch.set_num_threads(1)
    scale = Scale(arguments.quick, arguments.data if arguments.data.is_dir() else None, arguments.split)
    kept = Kept(arguments.results, "quick" if arguments.quick else arguments.split, arguments.afresh)
    total = 0.0
    for experiment in experiments(scale, IMAGES if arguments.update else None, arguments.others):
        if not _begins(experiment.name, arguments.only):
            continue
        part = experiment.only([case for case in experiment.cases if _begins(case.name, arguments.cases)])
        if arguments.list:
            print(f"{experiment.name:<24}{len(part.cases):>3} cases{kept.words(part)}")
            continue
        if arguments.kept and not kept.whole(part):
            continue
        if arguments.update and arguments.others is None and experiment.name in _BESIDE_OTHERS:
            print(f"{experiment.name}: left as it is; give --others, or rows of other systems would go\n")
            continue
        figures, seconds = measured(part, kept)
        total += seconds
        text = "\n".join(experiment.table(figures))
        print(f"{experiment.name} ({seconds:.0f} s)\n\n{text}\n", flush=True)
        if arguments.update:
            write_table(experiment.name, text, made_with(experiment.basis))
    print(f"{total / 60:.0f} minutes in all" if not arguments.list else "")


def _begins(name: str, wanted: list[str] | None) -> bool:
    """Whether `name` begins with some of the words; it does where nothing is wanted in particular."""
    return wanted is None or any(f"{name} ".startswith(f"{each} ") for each in wanted)


if __name__ == "__main__":
    main()
