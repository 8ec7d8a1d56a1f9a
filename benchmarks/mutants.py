"""Changes the code in small ways and looks whether a test fails.

``make mutants`` mutates the pure core of the driver (clock, clouds, driver, protocol) and writes
what lived to ``docs/results/mutants.md``. It samples: ``--sample N`` mutants of each module, the
same ones for the same seed. No file of the code is changed; a mutant exists in one process only.
Timeouts count as killed: a test that hangs is seen.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
PAGE: Final = ROOT / "docs" / "results" / "mutants.md"
FOLDERS: Final = ("clock", "clouds", "driver", "protocol")
_TIMEOUT_S: Final = 600.0
_PASSED, _FAILED = 0, 1  # exit codes of pytest

_COMPARED: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_CALCULATED: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.FloorDiv, ast.FloorDiv: ast.Mult,
    ast.Div: ast.Mult, ast.Mod: ast.FloorDiv, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Mutant:
    """One small change of a module.

    Attributes
    ----------
    path : Path
        Of the module, below the repository.
    number : int
        Among the module's mutants.
    line : int
    change : str
        What stands there, and what instead.
    """

    path: Path
    number: int
    line: int
    change: str

    @property
    def module(self) -> str:
        """Name to import."""
        return ".".join(self.path.with_suffix("").parts)


def mutations(tree: ast.Module) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Yield every node that can be changed with what takes its place.

    Annotations, docstrings and the texts of errors are left as they are.
    """
    for node in _code(tree):
        if isinstance(node, ast.Compare):
            for at, operator in enumerate(node.ops):
                if type(operator) in _COMPARED:
                    changed = copy.deepcopy(node)
                    changed.ops[at] = _COMPARED[type(operator)]()
                    yield node, changed
        elif isinstance(node, ast.BinOp) and type(node.op) in _CALCULATED:
            if not _is_text(node.left):
                yield node, ast.BinOp(node.left, _CALCULATED[type(node.op)](), node.right)
        elif isinstance(node, ast.AugAssign) and type(node.op) in _CALCULATED:
            yield node, ast.AugAssign(node.target, _CALCULATED[type(node.op)](), node.value)
        elif isinstance(node, ast.BoolOp):
            other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield node, ast.BoolOp(other, node.values)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
            yield node, node.operand
        elif isinstance(node, ast.If | ast.While | ast.IfExp):
            negated = copy.copy(node)
            negated.test = ast.UnaryOp(ast.Not(), node.test)
            yield node, negated
        elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
            yield node, ast.Constant(not node.value)
        elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            by = 1 if isinstance(node.value, int) else 0.1 * node.value or 1.0
            yield node, ast.Constant(node.value + by)
        elif isinstance(node, ast.Break | ast.Continue):
            yield node, ast.Pass()


def _is_text(node: ast.AST) -> bool:
    is_string = isinstance(node, ast.Constant) and isinstance(node.value, str | bytes)
    return is_string or isinstance(node, ast.JoinedStr)


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes of code, in the order of the source."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params", "bases"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, ast.Raise | ast.Assert):
                continue
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                continue
            yield child
            yield from _code(child)


def mutants_of(path: Path) -> list[Mutant]:
    """Return all mutants of a module, path below the repository."""
    tree = ast.parse((ROOT / path).read_text())
    found = []
    for number, (before, after) in enumerate(mutations(tree)):
        line = getattr(before, "lineno", 0)
        found.append(Mutant(path, number, line, f"{_text(before)} -> {_text(after)}"))
    return found


