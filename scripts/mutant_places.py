"""Which changes of the code mutants.py may make: Cosmic Ray's, less those that change nothing to be tested."""

import ast
import importlib
import random
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

try:
    _tree, _mutating, _provider = (
        importlib.import_module(f"cosmic_ray.{name}") for name in ("ast", "mutating", "operators.provider")
    )
except ImportError:
    sys.exit('error: mutation testing needs Cosmic Ray and coverage; pip install -e ".[mutants]"')
OPERATORS: Any = _provider.OperatorProvider()
_WORDS_ONLY = {"InputError", "ValueError", "RuntimeError", "note", "print"}
"""What is called with words for people."""
_ARITHMETIC = "(Add|Sub|Mul|Div|FloorDiv|Mod|Pow)"
_BITS = "(RShift|LShift|BitOr|BitAnd|BitXor)"
_NOT_USED = re.compile(
    # == for `is`: of the small numbers and enums that are compared here, the same.
    "ReplaceComparisonOperator_(Eq_Is|Is_Eq|NotEq_IsNot|IsNot_NotEq)"
    # Floats have no bits, and masks no sign: these would be noticed wherever they are reached.
    f"|ReplaceBinaryOperator_{_ARITHMETIC}_{_BITS}|ReplaceBinaryOperator_{_BITS}_{_ARITHMETIC}"
    "|ReplaceUnaryOperator_(USub_Invert|USub_Not|Invert_UAdd|Invert_USub|Invert_Not)"
    "|RemoveDecorator|VariableReplacer|VariableInserter"
)


@dataclass(frozen=True)
class Mutant:
    """One change in one file."""

    path: str
    """The file, relative to the repository."""
    operator: str
    """Cosmic Ray's name of the change."""
    occurrence: int
    """Which place of the file, of those where it can be made."""
    line: int
    """Its line, from 1."""
    inside: str = ""
    """The function or class before it."""
    before: str = ""
    """What it changes."""
    after: str = ""
    """What that becomes."""

    @property
    def identity(self) -> str:
        """Names it, also when lines above it have changed."""
        return f"{self.path} {self.inside} | {self.before} | {self.after}"

    def applied(self, code: str) -> str | None:
        """The file's text with the change; None where that is no Python, or nothing changes."""
        operator = OPERATORS[self.operator]()
        try:
            changed = _mutating.mutate_code(code, operator, self.occurrence)
            if changed is None or ast.dump(ast.parse(changed)) == ast.dump(ast.parse(code)):
                return None
            compile(changed, self.path, "exec")
        except SyntaxError:
            return None
        return changed


def _told(mutant: Mutant, code: str, changed: str) -> Mutant:
    """The same, with the lines as they are and as they become."""
    lines, others = code.splitlines(), changed.splitlines()
    first = next(n for n, (one, other) in enumerate(zip(lines, others, strict=False)) if one != other)
    last = next(n for n, (one, other) in enumerate(zip(lines[::-1], others[::-1], strict=False)) if one != other)
    before, after = lines[first : len(lines) - last], others[first : len(others) - last]
    names = [found[1] for line in lines[: first + 1] if (found := re.match(r"\s*(?:def|class) (\w+)", line))]
    return replace(
        mutant,
        inside=names[-1] if names else "",
        before=" ".join(map(str.strip, before)),
        after=" ".join(map(str.strip, after)),
    )


