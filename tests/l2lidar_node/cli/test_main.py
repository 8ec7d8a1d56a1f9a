"""The list of verbs: what it says, what it imports, what it makes of wrong input."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys

import pytest

from l2lidar_node.cli.main import VERBS
from l2lidar_node.command_line import GROUP, registered_verbs
from tests.l2lidar_node.cli.conftest import Run

HEAVY = {"numpy", "scipy", "matplotlib", "open3d", "kiss_icp", "filterpy", "rosbags", "dpkt"}


def imported(*arguments: str) -> set[str]:
    """Return the top-level modules that a command line imports."""
    code = (
        "import sys; from l2lidar_node.cli.main import main\n"
        f"sys.argv = ['l2lidar', *{arguments!r}]; main()\n"
        "print('modules', *sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return {name.partition(".")[0] for name in done.stdout.splitlines()[-1].split()}


@pytest.mark.parametrize("arguments", [("--help",), ("--version",)])
def test_the_list_of_verbs_imports_nothing_heavy(arguments: tuple[str, ...]) -> None:
    assert not HEAVY & imported(*arguments)


def test_a_verb_imports_what_it_needs_only() -> None:
    assert not {"scipy", "matplotlib", "open3d", "kiss_icp", "rosbags"} & imported("get", "--help")


def test_the_version_is_the_package_s(run: Run) -> None:
    assert run("--version").out == f"l2lidar {importlib.metadata.version('l2lidar_node')}\n"


def test_every_verb_is_listed_and_explains_itself(run: Run) -> None:
    listed = run("--help").out
    for verb in [*VERBS, *registered_verbs()]:
        assert f" {verb.name} " in listed
        outcome = run(verb.name, "--help")
        assert (outcome.code, outcome.err) == (0, "")
        assert f"l2lidar {verb.name}" in outcome.out


def test_the_companion_registers_its_verbs() -> None:
    assert {"deskew", "odometry"} <= {verb.name for verb in registered_verbs()}


def test_what_a_broken_package_registers_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = importlib.metadata.EntryPoint("fly", "no_such_package:FLY", GROUP)
    monkeypatch.setattr("l2lidar_node.command_line.entry_points", lambda group: [broken])
    assert registered_verbs() == []
    assert "verb 'fly' (no_such_package:FLY)" in capsys.readouterr().err


def test_an_unknown_verb_is_a_usage_error(run: Run) -> None:
    outcome = run("recrod")
    assert outcome.code == 2
    assert "recrod" in outcome.err


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_verbs_and_options(shell: str) -> None:
    def completed(*words: str) -> str:
        environment = {
            "_L2LIDAR_COMPLETE": f"complete_{shell}",
            "COMP_WORDS": " ".join(("l2lidar", *words)),
            "COMP_CWORD": str(len(words)),
            "_TYPER_COMPLETE_ARGS": " ".join(("l2lidar", *words)),
            "_TYPER_COMPLETE_FISH_ACTION": "get-args",
        }
        code = "import sys; from l2lidar_node.cli.main import main; sys.exit(main())"
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            env=environment,
            check=False,
        )
        return done.stdout

    assert "sync-check" in completed("sy")
    assert "--duration" in completed("record", "--du")
