"""Every command in README and docs is run by a test, or listed here with the reason why not."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import click
import pytest
from typer.main import get_command

from l2lidar_node.cli.main import app
from l2lidar_node.config import DriverConfig
from l2lidar_node.settings import settings_of

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]

ROS = "needs the ros2 command line, which no registry has"
SENSOR = "needs a sensor or its network"
ADMIN = "changes the machine"

RUN_BY = {
    r"git clone .*": "CI, which starts in a fresh clone",
    r"make (test|setup|check|format|pytest|test-noble|docs)\b.*": "CI itself",
    r"\.venv/bin/python -m pytest .*": "CI itself",
    r"PYTHON=.* make setup": "tests/test_setup.py",
    r"(python3 -m venv|\.venv/bin/(pip|python -m colcon)) .*": "tests/test_packaging.py",
    r"make demo\b.*": "tests/l2lidar_node/demo/test_demo.py",
    r"l2lidar (discover|info|set \w+).*": "tests/l2lidar_node/cli/test_unit_verbs.py",
    r"l2lidar calibrate (still|imu|scale) .*": "tests/l2lidar_node/cli/test_calibrate.py",
    r"l2lidar (record|convert|replay|odometry) .*": "tests/l2lidar_node/cli/test_data_verbs.py",
    r"(kiss_icp_pipeline|evo_ape|evo_traj) .*": "tests/l2lidar_node/recording/test_bag_readers.py",
    r"l2lidar (slam|export) .*": "tests/l2lidar_proc/verbs/test_slam.py",
    r"l2lidar deskew .*": "tests/l2lidar_proc/verbs/test_deskew.py",
    r"l2lidar check .*\.pcap .*": "tests/l2lidar_node/cli/test_data_verbs.py",
    r"l2lidar check .*\.mcap .*": "tests/l2lidar_node/check/test_recordings.py",
    r"l2lidar check /.*": "tests/l2lidar_node/ros/test_topic_source.py",
    r"l2lidar view.*": "tests/l2lidar_node/ros/test_viewer.py",
    r"ros2 launch l2lidar_node .*": "tests/test_launch_files.py",
}
"""Commands that a test runs, itself or the file behind them, by the test."""

NOT_RUN = {
    r"ros2 (topic|service|param|run|bag|security|lifecycle) .*": ROS,
    r"source .*": ROS,
    r"export ROS_SECURITY_.*": ROS,
    r"ZENOH_CONFIG_OVERRIDE=.* ros2 run .*": ROS,
    r"rosdep .*": ROS,
    r"colcon build --packages-select lio_sam .*": "builds another package, with ROS",
    r"mkdir -p ~/ros2_ws/src.*": ADMIN,
    r"cp \$\(ros2 pkg prefix --share l2lidar_node\)/config/\w+\.yaml .*": ROS,
    r"cd .*": ADMIN,
    r"export .*": ROS,
    r"sudo .*": ADMIN,
    r"nmcli .*": ADMIN,
    r"(journalctl|pidstat) .*": ADMIN,
    r"docker .*": "needs docker; CI builds and runs the image",
    r"ping .*": SENSOR,
    r"(rko_lio|genz_lio_pipeline) .*": "heavy, one of them GPL: run by hand, and by the bench",
}
"""Commands that no test runs, with the reason."""


def commands() -> list[tuple[str, str]]:
    """Return every command of a shell block with the page it stands on."""
    found = []
    for page in PAGES:
        shell = re.compile(r"^ *```(?:bash|console)\n(.*?)^ *```", re.M | re.S)  # also in lists
        for block in shell.findall(page.read_text()):
            joined = re.sub(r"\\\n\s*", " ", block)
            for line in joined.splitlines():
                command = line.partition("  #")[0].removeprefix("$ ").strip()
                if command and not command.startswith("#"):
                    found.append((page.name, command))
    return found


@pytest.mark.parametrize(("page", "command"), commands())
def test_a_command_is_run_or_excused(page: Any, command: Any) -> None:
    known = [*RUN_BY, *NOT_RUN]
    assert any(re.fullmatch(pattern, command) for pattern in known), f"{page}: {command}"


ALL_PAGES = [*PAGES, *sorted((ROOT / "docs/results").glob("*.md"))]


def typed(program: str) -> list[tuple[str, str]]:
    """Return what stands in blocks and lines of a page that begins so, with the page."""
    found = {(page, line) for page, line in commands() if line.startswith(program)}
    for page in ALL_PAGES:
        prose = re.sub(r"^ *```.*?^ *```", "", page.read_text(), flags=re.M | re.S)
        lines = (" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose))
        found |= {(page.name, line) for line in lines if line.startswith(program)}
    return sorted(found)


@pytest.mark.parametrize(("page", "line"), typed("l2lidar "))
def test_verbs_and_options_exist(page: str, line: str) -> None:
    assert_is_understood(shlex.split(line, comments=True)[1:])


def assert_is_understood(words: list[str]) -> None:
    """Parse a command line of l2lidar as far as it goes: no verb, option or argument too many."""
    command: Any = get_command(app())
    context = click.Context(command)
    while words and hasattr(command, "resolve_command") and not words[0].startswith("-"):
        if words[0] == "VERB":
            return
        _, command, words = command.resolve_command(context, words)
        context = click.Context(command, parent=context)
    options = {text: item for item in command.get_params(context) for text in item.opts}
    places = sum(20 if item.nargs < 0 else 1 for item in command.params if item.opts[0][0] != "-")
    while words:
        option, _, value = words.pop(0).partition("=")
        if not option.startswith("-"):
            places -= 1
        elif option == "--":
            break
        elif not getattr(options[option], "is_flag", False) and not value:
            words = words[1:]
    assert places >= 0


@pytest.mark.parametrize(("page", "line"), typed("make "))
def test_targets_and_their_options_exist(page: str, line: str) -> None:
    target, *rest = shlex.split(line)[1:]
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M)
    bench = ROOT / f"benchmarks/{target.replace('-', '_')}.py"
    assert target in targets or bench.exists() or target == "bench-X"
    options = [word for item in rest for word in item.partition("=")[2].split()]
    if target == "demo":
        assert_is_understood(["demo", *options])
        return
    code = "".join(path.read_text() for path in (ROOT / "benchmarks").glob("*.py"))
    for option in (word for word in options if word.startswith("--")):
        assert f'"{option}"' in code


@pytest.mark.parametrize("where", [text for text in RUN_BY.values() if text.startswith("tests/")])
def test_the_tests_named_exist(where: Any) -> None:
    assert (ROOT / where).exists()


def anchors(page: Path) -> set[str]:
    """Return the names by which links reach the headings of a page."""
    found = set()
    for heading in re.findall(r"^#+ (.*)$", page.read_text(), re.M):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        found.add(re.sub(r"[^\w\- ]", "", plain).strip().replace(" ", "-"))
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Any) -> None:
    for target, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", page.read_text()):
        if "://" not in target:
            path = page.parent / target if target else page
            assert path.exists(), target
            if anchor and path.suffix == ".md":
                assert anchor in anchors(path), f"{target}#{anchor}"


def test_the_site_shows_every_page() -> None:
    """mkdocs builds what is in its list, the start page and the generated ones besides."""
    listed = set(re.findall(r"^ +- .*?([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M))
    assert {page.name for page in (ROOT / "docs").glob("*.md")} <= listed


def test_the_first_screen_names_parameters_that_exist() -> None:
    readme = (ROOT / "README.md").read_text()
    table = readme.partition("## The dozen parameters")[2].partition("\n## ")[0]
    names = re.findall(
        r"`(\w+)`", "".join(row.split("|")[1] for row in table.splitlines() if "|" in row)
    )
    known = {item.name for item in settings_of(DriverConfig)}
    assert len(names) >= 12
    assert set(names) <= known


def test_the_animation_is_small() -> None:
    assert (ROOT / "docs/demo.gif").stat().st_size < 1_000_000
