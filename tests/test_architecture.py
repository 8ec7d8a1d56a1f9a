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
RIM = "Sockets, threads and the wall clock are met at the rim only"

MAX_LINES = 350
OPENERS = {"open", "read_text", "read_bytes", "write_text", "write_bytes"}
# Reads or writes files although it is not at the rim, each for a reason.
FILE_MODULES = {
    "l2lidar_node.emulator.assembly": "reads what the virtual unit was configured to",
    "l2lidar_node.emulator.backlog": "asks the kernel how full the receiver's socket is",
    "l2lidar_node.emulator.results": "writes the truth of a run",
    "l2lidar_node.emulator.truth": "writes the true trajectory",
    "l2lidar_node.emulator.tum": "reads trajectories",
}


def dotted(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def contract(name: str) -> dict[str, list[str]]:
    return next(item for item in LINTER["contracts"] if item["name"] == name)


def is_at_the_rim(module: str) -> bool:
    """Whether the contract on sockets and threads lets this module off."""
    for line in contract(RIM)["ignore_imports"]:
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


@pytest.mark.parametrize("package", PACKAGES)
def test_each_contract_names_every_module_it_keeps_out(package: str) -> None:
    """A module added to the driver is closed to emulator and companion until someone decides."""
    driver = {
        dotted(path)
        for path in (ROOT / "l2lidar_node").iterdir()
        if (path.suffix == ".py" and path.stem != "__init__") or (path / "__init__.py").exists()
    }
    name, open_to = {
        "l2lidar_node": (
            "The virtual L2 shares the wire format with the driver and nothing else",
            {"l2lidar_node.emulator", "l2lidar_node.wire", "l2lidar_node.settings"},
        ),
        "l2lidar_proc": (
            "The companion sees the driver's vocabulary only",
            {"l2lidar_node.ros", "l2lidar_node.settings"},
        ),
    }[package]
    closed = set(contract(name)["forbidden_modules"])
    assert driver - closed - open_to - {"l2lidar_node.types"} == set()


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
