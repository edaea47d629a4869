"""Change the code at random places; do the tests notice? python scripts/mutants.py --sample 60 [--minutes 30].

Changes are Cosmic Ray's (pip install -e ".[mutants]"): another operator or comparison, a number one more or less,
a condition the other way round, a loop that is not gone through, an exception that is not caught. A place of the
code is drawn, each as likely, then one of its changes. Left out by rule: words for people, types, decorators,
`strict=`, `==` for `is`, and changes that no float or mask could take. For every change the tests that reach its
line are run, those of its own package and the quickest first, until one fails or `--seconds` are full. Noticed is
what fails, or does not end.

Results are kept in .mutants, and a run that is stopped goes on there. `--again` tries the survivors anew, with the
tests of today, and with more `--seconds` if need be. scripts/equivalent_mutants.txt lists survivors that no test
can notice, with the reason.
"""

import argparse
import hashlib
import json
import os
import time
from collections import Counter
from dataclasses import astuple
from itertools import islice
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before torch is loaded: forks must not share its threads

from mutant_places import Mutant, Source, sample
from mutant_tests import ROOT, Reached, Tree
from scipy.stats import binomtest

PACKAGES = {
    "stage I": ("shapepose_fg/proposal/*.py",),
    "estimation": ("shapepose_fg/estimation/*.py",),
    "tracking": ("shapepose_fg/tracking/*.py",),
    "readers": (
        "shapepose_fg/io/**/*.py",
        "shapepose_fg/core/storage/files.py",
        "shapepose_fg/body/model/smpl_*.py",
        "shapepose_fg/body/model/pickle_records.py",
    ),
}
TESTS = (
    "tests/proposal/test_*.py",
    "tests/tracking/test_*.py",
    "tests/estimation/test_*.py",
    "tests/io/test_*.py",
    "tests/body/test_smpl_*.py",
    "tests/test_*.py",
)
NOT_FOR_THIS = {
    "tests/test_documents.py",
    "tests/test_imports.py",
    "tests/test_licences.py",
    "tests/test_cluster.py",
}
"""Tests of documents and packages, not of what the code does; and such as start a cluster."""
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.txt")