class Source:
    """A file that may be changed."""

    def __init__(self, root: Path, path: str) -> None:
        self.path = path
        self.code = (root / path).read_text()

    def places(self) -> Iterator[list[Mutant]]:
        """Of every place of the code the changes that can be made there; cosmetic ones are left out."""
        tree = _tree.get_ast(self.code)
        found: dict[tuple[int, int, str], list[Mutant]] = {}
        nodes = list(_tree.ast_nodes(tree))
        for name in OPERATORS:
            if _NOT_USED.fullmatch(name):
                continue
            of_types = name.startswith("ReplaceBinaryOperator_BitOr")
            operator = OPERATORS[name]()
            starts = (start for node in nodes for start, _ in operator.mutation_positions(node))
            for occurrence, (line, column) in enumerate(starts):
                if not self._cosmetic(line, column) and not (of_types and not self.statement(line)[2]):
                    kind = re.sub(r"_.*", "", name)
                    mutant = Mutant(self.path, name, occurrence, line)
                    found.setdefault((line, column, kind), []).append(mutant)
        yield from (found[place] for place in sorted(found))

    def statement(self, line: int) -> tuple[range, list[str], bool]:
        """The innermost statement at a line: its lines (or its head's), what it names, whether in a function.

        It names what it gives a value, as a constant or a setting does.
        """
        best, inside = None, False
        for node in ast.walk(self._tree):
            if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or node.lineno):
                inside = inside or (
                    isinstance(node, ast.FunctionDef) and line >= node.body[0].lineno and node.lineno < line
                )
                if best is None or node.lineno >= best.lineno:
                    best = node
        if best is None:
            return range(line, line + 1), [], inside
        end = best.end_lineno or best.lineno
        if isinstance(best, ast.FunctionDef):  # a default: who calls it?
            return range(best.body[0].lineno, end + 1), [], True
        body = getattr(best, "body", None)
        if body:
            end = max(best.lineno, min(end, body[0].lineno - 1))
        targets = getattr(best, "targets", [getattr(best, "target", None)])
        names = [each.id for each in targets if isinstance(each, ast.Name)]
        return range(min(best.lineno, line), max(end, line) + 1), names, inside

    @cached_property
    def _tree(self) -> ast.Module:
        return ast.parse(self.code)

    def _cosmetic(self, line: int, column: int) -> bool:
        return any(start <= (line, column) < end for start, end in self._left_alone)

    @cached_property
    def _left_alone(self) -> list[tuple[tuple[int, int], tuple[int, int]]]:
        """From where to where nothing is changed: words for people, types, decorators, `strict=`, f-strings."""
        nodes: list[ast.AST] = []
        for node in ast.walk(self._tree):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in _WORDS_ONLY:
                nodes += [*node.args, *node.keywords]
            elif isinstance(node, ast.Call):
                nodes += [each for each in node.keywords if each.arg == "strict"]
                nodes += node.args[1:] if getattr(node.func, "id", "") == "isinstance" else []
            elif isinstance(node, ast.JoinedStr) or (isinstance(node, ast.BinOp) and _is_text(node)):
                nodes.append(node)
            elif isinstance(node, ast.AnnAssign | ast.arg) and node.annotation is not None:
                nodes.append(node.annotation)
            elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
                nodes.append(node)
            if isinstance(node, ast.FunctionDef):
                nodes += [*node.decorator_list, *([node.returns] if node.returns is not None else [])]
            if isinstance(node, ast.ClassDef):
                nodes += [*node.decorator_list, *node.bases]
        lines = self.code.splitlines()

        def place(line: int, offset: int) -> tuple[int, int]:
            return line, len(lines[line - 1].encode()[:offset].decode())

        spans = [(node.lineno, node.col_offset, node.end_lineno, node.end_col_offset) for node in nodes]  # type: ignore[attr-defined]
        return [(place(a, b), place(c, d)) for a, b, c, d in spans]


def _is_text(value: ast.expr) -> bool:
    """Whether an expression is a text, or joined of texts."""
    if isinstance(value, ast.BinOp):
        return isinstance(value.op, ast.Add) and (_is_text(value.left) or _is_text(value.right))
    return isinstance(value, ast.JoinedStr) or (isinstance(value, ast.Constant) and isinstance(value.value, str))


def sample(sources: list[Source], seed: int) -> Iterator[Mutant]:
    """Mutants in random order: first a place, each as likely, then one of its changes that is Python."""
    rng = random.Random(seed)
    places = [(source, changes) for source in sources for changes in source.places()]
    rng.shuffle(places)
    for source, changes in places:
        rng.shuffle(changes)
        for mutant in changes:
            changed = mutant.applied(source.code)
            if changed is not None:
                yield _told(mutant, source.code, changed)
                break
