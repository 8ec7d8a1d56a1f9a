"""Checks what the linters cannot see: files opened in the core, sizes, unexplained exceptions."""

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("l2lidar_node", "l2lidar_proc")
MODULES = sorted(path for name in PACKAGES for path in (ROOT / name).rglob("*.py"))
PYTHON = [
    *MODULES,
    *(path for name in ("launch", "tools") for path in (ROOT / name).rglob("*.py")),
]
LINTER = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
RIM = next(item for item in LINTER["contracts"] if item["name"].startswith("Sockets, threads"))

MAX_LINES = 350
OPENERS = {"open", "read_text", "read_bytes", "write_text", "write_bytes"}
# Reads or writes files although it is not at the rim, each for a reason.
FILE_MODULES = {
    "l2lidar_node.bag": "writes bags",
    "l2lidar_node.emulator.assembly": "reads what the virtual unit was configured to",
    "l2lidar_node.emulator.backlog": "asks the kernel how full the receiver's socket is",
    "l2lidar_node.emulator.results": "writes the truth of a run",
    "l2lidar_node.emulator.tum": "reads trajectories",
    "l2lidar_node.files": "writes files that are complete or as they were before",
    "l2lidar_proc.bag": "reads and writes bags",
}


def dotted(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def is_at_the_rim(module: str) -> bool:
    """Whether the contract on sockets and threads lets this module off."""
    for line in RIM["ignore_imports"]:
        source = line.split(" -> ")[0]
        if module == source or re.fullmatch(re.escape(source).replace(r"\*\*", ".+"), module):
            return True
    return False


def opened_in(path: Path) -> Iterator[int]:
    """Yield the lines that open a file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call):
            called = node.func
            name = called.id if isinstance(called, ast.Name) else getattr(called, "attr", "")
            if name in OPENERS:
                yield node.lineno


def test_only_the_rim_opens_files() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in MODULES
        if not is_at_the_rim(dotted(path)) and dotted(path) not in FILE_MODULES
        for line in opened_in(path)
    ]
    assert "\n".join(found) == ""


@pytest.mark.parametrize("path", MODULES, ids=dotted)
def test_a_module_is_one_noun_small(path: Path) -> None:
    lines = path.read_text().count("\n")
    assert lines <= MAX_LINES


def test_every_exception_to_a_checker_carries_its_reason() -> None:
    """A reason stands after a second ``#``, or after the codes."""
    marker = re.compile(r"#\s*(?:noqa|type:\s*ignore|pragma)(?P<rest>.*)")
    bare = []
    for path in PYTHON:
        for number, line in enumerate(path.read_text().splitlines(), start=1):
            found = marker.search(line)
            if found is None:
                continue
            rest = re.sub(r"^:?\s*(\[[^]]*\]|[A-Z]+\d+(,\s*[A-Z]+\d+)*)?", "", found["rest"])
            if not re.search(r"\w{3}", rest):
                bare.append(f"{path.relative_to(ROOT)}:{number}")
    assert "\n".join(bare) == ""
