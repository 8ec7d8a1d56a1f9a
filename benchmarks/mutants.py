"""Changes the code in small ways and looks whether a test fails.

``make mutants`` mutates the pure core (protocol, clock, clouds, driver, deskew, motion, and the
odometry's mathematics) and writes what it finds to ``docs/results/mutants.md`` (``--write``). It
samples: ``--mutants N``, spread over the modules by their size, the same ones for the same seed.
The faults of :mod:`benchmarks.mutants_known` are tried in every run. No file of the code is
changed; a mutant exists in one process only.

First every test runs once, to see which functions it calls and how long it takes. A mutant then
meets only the tests that call the function it is in, the module's own and the quickest first, and
the first that fails ends it. A test that hangs, or takes memory without end, counts as failed.
Every mutant is kept in ``out/bench/mutants.jsonl`` as soon as it is judged: ``--resume`` goes on,
and judges those anew whose module has changed, and those that lived and have other tests now.
"""

from __future__ import annotations

import argparse
import ast
import copy
import hashlib
import os
import random
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from benchmarks.mutants_known import FAULTS, REASONS
from benchmarks.results import FOLDER, KeptRows

ROOT: Final = Path(__file__).resolve().parents[1]
PAGE: Final = ROOT / "docs" / "results" / "mutants.md"
FOLDERS: Final = (
    "l2lidar_node/protocol", "l2lidar_node/clock", "l2lidar_node/driver",
    "l2lidar_proc/deskew", "l2lidar_proc/motion",
)  # fmt: skip
_ODOMETRY: Final = (
    "estimate", "matcher", "prediction", "registration/alignment", "registration/correspondences",
    "zero_velocity",
)  # fmt: skip
FILES: Final = (
    "l2lidar_node/clouds.py", "l2lidar_node/frames.py", "l2lidar_node/rotations.py",
    *(f"l2lidar_proc/odometry/{name}.py" for name in _ODOMETRY)
)  # fmt: skip
TESTS: Final = (
    *(f"tests/{folder}" for folder in FOLDERS),
    "tests/l2lidar_node/clouds",
    "tests/l2lidar_node/recording",
    *(f"tests/l2lidar_proc/odometry/test_{name}.py" for name in (
        "estimate", "kiss", "matcher", "prediction", "zero_velocity",
    )),
    "tests/l2lidar_proc/odometry/local_map",
    "tests/l2lidar_proc/odometry/registration/test_alignment.py",
    "tests/benchmarks/test_deskew.py",
    "tests/l2lidar_proc/test_hostile_input.py",
    "tests/l2lidar_node/test_frames.py",
    "tests/l2lidar_node/test_rotations.py",
    "tests/test_reference.py",
)  # fmt: skip
SLOWEST_S: Final = 30.0
"""A test that takes longer [CPU s] is left to the gate."""

_KEY: Final = ("path", "number", "code")
_TARGET: Final = 0.9
_TESTS_S: Final = (10.0, 30.0)  # of tests for a mutant, and for one that lives through those
_SMALL: Final = 16  # integers up to this are counts and indices
_FACTOR: Final = 2  # of other constants
_TUNED_FACTOR: Final = 10  # of those of a module, which are tuned: half of one may do as well

_BOUNDARIES: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt,
}  # fmt: skip
_OPPOSITES: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq,
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
        Among the module's mutants; below 0 for the faults of :mod:`benchmarks.mutants_known`.
    function : str
        Qualified name of the function that it is in, empty if it is in none. A function inside
        of another belongs to that one.
    change : str
        The line, what stands there, and what instead.
    """

    path: Path
    number: int
    function: str
    change: str

    @property
    def module(self) -> str:
        """Name to import."""
        return ".".join(self.path.with_suffix("").parts)


def mutations(tree: ast.Module) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Yield every node that can be changed with what takes its place.

    Annotations, docstrings and the texts of errors are left as they are.
    """
    for node, function in _code(tree, ""):
        for changed in _changes(node, function):
            yield node, changed


def _changes(node: ast.AST, function: str) -> Iterator[ast.AST]:
    """Yield what can take the place of a node of a function."""
    if isinstance(node, ast.Compare):
        sides = [node.left, *node.comparators]
        for at, operator in enumerate(node.ops):
            kind = type(operator)
            # no data hit the boundary between two real numbers
            is_count = kind in _BOUNDARIES and any(map(_is_count, sides[at : at + 2]))
            changed = copy.deepcopy(node)
            changed.ops[at] = _BOUNDARIES[kind]() if is_count else _OPPOSITES[kind]()
            yield changed
    elif isinstance(node, ast.BinOp) and type(node.op) in _CALCULATED:
        if not _is_text(node.left) and (function or not isinstance(node.op, ast.BitOr)):  # types
            yield ast.BinOp(node.left, _CALCULATED[type(node.op)](), node.right)
    elif isinstance(node, ast.AugAssign) and type(node.op) in _CALCULATED:
        yield ast.AugAssign(node.target, _CALCULATED[type(node.op)](), node.value)
    elif isinstance(node, ast.BoolOp):
        other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        yield ast.BoolOp(other, node.values)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        yield node.operand
    elif isinstance(node, ast.If | ast.While | ast.IfExp):
        negated = copy.copy(node)
        negated.test = ast.UnaryOp(ast.Not(), node.test)
        yield negated
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        is_more = _is_count(node) or not node.value
        factor = _FACTOR if function else _TUNED_FACTOR
        yield ast.Constant(node.value + 1 if is_more else factor * node.value)
    elif isinstance(node, ast.Break | ast.Continue):
        yield ast.Pass()


