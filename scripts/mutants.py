"""Change the code at random places and see whether the tests notice: python scripts/mutants.py FOLDER --sample 60.

Places are drawn, each as likely, and changed one at a time: comparisons, arithmetic, logic, numbers, conditions,
calls left out; words for people, types and decorators are not. Of the tests that reach the changed statement (by
coverage, measured once, as long as the whole suite) those of its package come first, until one fails. Results are
kept in FOLDER; a run that is started again goes on. What two sets of tests are worth is compared on one draw:

    python scripts/mutants.py /tmp/mutants --sample 200
    python scripts/mutants.py /tmp/mutants --sample 200 --only "not slow"      # an expression of pytest's -m

Needs coverage (pip install -e ".[mutants]").
"""

import argparse
import ast
import copy
import importlib
import json
import os
import random
import shutil
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

ROOT = Path(__file__).parents[1]
WORDS = {"InputError", "ValueError", "RuntimeError", "AssertionError", "print", "isinstance", "TypeVar"}
"""What is called with words for people, or with types."""
OTHER: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.Gt), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.Lt), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,), ast.NotIn: (ast.In,), ast.And: (ast.Or,), ast.Or: (ast.And,),
    ast.Add: (ast.Sub,), ast.Sub: (ast.Add,), ast.Mult: (ast.Div,), ast.Div: (ast.Mult,), ast.Pow: (ast.Mult,),
    ast.FloorDiv: (ast.Div,), ast.Mod: (ast.FloorDiv,), ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,),
}  # fmt: skip
"""Operators that take each other's place."""


@dataclass(frozen=True)
class Mutant:
    """One change of one file."""

    path: str
    """The file, relative to the repository."""
    line: int
    """Line of the statement, from 1."""
    name: str
    """Where it is, what is changed, and what that becomes."""
    code: str
    """The whole file with the change."""


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """What may stand in the place of a node."""
    match node:
        case ast.Compare(ops=[operator]):
            for other in OTHER[type(operator)]:
                yield ast.Compare(node.left, [other()], node.comparators)
        case ast.BoolOp():
            yield ast.BoolOp(OTHER[type(node.op)][0](), node.values)
            yield from node.values
        case ast.BinOp() if type(node.op) in OTHER:
            yield ast.BinOp(node.left, OTHER[type(node.op)][0](), node.right)
        case ast.AugAssign() if type(node.op) in OTHER:
            yield ast.AugAssign(node.target, OTHER[type(node.op)][0](), node.value)
        case ast.UnaryOp():
            yield node.operand
        case ast.Constant(value=bool()):
            yield ast.Constant(not node.value)
        case ast.Constant(value=int() | float() as number):
            yield from (ast.Constant(value) for value in {number + 1, 0} - {number})
        case ast.IfExp():
            yield from (node.body, node.orelse)
        case ast.If() if "TYPE_CHECKING" not in ast.dump(node.test):
            yield from (ast.If(ast.Constant(value), node.body, node.orelse) for value in (True, False))
        case ast.Expr(value=ast.Call()):
            yield ast.Pass()
        case ast.Break():
            yield ast.Continue()
        case ast.Continue():
            yield ast.Break()


def slots(node: ast.AST, line: int = 1) -> Iterator[tuple[int, Any, Any]]:
    """Where below `node` something may be changed: the statement's line, and `[container][key]`."""
    called = getattr(node, "func", None)
    if isinstance(node, ast.JoinedStr) or getattr(called, "id", getattr(called, "attr", "")) in WORDS:
        return
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "bases"):
            continue
        container: Any = value if isinstance(value, list) else vars(node)
        for key in range(len(value)) if isinstance(value, list) else [field]:
            each = container[key]
            if isinstance(each, ast.AST) and not (isinstance(each, ast.keyword) and each.arg == "strict"):
                line = each.lineno if isinstance(each, ast.stmt) else line
                yield line, container, key
                yield from slots(each, line)


def drawn(paths: list[str], seed: int) -> Iterator[Mutant]:
    """Mutants in random order, one a place; a seed gives the same ones as long as the files are the same."""
    rng = random.Random(seed)
    trees = {path: ast.parse((ROOT / path).read_text(encoding="utf-8")) for path in paths}
    found = [(path, *slot) for path, tree in trees.items() for slot in slots(tree)]
    rng.shuffle(found)
    for path, line, container, key in found:
        node = container[key]
        options = list(changes(node))
        if options:
            other = copy.copy(rng.choice(options))
            container[key] = ast.fix_missing_locations(ast.copy_location(other, node))
            code = ast.unparse(trees[path])
            container[key] = node
            before, after = (ast.unparse(each).split("\n")[0] for each in (node, other))
            yield Mutant(path, line, f"{path}:{line} {before} -> {after}", code)


def listed(*words: str) -> list[str]:
    """Files of the repository."""
    command = ["git", "ls-files", "-z", *words]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    return [name for name in names if (ROOT / name).is_file()]


