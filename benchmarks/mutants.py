"""Changes the code in small ways and looks whether a test fails.

``make mutants`` mutates the pure core (protocol, clock, clouds, driver, deskew, motion, and the
odometry's matcher) and writes what it finds to ``docs/results/mutants.md`` (``--write``). It
samples: ``--mutants N``, spread over the modules by their size, the same ones for the same seed.
No file of the code is changed; a mutant exists in one process only.

First every test runs once, to see which functions it calls and how long it takes. A mutant then
meets only the tests that call the function it is in, the module's own and the quickest first, and
the first that fails ends it. A test that hangs, or takes memory without end, counts as failed.
Every mutant is kept in ``out/bench/mutants.jsonl`` as soon as it is judged: ``--resume`` goes on.
"""

from __future__ import annotations

import argparse
import ast
import copy
import hashlib
import multiprocessing
import os
import random
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.mutants_explained import REASONS
from benchmarks.results import FOLDER, KeptRows

ROOT: Final = Path(__file__).resolve().parents[1]
PAGE: Final = ROOT / "docs" / "results" / "mutants.md"
FOLDERS: Final = (
    "l2lidar_node/protocol", "l2lidar_node/clock", "l2lidar_node/clouds", "l2lidar_node/driver",
    "l2lidar_proc/deskew", "l2lidar_proc/motion",
)  # fmt: skip
FILES: Final = ("l2lidar_proc/odometry/alignment.py", "l2lidar_proc/odometry/matcher.py")
TESTS: Final = (
    *(f"tests/{folder}" for folder in FOLDERS),
    *(f"tests/l2lidar_proc/odometry/test_{name}.py" for name in ("alignment", "odometry_parts")),
    "tests/l2lidar_proc/test_hostile_input.py",
)  # fmt: skip
_KEY: Final = ("module", "number", "digest")
_TARGET: Final = 0.9
_SLOWEST_S: Final = 30.0  # a test that takes longer is left to the gate
_TESTS_S: Final = 60.0  # of tests for one mutant

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
        The line, what stands there, and what instead.
    """

    path: Path
    number: int
    line: int
    change: str

    @property
    def module(self) -> str:
        """Name to import."""
        return module_of(self.path)


def module_of(path: Path) -> str:
    """Return the name by which a file below the repository is imported."""
    return ".".join(path.with_suffix("").parts)


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
    source = (ROOT / path).read_text()
    lines = source.splitlines()
    found = []
    for number, (before, after) in enumerate(mutations(ast.parse(source))):
        line = getattr(before, "lineno", 1)
        change = f"{_text(before)} -> {_text(after)}"
        found.append(Mutant(path, number, line, f"{lines[line - 1].strip()}: {change}"))
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


@dataclass(frozen=True, slots=True)
class Called:
    """What one test calls.

    Attributes
    ----------
    seconds : float
        How long it takes.
    functions : dict
        By path below the repository: first lines of the functions that it calls.
    """

    seconds: float
    functions: dict[str, list[int]]


class _KeptCalls(KeptRows):
    """What each test calls; several thousand lines that nobody wants to see."""

    def describe(self, row: dict[str, Any]) -> str:
        """Return the test alone."""
        return str(row["test"])


def tests_for(mutant: Mutant, calls: dict[str, Called]) -> list[str]:
    """Return the tests that can notice a mutant, the likeliest first, as many as time allows."""
    path = str(mutant.path)
    first = _function_of(mutant)
    own = f"test_{mutant.path.stem}"
    found = [
        (own not in test.partition("::")[0], called.seconds, test)
        for test, called in calls.items()
        if path in called.functions and (first is None or first in called.functions[path])
    ]
    chosen, total = [], 0.0
    for _, seconds, test in sorted(found):
        total += seconds
        if total > _TESTS_S:
            break
        chosen.append(test)
    return chosen


def _function_of(mutant: Mutant) -> int | None:
    """Return the first line of the function that a mutant is in, None outside of any."""
    tree = ast.parse((ROOT / mutant.path).read_text())
    around = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and node.body[0].lineno <= mutant.line <= (node.end_lineno or 0)
    ]
    if not around:
        return None
    inner = max(around, key=lambda node: node.lineno)
    return min([inner.lineno, *(item.lineno for item in inner.decorator_list)])


def sampled(paths: Sequence[Path], count: int, seed: int) -> list[Mutant]:
    """Return so many mutants of modules, from each according to its size, at least one."""
    found = {path: mutants_of(path) for path in paths}
    total = sum(map(len, found.values()))
    chosen: list[Mutant] = []
    for path, mutants in found.items():
        share = max(round(count * len(mutants) / total), 1) if count else len(mutants)
        rng = random.Random(f"{seed} {path}")
        some = rng.sample(mutants, len(mutants))[:share]  # a larger sample has these too
        chosen += sorted(some, key=lambda mutant: mutant.number)
    return chosen


def report(rows: list[dict[str, Any]], options: str) -> str:
    """Return the page: per module how many were killed, and what lived, with reasons."""
    lived = [row for row in rows if not row["killed"]]
    explained = [row for row in lived if (row["path"], row["change"]) in REASONS]
    killed = len(rows) - len(lived)
    lines = [
        "# Mutants",
        "",
        f'Written by `make mutants BENCH_ARGS="{options} --write"`: {killed} of {len(rows)} '
        f"killed ({100.0 * killed / max(len(rows), 1):.0f} %); of the {len(lived)} that lived, "
        f"{len(explained)} are explained.",
        "",
        "A mutant is one small change of the code: a comparison, an operator, a constant, a "
        "condition. It is killed when a test fails. The sample is spread over the modules by "
        "their size. What lived before an assertion was added is counted as killed.",
        "",
        "| Module | Killed | Tried |",
        "|---|---|---|",
    ]
    for path in dict.fromkeys(row["path"] for row in rows):
        mine = [row for row in rows if row["path"] == path]
        lines.append(f"| `{path}` | {sum(row['killed'] for row in mine)} | {len(mine)} |")
    lines += ["", "## Lived", ""]
    lines += [
        f"* `{row['path']}`: `{row['change']}`: "
        + REASONS.get((row["path"], row["change"]), "not explained")
        for row in lived
    ] or ["None."]
    return "\n".join([*lines, ""])


def main(arguments: Sequence[str] | None = None) -> int:
    """Try the mutants; return 1 if fewer than nine of ten were killed."""
    from benchmarks.mutant_run import find_calls  # imports what the tests import

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=160, help="how many; 0: all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--modules", nargs="+", default=[], help="only these, such as reorder")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="mutants at a time")
    parser.add_argument("--minutes", type=float, default=1e6, help="begin no mutant after that")
    parser.add_argument("--resume", action="store_true", help="keep what is judged already")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.relative_to(ROOT)}")
    given = parser.parse_args(arguments)
    until = time.monotonic() + 60.0 * given.minutes
    kept = KeptRows(FOLDER / "mutants.jsonl", _KEY)
    kept_calls = _KeptCalls(FOLDER / "mutants-calls.jsonl", ("test",))
    if not given.resume:
        kept.clear()
        kept_calls.clear()
    with multiprocessing.get_context("fork").Pool(given.jobs, maxtasksperchild=1) as pool:
        pool.starmap(find_calls, [(tests, kept_calls) for tests in TESTS], chunksize=1)
    calls = {
        row["test"]: Called(row["seconds"], row["functions"])
        for row in kept_calls.read()
        if row["seconds"] < _SLOWEST_S
    }
    judged = {kept.key_of(row) for row in kept.read()}
    wanted, todo = [], []
    for mutant in sampled(_modules(given.modules), given.mutants, given.seed):
        tests = tests_for(mutant, calls)
        row = {
            "module": mutant.module, "number": mutant.number, "digest": _digest(mutant, tests),
            "path": str(mutant.path), "line": mutant.line, "change": mutant.change,
            "tests": len(tests),
        }  # fmt: skip
        wanted.append(kept.key_of(row))
        if wanted[-1] not in judged:
            expected = sum(calls[test].seconds for test in tests)
            todo.append((row, mutant, tests, expected, kept, until))
    with multiprocessing.get_context("fork").Pool(given.jobs) as pool:
        left = pool.starmap(_judge, todo, chunksize=1).count(False)
    if left:
        print(f"{left} mutants were left out; go on with --resume", file=sys.stderr)
        return 1
    found = {kept.key_of(row): row for row in kept.read()}
    rows = [found[key] for key in wanted]
    options = f"--mutants {given.mutants} --seed {given.seed}"
    if given.modules:
        options += f" --modules {' '.join(given.modules)}"
    page = report(rows, options)
    print(page)
    if given.write:
        PAGE.parent.mkdir(parents=True, exist_ok=True)
        PAGE.write_text(page)
    return int(sum(row["killed"] for row in rows) < _TARGET * len(rows))


def _judge(
    row: dict[str, Any],
    mutant: Mutant,
    tests: list[str],
    expected_s: float,
    kept: KeptRows,
    until: float,
) -> bool:
    """Try a mutant and keep what was found; return False if it is too late to begin."""
    from benchmarks.mutant_run import is_killed

    if time.monotonic() > until:
        return False
    kept.append({**row, "killed": bool(tests) and is_killed(mutant, tests, expected_s)})
    return True


def _digest(mutant: Mutant, tests: Sequence[str]) -> str:
    """Return what a verdict holds for: the module and the tests as they are."""
    paths = [str(mutant.path), *sorted({test.partition("::")[0] for test in tests})]
    content = b"".join((ROOT / path).read_bytes() for path in paths)
    return hashlib.sha256(content + mutant.change.encode()).hexdigest()[:16]


def _modules(names: Sequence[str]) -> list[Path]:
    paths = [
        file.relative_to(ROOT)
        for folder in FOLDERS
        for file in sorted((ROOT / folder).glob("*.py"))
    ]
    paths += [Path(name) for name in FILES]
    return [path for path in paths if mutants_of(path) and (not names or path.stem in names)]


if __name__ == "__main__":
    os.chdir(ROOT)
    sys.exit(main())