def _is_count(node: ast.AST) -> bool:
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Name) and node.func.id == "len"
    is_integer = isinstance(node, ast.Constant) and type(node.value) is int
    return is_integer and getattr(node, "value", 0) <= _SMALL


def _is_text(node: ast.AST) -> bool:
    is_string = isinstance(node, ast.Constant) and isinstance(node.value, str | bytes)
    return is_string or isinstance(node, ast.JoinedStr)


def _code(node: ast.AST, scope: str) -> Iterator[tuple[ast.AST, str]]:
    """Yield the nodes of code in the order of the source, each with the function it is in."""
    is_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params", "bases"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, ast.Raise | ast.Assert):
                continue
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                continue
            # a class is "Name.", a function "Name"; default values belong to what is around it
            inside = scope
            if scope == "" or scope.endswith("."):
                if isinstance(child, ast.ClassDef):
                    inside = f"{scope}{child.name}."
                elif is_function and name == "body":
                    inside = f"{scope}{getattr(node, 'name', '')}"
            yield child, "" if inside.endswith(".") else inside
            yield from _code(child, inside)


@cache
def mutants_of(path: Path) -> list[Mutant]:
    """Return all mutants of a module, path below the repository."""
    source = (ROOT / path).read_text()
    lines = source.splitlines()
    found: list[Mutant] = []
    for node, function in _code(ast.parse(source), ""):
        for after in _changes(node, function):
            line = lines[getattr(node, "lineno", 1) - 1].strip()
            change = f"{line}: {_text(node)} -> {_text(after)}"
            found.append(Mutant(path, len(found), function, change))
    return found


