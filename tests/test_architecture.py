"""Checks what the linters cannot see: files opened in the pure core, unexplained exceptions."""

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PYTHON = [
    path
    for name in ("l2lidar_node", "l2lidar_proc", "launch", "benchmarks", "scripts")
    for path in sorted((ROOT / name).rglob("*.py"))
]
LINTER = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
PURE = next(item for item in LINTER["contracts"] if item["name"].startswith("The pure core"))
OPENERS = {"open", "read_text", "read_bytes", "write_text", "write_bytes"}
# Modules of the pure core whose subject is a file format.
FILE_FORMATS = {
    "l2lidar_node/emulator/truth.py",
    "l2lidar_proc/recording/bag.py",
    "l2lidar_proc/slam/atlas.py",
}


def sources(module: str) -> list[Path]:
    """Return the files of a module or package."""
    place = ROOT / module.replace(".", "/")
    # after a pull the folder of what is one module now may still hold bytecode
    return sorted(place.rglob("*.py")) or [place.with_suffix(".py")]


def opened_in(path: Path) -> Iterator[int]:
    """Yield the lines that open a file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call):
            called = node.func
            name = called.id if isinstance(called, ast.Name) else getattr(called, "attr", "")
            if name in OPENERS:
                yield node.lineno


@pytest.mark.parametrize("module", PURE["source_modules"])
def test_the_pure_core_opens_no_files(module: str) -> None:
    paths = sources(module)
    assert paths
    found = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in paths
        if str(path.relative_to(ROOT)) not in FILE_FORMATS
        for line in opened_in(path)
    ]
    assert "\n".join(found) == ""


def test_only_tests_of_benchmarks_import_benchmarks() -> None:
    for path in sorted((ROOT / "tests").rglob("*.py")):
        if "benchmarks" not in path.relative_to(ROOT).parts:
            found = re.findall(r"^(?:from|import) benchmarks.*", path.read_text(), re.MULTILINE)
            assert not found, f"{path}: {found[0]}; what tests need stands in tests/support"


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
