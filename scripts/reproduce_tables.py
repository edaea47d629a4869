"""Measure the tables of README.md and docs/ again: python scripts/reproduce_tables.py [--update].

    python scripts/reproduce_tables.py --quick  # does everything work? two minutes
    python scripts/reproduce_tables.py --list                         # names of the tables
    python scripts/reproduce_tables.py --only time shelf --update
    python scripts/reproduce_tables.py --split tune --only time --cases salsa
    python scripts/reproduce_tables.py --only "who is there" --list --cases     # names of its cases
    python scripts/reproduce_tables.py --only "who is there" --cases "crowd 3 cameras 10 Hz"

Scenes come from fixed seeds. Recordings and recorded motions are read from `--data FOLDER` (or
SHAPEPOSE_DATA); tables that need them are skipped if they are missing. Results are stored in the
folder `--results`, one file per case and commit of the code, so that an interrupted run is resumed;
with uncommitted changes, use `--afresh`. `--update` writes tables between their marks `<!-- NAME
@COMMIT -->` and `<!-- end -->`; a table without marks names its commit.
"""

import argparse
import os
import re
import subprocess
from pathlib import Path

from shapepose_fg.evaluation.experiments.experiment import measured
from shapepose_fg.evaluation.experiments.registry import experiments
from shapepose_fg.evaluation.experiments.scenes import RECORDINGS, Scale

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def main() -> None:
    """Measure the requested tables, and print or write them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    given = os.environ.get("SHAPEPOSE_DATA")
    parser.add_argument("--data", type=Path, default=None if given is None else Path(given))
    parser.add_argument("--only", nargs="*", help="names of tables, or their first words")
    parser.add_argument(
        "--cases",
        nargs="*",
        help="only cases that have all words of one of these; with --list: names",
    )
    parser.add_argument(
        "--seeds", nargs="*", type=int, help="of the sequences that `who is there` draws"
    )
    parser.add_argument(
        "--split", choices=("tune", "report"), default="report", help="of the recorded motions"
    )
    parser.add_argument("--quick", action="store_true", help="a few frames of each but Shelf's own")
    parser.add_argument("--list", action="store_true", help="measure nothing, say what there is")
    parser.add_argument("--afresh", action="store_true", help="measure again what is kept")
    parser.add_argument(
        "--results", type=Path, default=ROOT / "build" / "figures", help="where figures are kept"
    )
    parser.add_argument("--update", action="store_true", help="write the tables into the documents")
    arguments = parser.parse_args()
    if arguments.update and (
        arguments.quick or arguments.cases or arguments.seeds or arguments.split != "report"
    ):
        parser.error(
            "--update: of all cases at full scale, split report; leave out the other options"
        )
    data = recordings(ROOT.parent / "shared" if arguments.data is None else arguments.data)
    if data is None and arguments.data is not None:
        wanted = " or ".join(RECORDINGS)
        parser.error(
            f"--data: neither {arguments.data} nor {arguments.data / 'data'} has a folder {wanted}"
        )
    scale = Scale(
        arguments.quick, data, arguments.split, *[tuple(arguments.seeds)] if arguments.seeds else []
    )
    commit = code_commit()
    results = arguments.results / commit / ("quick" if arguments.quick else arguments.split)
    total, found = 0.0, 0
    for experiment in experiments(scale):
        if arguments.only is not None and not any(
            begins(experiment.name, each) for each in arguments.only
        ):
            continue
        part = experiment.only(
            lambda name: not arguments.cases or any(has_words(name, w) for w in arguments.cases)
        )
        found += len(part.cases)
        if arguments.list:
            print(f"{experiment.name:<24}{len(part.cases):>3} cases")
            if arguments.cases is not None:
                print("\n".join(f"    {case.name}" for case in part.cases))
            continue
        if len(part.cases) == 0:
            continue
        figures, seconds = measured(part, results, afresh=arguments.afresh)
        total += seconds
        text = "\n".join(part.table(figures))
        print(f"{experiment.name} ({seconds:.0f} s)\n\n{text}\n", flush=True)
        if arguments.update and not write_table(experiment.name, text, commit):
            print(
                f"no page has marks <!-- {experiment.name} --> and <!-- end -->: add them to one "
                "in docs/\n"
            )
    if found == 0:
        absent = [name for name in RECORDINGS if scale.recording(name) is None]
        why = (
            f", and {data or 'this machine'} has no {', '.join(absent)} (see --data)"
            if len(absent) > 0
            else ""
        )
        parser.error(f"there is no such case; --list --cases names those of every table{why}")
    if not arguments.list:
        print(f"{total / 60:.0f} minutes in all")


def recordings(folder: Path) -> Path | None:
    """The given folder, or its subfolder data, if it has one of the recordings; None if neither
    has.
    """
    those = (
        each
        for each in (folder / "data", folder)
        if any((each / name).is_dir() for name in RECORDINGS)
    )
    return next(those, None)


def code_commit() -> str:
    """The last commit that changed the measured code; with the suffix "-changed" if there are
    uncommitted changes.
    """
    code = ("--", "shapepose_fg", "factors")
    commands = (("log", "-1", "--format=%h", *code), ("status", "--porcelain", *code))
    try:
        runs = [
            subprocess.run(("git", "-C", ROOT, *each), capture_output=True, text=True)
            for each in commands
        ]
    except FileNotFoundError:  # git is not installed
        return "unknown"
    commit, changed = (each.stdout.strip() for each in runs)
    return (commit or "unknown") + ("-changed" if changed else "")


def begins(name: str, words: str) -> bool:
    """Whether `name` begins with the given words."""
    return f"{name} ".startswith(f"{words} ")


def has_words(name: str, words: str) -> bool:
    """Whether the name of a case contains all given words: "crowd 3 cameras" matches "crowd 6301 3
    cameras 10 Hz".
    """
    there, wanted = (re.split(r"[\s,:]+", each.casefold()) for each in (name, words))
    return set(wanted) <= set(there)


def write_table(name: str, text: str, commit: str) -> bool:
    """Write `text` between the marks of `name` on each page that has them; returns whether a page
    has them.
    """
    marked = re.compile(rf"<!-- {re.escape(name)}( @[\w-]+)? -->\n.*?(<!-- end -->)", re.DOTALL)
    pages = {
        page: page.read_text(encoding="utf-8")
        for page in (ROOT / "README.md", *sorted(DOCS.glob("*.md")))
    }
    pages = {page: old for page, old in pages.items() if marked.search(old) is not None}
    for page, old in pages.items():
        new = marked.sub(lambda found: f"<!-- {name} @{commit} -->\n\n{text}\n\n{found[2]}", old)
        page.write_text(new, encoding="utf-8")
    return len(pages) > 0


if __name__ == "__main__":
    main()