def _text(node: ast.AST) -> str:
    if isinstance(node, ast.If | ast.While):
        return f"if {_text(node.test)}"
    text = " ".join(ast.unparse(ast.fix_missing_locations(copy.deepcopy(node))).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def mutated(path: Path, number: int) -> ast.Module:
    """Return the syntax tree of a module with one mutation."""
    source = (ROOT / path).read_text()
    if number < 0:
        fault = FAULTS[-1 - number]
        return ast.parse(source.replace(fault.before, fault.after))
    tree = ast.parse(source)
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
        How long it takes [CPU s].
    functions : dict
        By path below the repository: the functions that it calls, as :attr:`Mutant.function`.
    """

    seconds: float
    functions: dict[str, list[str]]


class _KeptCalls(KeptRows):
    """What each test calls; several thousand lines that nobody wants to see."""

    def describe(self, row: dict[str, Any]) -> str:
        """Return the test and how long it took."""
        return f"{row['seconds']:.1f} s {row['test']}"


def tests_for(mutant: Mutant, calls: dict[str, Called], most_s: float) -> list[str]:
    """Return the tests that can notice a mutant, the likeliest first, as many as time allows."""
    if mutant.number < 0:
        return list(FAULTS[-1 - mutant.number].tests)
    path, function = str(mutant.path), mutant.function
    own = f"test_{mutant.path.stem}"
    found = []
    for test, called in calls.items():
        file = test.partition("::")[0]
        # a default is written down in the shipped files, which call no function of its module
        is_own = own in file or (own == "test_config" and file == "tests/test_reference.py")
        if function:
            can_notice = function in called.functions.get(path, ())
        else:  # a constant need not be looked at through a function of its module
            can_notice = is_own or path in called.functions
        if can_notice:
            found.append((not is_own, called.seconds, test))
    chosen: list[str] = []
    total = 0.0
    for _, seconds, test in sorted(found):
        total += seconds
        if chosen and total > most_s:
            break
        chosen.append(test)
    return chosen


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


def known() -> list[Mutant]:
    """Return the faults that are tried in every run."""
    return [
        Mutant(Path(fault.path), -1 - at, "", f"{_line(fault.before)} -> {_line(fault.after)}")
        for at, fault in enumerate(FAULTS)
    ]


def _line(text: str) -> str:
    return " ".join(text.split()) or "nothing"


def report(rows: list[dict[str, Any]], options: str) -> str:
    """Return the page: per module how many were killed, and what lived, with reasons."""
    faults = [row for row in rows if row["number"] < 0]
    rows = [row for row in rows if row["number"] >= 0]
    lived = [row for row in rows if not row["killed"]]
    explained = [row for row in lived if (row["path"], row["change"]) in REASONS]
    killed = len(rows) - len(lived)
    lines = [
        "# Mutants",
        "",
        f'Written by `make mutants BENCH_ARGS="{options} --write"`: {killed} of {len(rows)} '
        f"killed ({100.0 * killed / max(len(rows), 1):.1f} %); of the {len(lived)} that lived, "
        f"{len(explained)} are explained.",
        "",
        "A mutant is one small change of the code: an operator, a condition, a comparison "
        "(inverted, or off by one for counts), a constant (counts up to 16 plus one, others "
        "doubled, those of a module times ten). It is killed if a test fails or does not end. The "
        "sample is spread over the modules by their size. Each mutant runs the tests that call "
        f"its function, at most {_TESTS_S[-1]:.0f} s of them. Mutants killed by assertions that "
        "were added for them count as killed.",
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
    lines += [
        "",
        "## Faults that once went unnoticed",
        "",
        "Tried in every run.",
        "",
        *(
            f"* `{row['path']}`: `{row['change']}`: {'killed' if row['killed'] else '**lived**'}"
            for row in faults
        ),
    ]
    return "\n".join([*lines, ""])


def main(arguments: Sequence[str] | None = None) -> int:
    """Try the mutants; return 1 if fewer than nine of ten were killed, or a known fault lived."""
    from benchmarks.mutant_run import find_calls, judge  # imports what the tests import

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=100, help="how many; 0: all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--modules", nargs="+", default=[], help="only these, such as reorder")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="mutants at a time")
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
    names = find_calls(TESTS, kept_calls, given.jobs)
    calls = {
        row["test"]: Called(row["seconds"], row["functions"])
        for row in kept_calls.read()
        if row["test"] in names and row["seconds"] < SLOWEST_S
    }
    chosen = sampled(_modules(given.modules), given.mutants, given.seed)
    if not given.modules:
        chosen = [*known(), *chosen]
    for stage, most_s in enumerate(_TESTS_S):
        judged = {kept.key_of(row): row for row in kept.read()}
        todo = []
        for mutant in chosen:
            tests = tests_for(mutant, calls, most_s)
            row = _row(mutant, tests)
            before = judged.get(kept.key_of(row))
            if before is None or not (before["killed"] or _is_settled(before, calls, stage)):
                expected = (calls[test].seconds if test in calls else SLOWEST_S for test in tests)
                todo.append((row, mutant, tests, sum(expected)))
        todo.sort(key=lambda item: kept.key_of(item[0]) in judged)  # new ones first
        judge(todo, kept, given.jobs, until)
    found = {kept.key_of(row): row for row in kept.read()}
    wanted = [kept.key_of(_row(mutant, [])) for mutant in chosen]
    if left := len(set(wanted) - set(found)):
        print(f"{left} mutants were left out; go on with --resume", file=sys.stderr)
        return 1
    rows = [found[key] for key in wanted]
    options = f"--mutants {given.mutants} --seed {given.seed}"
    if given.modules:
        options += f" --modules {' '.join(given.modules)}"
    page = report(rows, options)
    print(page)
    if given.write:
        PAGE.parent.mkdir(parents=True, exist_ok=True)
        PAGE.write_text(page)
    tried = [row["killed"] for row in rows if row["number"] >= 0]
    faults = [row["killed"] for row in rows if row["number"] < 0]
    return int(sum(tried) < _TARGET * len(tried) or not all(faults))


def _is_settled(row: dict[str, Any], calls: dict[str, Called], stage: int) -> bool:
    """Return whether a mutant has lived through all tests that a stage has for it."""
    mutant = Mutant(Path(row["path"]), row["number"], row["function"], row["change"])
    return any(
        row["by"] == _row(mutant, tests_for(mutant, calls, most_s))["by"]
        for most_s in _TESTS_S[stage:]
    )


def _row(mutant: Mutant, tests: Sequence[str]) -> dict[str, Any]:
    """Return what is kept of a mutant, without the verdict: also what that holds for."""
    return {
        "path": str(mutant.path),
        "number": mutant.number,
        "code": _digest([str(mutant.path)], mutant.change),
        "by": _digest({test.partition("::")[0] for test in tests}, *tests),
        "function": mutant.function,
        "change": mutant.change,
        "tests": len(tests),
    }


def _digest(paths: Iterable[str], *texts: str) -> str:
    """Return what tells files as they are now, and texts, from all others."""
    content = b"".join(_content(path) for path in sorted(paths))
    return hashlib.sha256(content + "\n".join(texts).encode()).hexdigest()[:16]


@cache
def _content(path: str) -> bytes:
    return (ROOT / path).read_bytes()


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