class Recorder:
    """Pytest's plugin that writes down which lines each test reaches, and how long it takes."""

    def __init__(self, file: Path) -> None:
        """Results go into `file`."""
        coverage: Any = importlib.import_module("coverage")
        self.file, self.seconds = file, defaultdict[str, float](float)
        self.coverage = coverage.Coverage(data_file=None, source=["shapepose_fg", "factors"], config_file=False)
        self.coverage.start()  # before tests are imported: what that reaches is no test's

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """A test begins, with its fixtures."""
        self.coverage.switch_context(nodeid)

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Its time."""
        self.seconds[report.nodeid] += report.duration

    def pytest_sessionfinish(self) -> None:
        """Write it down: of each file and line the tests."""
        self.coverage.stop()
        data, lines = self.coverage.get_data(), {}
        for file in data.measured_files():
            contexts = data.contexts_by_lineno(file)
            lines[os.path.relpath(file)] = {line: sorted(filter(None, names)) for line, names in contexts.items()}
        self.file.write_text(json.dumps({"seconds": self.seconds, "lines": lines}))


class Copy:
    """A copy of the repository, in which one file at a time is changed."""

    def __init__(self, folder: Path, only: str) -> None:
        """Copy it, and find out which tests reach which lines; `only` chooses tests by their marks."""
        self.tree = folder / "tree"
        shutil.rmtree(self.tree, ignore_errors=True)
        for name in listed("--cached", "--others", "--exclude-standard"):
            (self.tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, self.tree / name)
        reached = folder / f"reached {only}.json"
        if not reached.exists():
            self._python([__file__, str(reached), "--only", only, "--record"], None)
        self.reached = json.loads(reached.read_text())

    def _python(self, words: list[str], most_s: float | None) -> int | None:
        """The exit code of Python in the copy; None where it takes longer."""
        paths = os.pathsep.join([str(self.tree), os.environ.get("PYTHONPATH", "")])
        env = os.environ | {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
        command, said = [sys.executable, *words], None if most_s is None else subprocess.DEVNULL
        try:
            return subprocess.run(
                command, cwd=self.tree, env=env, stdout=said, timeout=most_s, check=False
            ).returncode
        except subprocess.TimeoutExpired:
            return None

    def outcome(self, mutant: Mutant, most_s: float) -> str:
        """What tests of `most_s` seconds in all, and at least one, say of a change."""
        lines = self.reached["lines"].get(mutant.path, {})
        tests = lines.get(str(mutant.line)) or sorted({name for names in lines.values() for name in names})
        own = f"tests/{mutant.path.removeprefix('shapepose_fg/').split('/')[0]}/"
        seconds = self.reached["seconds"]
        chosen, total = [], 0.0
        for test in sorted(tests, key=lambda name: (not name.startswith(own), seconds[name])):
            total += seconds[test]
            if chosen and total > most_s:
                break
            chosen.append(test)
        if len(chosen) == 0:
            return "not reached"
        file = self.tree / mutant.path
        before = file.read_bytes()
        file.write_text(mutant.code, encoding="utf-8")
        try:
            code = self._python(["-m", "pytest", "-x", "-q", "-p", "no:xdist", *chosen], 60 + 5 * most_s)
        finally:
            file.write_bytes(before)
        return "survived" if code == 0 else "noticed"


def main() -> None:
    """Try mutants, and say what survives."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where results are kept, and the copy of the repository")
    parser.add_argument("--paths", nargs="+", default=["shapepose_fg", "factors"], help="folders to change")
    parser.add_argument("--sample", type=int, default=60, help="how many changes")
    parser.add_argument("--seed", type=int, default=1, help="of the draw")
    parser.add_argument("--seconds", type=float, default=20.0, help="of tests, for each change")
    parser.add_argument("--only", default="", help="tests with these marks, as pytest's -m says it")
    parser.add_argument("--record", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.record:
        words = ["-q", "-p", "no:xdist", "-m", given.only]
        importlib.import_module("pytest").main(words, plugins=[Recorder(given.folder)])
        return
    folder, here, counts = given.folder.resolve(), None, Counter[str]()
    folder.mkdir(parents=True, exist_ok=True)
    results = folder / f"results {given.only}.jsonl"
    known = dict(json.loads(line) for line in results.read_text().splitlines()) if results.exists() else {}
    files = listed("--", *(f"{path}/**.py" for path in given.paths))
    for _, mutant in zip(range(given.sample), drawn(files, given.seed), strict=False):
        if mutant.name not in known:
            here, began = here or Copy(folder, given.only), time.monotonic()
            known[mutant.name] = here.outcome(mutant, given.seconds)
            with results.open("a") as stream:
                stream.write(json.dumps([mutant.name, known[mutant.name]]) + "\n")
            print(f"{known[mutant.name]:<11} {time.monotonic() - began:4.0f} s  {mutant.name}", flush=True)
        counts[known[mutant.name]] += 1
    total = counts.total()
    between = binomtest(counts["noticed"], total).proportion_ci(method="wilson")
    print(f"{dict(counts)}: noticed {counts['noticed'] / total:.1%} ({between.low:.0%} to {between.high:.0%})")


if __name__ == "__main__":
    main()
