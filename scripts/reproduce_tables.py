"""The tables of README.md and docs/ that are measured anew: python scripts/reproduce_tables.py [--update].

    python scripts/reproduce_tables.py --quick                        # does everything work? two minutes
    python scripts/reproduce_tables.py --list                         # names, and how long each took the last time
    python scripts/reproduce_tables.py --only time shelf --update
    python scripts/reproduce_tables.py --split tune --only time --cases salsa   # choose on tune, report on report
    python scripts/reproduce_tables.py --only "who is there" --list --cases     # names of its cases
    python scripts/reproduce_tables.py --only "who is there" --seeds 6301 --cases "crowd 3 cameras 10 Hz"

Scenes come from fixed seeds. Recordings and recorded motions are taken from `--data FOLDER` (or SHAPEPOSE_DATA);
what needs them is left out without. Figures are kept in the folder `--results`: a run that was stopped goes on;
what is kept counts as long as default settings and shipped data are the same; after a change of code, `--afresh`.
`--update` writes tables between their marks `<!-- NAME @MADE WITH -->` and `<!-- end -->`. A table without marks
names the commit that has the code that measured it.
"""

import argparse
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path

import torch

from shapepose_fg.evaluation.experiments.made_with import fingerprint, made_with
from shapepose_fg.evaluation.experiments.registry import experiments
from shapepose_fg.evaluation.experiments.runner import Kept, measured
from shapepose_fg.evaluation.experiments.stretches import Scale

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def main() -> None:
    """Measure what was asked for, and print or write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    parser.add_argument("--data", type=Path, default=data)
    parser.add_argument("--only", nargs="*", help="names of tables, or their first words")
    parser.add_argument(
        "--cases", nargs="*", help="only cases that have all words of one of these; with --list: names"
    )
    parser.add_argument("--seeds", nargs="*", type=int, help="of the sequences that `who is there` draws")
    parser.add_argument("--split", choices=("tune", "report"), default="report", help="of the recorded motions")
    parser.add_argument(
        "--quick", action="store_true", help="a few frames of each but Shelf's own and the fitters"
    )
    parser.add_argument("--list", action="store_true", help="measure nothing, say what there is")
    parser.add_argument("--afresh", action="store_true", help="measure again what is kept")
    parser.add_argument("--kept", action="store_true", help="measure nothing: tables whose figures are all kept")
    parser.add_argument("--results", type=Path, default=ROOT / "build" / "figures", help="where figures are kept")
    parser.add_argument("--update", action="store_true", help="write the tables into the documents")
    arguments = parser.parse_args()
    if arguments.update and (arguments.quick or arguments.cases or arguments.seeds or arguments.split != "report"):
        parser.error("--update: of all cases at full scale, split report; leave out the other options")
    torch.set_num_threads(1)
    scale = Scale(arguments.quick, arguments.data if arguments.data.is_dir() else None, arguments.split)
    if arguments.seeds:
        scale = Scale(scale.quick, scale.data, scale.split, tuple(arguments.seeds))
    kept = Kept(arguments.results, "quick" if arguments.quick else arguments.split, arguments.afresh)
    total, found = 0.0, 0
    for experiment in experiments(scale):
        if arguments.only is not None and not any(begins(experiment.name, each) for each in arguments.only):
            continue
        part = experiment.only(
            lambda name: not arguments.cases or any(has_words(name, w) for w in arguments.cases)
        )
        found += len(part.cases)
        if arguments.list:
            print(f"{experiment.name:<24}{len(part.cases):>3} cases{kept.words(part)}")
            if arguments.cases is not None:
                print("\n".join(f"    {case.name}" for case in part.cases))
            continue
        if len(part.cases) == 0 or (arguments.kept and not kept.whole(part)):
            continue
        figures, seconds = measured(part, kept)
        total += seconds
        text = "\n".join(part.table(figures))
        print(f"{experiment.name} ({seconds:.0f} s)\n\n{text}\n", flush=True)
        if arguments.update and not write_table(experiment.name, text, made_with(experiment.basis)):
            print(f"no page has marks <!-- {experiment.name} --> and <!-- end -->: add them to one in docs/\n")
    if found == 0:
        parser.error("there is no such case; --list --cases names those of every table")
    if not arguments.list:
        print(f"{total / 60:.0f} minutes in all")


def begins(name: str, words: str) -> bool:
    """Whether `name` begins with these words."""
    return f"{name} ".startswith(f"{words} ")


def has_words(name: str, words: str) -> bool:
    """Whether a case has all of these words in its name: "crowd 3 cameras" finds "crowd 6301 3 cameras 10 Hz"."""
    there, wanted = (re.split(r"[\s,:]+", each.casefold()) for each in (name, words))
    return set(wanted) <= set(there)


def write_table(name: str, text: str, made_with: Mapping[str, str]) -> bool:
    """Put `text` between the marks of `name` on each page that has them; returns whether one has.

    The mark names the file in docs/made_with that says what it was made with.
    """
    marked = re.compile(rf"<!-- {re.escape(name)}( @\w+)? -->\n.*?(<!-- end -->)", re.DOTALL)
    pages = {page: page.read_text(encoding="utf-8") for page in (ROOT / "README.md", *sorted(DOCS.glob("*.md")))}
    pages = {page: old for page, old in pages.items() if marked.search(old) is not None}
    digits = fingerprint(made_with)
    for page, old in pages.items():
        (DOCS / "made_with" / f"{digits}.json").write_text(
            json.dumps(made_with, indent=1) + "\n", encoding="utf-8"
        )
        new = marked.sub(lambda found: f"<!-- {name} @{digits} -->\n\n{text}\n\n{found[2]}", old)
        page.write_text(new, encoding="utf-8")
    return len(pages) > 0


if __name__ == "__main__":
    main()