def _text(node: ast.AST) -> str:
    if isinstance(node, ast.If | ast.While):
        return f"if {_text(node.test)}"
    text = " ".join(ast.unparse(ast.fix_missing_locations(copy.deepcopy(node))).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def mutated(path: Path, number: int) -> ast.Module:
    """Return the syntax tree of a module with one mutation."""
    tree = ast.parse((ROOT / path).read_text())
    before, after = list(mutations(tree))[number]
    ast.copy_location(after, before)

    class Replace(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST:
            return after if node is before else self.generic_visit(node)

    Replace().visit(tree)
    return ast.fix_missing_locations(tree)


def tests_of(path: Path) -> list[list[str]]:
    """Return the tests of a module, those of its own first, then its whole folder's."""
    folder = ROOT / "tests" / path.parent
    own = [str(file.relative_to(ROOT)) for file in sorted(folder.glob(f"test_{path.stem}*.py"))]
    rounds = [own] if own else []
    rounds.append([str(folder.relative_to(ROOT))])
    return rounds


def is_killed(mutant: Mutant) -> bool:
    """Return whether a test fails with a mutant.

    Raises
    ------
    RuntimeError
        If pytest ends in another way than with passed or failed tests.
    """
    for tests in tests_of(mutant.path):
        command = [sys.executable, "-m", "benchmarks.mutant_run", mutant.module,
                   str(mutant.path), str(mutant.number), *tests]  # fmt: skip
        try:
            done = subprocess.run(
                command, cwd=ROOT, capture_output=True, text=True, timeout=_TIMEOUT_S,
                check=False, env={**os.environ, "CI": "1"},
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return True
        if done.returncode != _PASSED:
            return True  # also where the module cannot even be imported
    return False


def check_tests_pass(path: Path) -> None:
    """Raise RuntimeError if the tests of a module fail without any mutant."""
    for tests in tests_of(path):
        command = [sys.executable, "-m", "benchmarks.mutant_run", "-", str(path), "0", *tests]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode != _PASSED:
            raise RuntimeError(f"{' '.join(tests)} fail without a mutant:\n{done.stdout[-2000:]}")


def report(rows: list[tuple[str, int, int]], lived: list[Mutant], options: str) -> str:
    """Return the page: per module how many were killed, and what lived."""
    killed, tried = sum(row[1] for row in rows), sum(row[2] for row in rows)
    lines = [
        "# Mutants",
        "",
        f"`make mutants` with `{options}`: {killed} of {tried} killed "
        f"({100.0 * killed / max(tried, 1):.0f} %).",
        "A mutant is one small change of the code: a comparison, an operator, a constant, a "
        "condition. It is killed when a test fails.",
        "",
        "| Module | Killed | Tried |",
        "|---|---|---|",
        *(f"| `{name}` | {count} | {total} |" for name, count, total in rows),
        "",
        "## Lived",
        "",
    ]
    lines += [f"* `{mutant.path}:{mutant.line}`: `{mutant.change}`" for mutant in lived] or [
        "None."
    ]
    return "\n".join([*lines, ""])


def main(arguments: Sequence[str] | None = None) -> int:
    """Try the mutants; return 1 if fewer than nine of ten were killed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sample", type=int, default=5, help="mutants of each module; 0: all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folders", nargs="+", choices=FOLDERS, default=list(FOLDERS))
    parser.add_argument("--modules", nargs="+", default=[], help="only these, such as reorder")
    parser.add_argument("--minutes", type=float, default=60.0, help="begin no mutant after that")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.relative_to(ROOT)}")
    options = parser.parse_args(arguments)
    deadline = time.monotonic() + options.minutes * 60.0
    rows: list[tuple[str, int, int]] = []
    lived: list[Mutant] = []
    for path in _modules(options.folders, options.modules):
        if time.monotonic() > deadline:
            break
        chosen = mutants_of(path)
        rng = random.Random(f"{options.seed} {path}")
        if options.sample and len(chosen) > options.sample:
            chosen = sorted(rng.sample(chosen, options.sample), key=lambda item: item.number)
        if not chosen:
            continue
        check_tests_pass(path)
        killed = tried = 0
        for mutant in chosen:
            if time.monotonic() > deadline:
                break
            tried += 1
            if is_killed(mutant):
                killed += 1
            else:
                lived.append(mutant)
                print(f"lived: {path}:{mutant.line}: {mutant.change}", flush=True)
        rows.append((str(path), killed, tried))
        print(f"{path}: {killed} of {tried} killed", flush=True)
    words = f"--sample {options.sample} --seed {options.seed}"
    if options.modules:
        words += f" --modules {' '.join(options.modules)}"
    page = report(rows, lived, words)
    print(page)
    if options.write:
        PAGE.parent.mkdir(parents=True, exist_ok=True)
        PAGE.write_text(page)
    total = sum(row[2] for row in rows)
    return int(len(lived) > 0.1 * total)


def _modules(folders: Sequence[str], names: Sequence[str]) -> list[Path]:
    paths = [
        file.relative_to(ROOT)
        for folder in folders
        for file in sorted((ROOT / "l2lidar_node" / folder).glob("*.py"))
    ]
    return [path for path in paths if not names or path.stem in names]


if __name__ == "__main__":
    sys.exit(main())