def main() -> None:
    """Draw, try, count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sample", type=int, default=60, help="changes in each package")
    parser.add_argument(
        "--package", choices=[*PACKAGES], action="append", help="of one package; of all by default"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after so long")
    parser.add_argument("--again", action="store_true", help="try the survivors anew")
    parser.add_argument("--seconds", type=float, default=8.0, help="of tests for each change")
    parser.add_argument("--survivors", action="store_true", help="only print them, and the counts")
    parser.add_argument("--state", type=Path, default=ROOT / ".mutants", help="where results are kept")
    given = parser.parse_args()
    names = given.package or list(PACKAGES)
    sources = {name: [Source(ROOT, path) for path in _files(PACKAGES[name])] for name in names}
    drawn = {name: _drawn(sources[name], given.seed, given.sample, given.state) for name in names}
    campaign = Campaign(given.state)
    if not given.survivors:
        # A change of each package in turn: what is stopped has tried some of all.
        turns = [mutant for turn in zip(*_filled(list(drawn.values())), strict=True) for mutant in turn if mutant]
        by_path = {source.path: source for each in sources.values() for source in each}
        until = time.monotonic() + 60 * given.minutes
        campaign.run(turns, by_path, again=given.again, most_s=given.seconds, until=until)
    campaign.show(drawn)


def _files(patterns: tuple[str, ...]) -> list[str]:
    return sorted({str(file.relative_to(ROOT)) for each in patterns for file in ROOT.glob(each)})


def _drawn(sources: list[Source], seed: int, count: int, folder: Path) -> list[Mutant]:
    """The first mutants of a sample; drawing takes its time, so they are kept."""
    code = "".join(f"{seed} {source.path}\n{source.code}" for source in sources)
    kept = folder / "drawn" / f"{hashlib.sha256(code.encode()).hexdigest()[:16]}.json"
    known = [Mutant(*each) for each in json.loads(kept.read_text())] if kept.exists() else []
    if len(known) < count:
        known = list(islice(sample(sources, seed), count))
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps([astuple(each) for each in known]))
    return known[:count]


def _filled(lists: list[list[Mutant]]) -> list[list[Mutant | None]]:
    longest = max(map(len, lists))
    return [[*each, *[None] * (longest - len(each))] for each in lists]


class Campaign:
    """What was tried, and what came of it."""

    def __init__(self, folder: Path) -> None:
        """Go on with what is kept in `folder`."""
        self.folder = folder
        self.results: dict[str, str] = {}
        """By the change's line before and after: survived, noticed, too long, or not reached."""
        if (folder / "results.jsonl").exists():
            for line in (folder / "results.jsonl").read_text().splitlines():
                entry = json.loads(line)
                self.results[entry["id"]] = entry["outcome"]

    def run(
        self, mutants: list[Mutant], sources: dict[str, Source], *, again: bool, most_s: float, until: float
    ) -> None:
        """Try those that have no result yet, with `most_s` seconds of tests; with `again` survivors, too."""
        left = [each for each in mutants if self._open(each, again)]
        if len(left) == 0:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        tree = Tree(self.folder / "tree")
        tests = [file for file in _files(TESTS) if file not in NOT_FOR_THIS]
        reached = Reached(tree, self.folder / "reached", tests)
        everything = {str(file.relative_to(ROOT)): file.read_text() for file in ROOT.glob("shapepose_fg/**/*.py")}
        for n, mutant in enumerate(left):
            if time.monotonic() > until:
                print(f"{len(left) - n} are left for another run")
                return
            began = time.monotonic()
            outcome, count = self._tried(mutant, sources[mutant.path], tree, reached, everything, most_s)
            self.results[mutant.identity] = outcome
            seconds = time.monotonic() - began
            with (self.folder / "results.jsonl").open("a") as stream:
                entry = {"id": mutant.identity, "outcome": outcome, "tests": count, "seconds": round(seconds, 1)}
                stream.write(json.dumps(entry) + "\n")
            print(
                f"{outcome:<11} {count:3d} tests {seconds:5.1f} s  {mutant.path}:{mutant.line} {mutant.operator}",
                flush=True,
            )

    def _open(self, mutant: Mutant, again: bool) -> bool:
        outcome = self.results.get(mutant.identity)
        return outcome is None or (again and outcome in ("survived", "not reached"))

    def _tried(
        self,
        mutant: Mutant,
        source: Source,
        tree: Tree,
        reached: Reached,
        everything: dict[str, str],
        most_s: float,
    ) -> tuple[str, int]:
        """What came of a change, and of how many tests."""
        lines, names, inside = source.statement(mutant.line)
        tests = reached.tests(mutant.path, lines)
        if not inside:  # run when the file is loaded: who uses it?
            tests = set().union(*(reached.users(name, everything) for name in names)) or reached.of_file(
                mutant.path
            )
        chosen, seconds = reached.in_order(tests, mutant.path, most_s)
        changed = mutant.applied(source.code)
        if len(chosen) == 0 or changed is None:
            return "not reached", 0
        code = tree.test_changed(mutant.path, changed, chosen, most_s + 1.5 * seconds, self.folder / "said")
        return ("too long" if code is None else "survived" if code == 0 else "noticed"), len(chosen)

    def show(self, drawn: dict[str, list[Mutant]]) -> None:
        """Survivors, and the share that is noticed."""
        known = _equivalent()
        for name, mutants in drawn.items():
            for mutant in mutants:
                outcome = self.results.get(mutant.identity)
                if outcome in ("survived", "not reached") and mutant.identity not in known:
                    print(f"\n{name}: {mutant.path}:{mutant.line} {outcome}\n- {mutant.before}\n+ {mutant.after}")
        heads = (
            ("tried", 7),
            ("noticed", 9),
            ("share", 8),
            ("95 %", 16),
            ("equivalent", 12),
            ("share of others", 17),
        )
        print(f"\n{'package':<12}" + "".join(f"{head:>{width}}" for head, width in heads))
        total: Counter[str] = Counter()
        for name, mutants in drawn.items():
            counts: Counter[str] = Counter()
            for mutant in mutants:
                outcome = self.results.get(mutant.identity)
                counts["tried"] += outcome is not None
                counts["noticed"] += outcome in ("noticed", "too long")
                counts["equivalent"] += outcome in ("survived", "not reached") and mutant.identity in known
            _print(name, counts)
            total += counts
        _print("all", total)


def _print(name: str, counts: Counter[str]) -> None:
    tried, noticed, equivalent = (counts[each] for each in ("tried", "noticed", "equivalent"))
    if tried == 0:
        return
    between = binomtest(noticed, tried).proportion_ci(method="wilson")
    interval = f"{100 * between.low:.0f} to {100 * between.high:.0f} %"
    print(
        f"{name:<12}{tried:>7}{noticed:>9}{100 * noticed / tried:>6.1f} %{interval:>16}{equivalent:>12}"
        f"{100 * noticed / max(tried - equivalent, 1):>15.1f} %"
    )


def _equivalent() -> dict[str, str]:
    """Changes that no test can notice, with the reason: four columns with | between them."""
    if not EQUIVALENT.exists():
        return {}
    lines = [line for line in EQUIVALENT.read_text().splitlines() if line and not line.startswith("#")]
    return {identity.strip(): reason.strip() for identity, reason in (line.rsplit(" | ", 1) for line in lines)}


if __name__ == "__main__":
    main()
