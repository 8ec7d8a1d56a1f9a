"""Signals at every stage of a program: while Python imports, at work, while it ends."""

from __future__ import annotations

import fcntl
import os
import re
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.support.processes import ended_with_the_test

ROOT = Path(__file__).parents[2]
LIMIT_S = 120.0
needs_ros = pytest.mark.skipif(find_spec("rclpy") is None, reason="needs rclpy")
MODULES = [
    pytest.param("l2lidar_node.ros.driver_node", marks=needs_ros),
    pytest.param("l2lidar_proc.ros.deskew_node", marks=needs_ros),
    pytest.param("l2lidar_proc.ros.odometry_node", marks=needs_ros),
    pytest.param("l2lidar_node.demo", marks=needs_ros),
    "l2lidar_node.emulator",
    "l2lidar_node.cli.main",
]
ENTRIES = [
    pytest.param("l2lidar_node.programs:l2lidar_node", marks=needs_ros),
    pytest.param("l2lidar_proc.programs:deskew_node", marks=needs_ros),
    pytest.param("l2lidar_proc.programs:odometry_node", marks=needs_ros),
    "l2lidar_node.programs:l2lidar_emulator",
    "l2lidar_node.programs:l2lidar",
]


def started(*arguments: str) -> subprocess.Popen[str]:
    """Start Python; it cannot go on for long while nobody reads what it says."""
    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, 4096)
    process = subprocess.Popen(
        [sys.executable, "-u", *arguments],
        cwd=ROOT, stdout=writing, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    os.close(writing)
    process.stdout = open(reading, buffering=1)  # noqa: SIM115 - communicate() closes it
    return ended_with_the_test(process)


def while_importing(process: subprocess.Popen[str]) -> None:
    """Return when a program that tells of its imports has come to the long ones.

    It tells of some hundred more before they are done, more than fits between it and this test.
    """
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("import time:") and re.search("numpy|typer", line):
            return
        assert "Traceback" not in line
    raise AssertionError("it imports nothing that takes long")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("module", MODULES)
def test_a_signal_while_it_imports_ends_it_without_a_trace(module: str, number: int) -> None:
    process = started("-X", "importtime", "-m", module)
    while_importing(process)
    process.send_signal(number)
    said, _ = process.communicate(timeout=LIMIT_S)
    assert process.returncode in (-number, 128 + number)  # to a shell they are the same
    assert "Traceback" not in said
    assert "Aborted" not in said


@pytest.mark.parametrize("entry", ENTRIES)
def test_an_installed_program_ends_so_too(entry: str) -> None:
    module, name = entry.split(":")
    code = f"import sys; from {module} import {name}; sys.exit({name}())"
    process = started("-X", "importtime", "-c", code)
    while_importing(process)
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=LIMIT_S)
    assert process.returncode in (-signal.SIGINT, 128 + signal.SIGINT)
    assert "Traceback" not in said


def test_importing_the_package_leaves_the_handler_of_others_alone() -> None:
    code = (
        "import signal, l2lidar_node, l2lidar_proc.deskew.config\n"
        "assert signal.getsignal(signal.SIGINT) is signal.default_int_handler"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


WORK = """
import signal, sys, time
from l2lidar_node import programs
from l2lidar_node.programs import held, interruptible

{before}

def main():
    {work}

code = interruptible(main)
assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
sys.exit(code)
"""
WAIT = "print('go', flush=True); time.sleep(60)"


def ended(work: str, *numbers: int, before: str = "") -> tuple[int, str]:
    """Return exit code and words of a program that is sent signals whenever it says ``go``."""
    process = started("-c", WORK.format(work=work, before=before))
    assert process.stdout is not None
    for number in numbers:
        assert process.stdout.readline() == "go\n"
        process.send_signal(number)
    said, _ = process.communicate(timeout=LIMIT_S)
    return process.returncode, said


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_interrupts_and_the_exit_code_tells_which(number: int, code: int) -> None:
    assert ended(WAIT, number) == (code, "")


def test_what_is_made_of_an_interruption_counts() -> None:
    work = f"""
    try:
        {WAIT}
    except KeyboardInterrupt:
        return 7
    """
    assert ended(work, signal.SIGINT) == (7, "")


def test_a_second_signal_does_not_interrupt_what_the_first_one_began() -> None:
    work = f"""
    try:
        {WAIT}
    finally:
        print('go', flush=True)
        while not came:
            time.sleep(0.01)
        print('ended well')
    """
    # However long the second one takes to come, it is taken to follow soon.
    before = """
came = []
class Interruption(type(programs._interruption)):
    def __call__(self, number, frame):
        super().__call__(number, frame)
        came.append(number)

programs._SAME_WISH_S = 1e9
programs._interruption.__class__ = Interruption
programs._interruption._last = -1e10
"""
    assert ended(work, signal.SIGINT, signal.SIGINT, before=before) == (130, "ended well\n")


def test_a_signal_waits_while_a_process_is_started() -> None:
    work = """
    try:
        with held():
            print('go', flush=True)
            while not signal.sigpending():
                pass
            print('started')
    except KeyboardInterrupt:
        print('interrupted then')
        raise
    """
    assert ended(work, signal.SIGINT) == (130, "started\ninterrupted then\n")


@pytest.mark.parametrize(("leave", "code"), [("return 3", 3), ("sys.exit(4)", 4), ("return", 0)])
def test_exit_codes_are_handed_on(leave: str, code: int) -> None:
    assert ended(leave) == (code, "")


def test_a_program_that_is_to_ignore_interrupts_does() -> None:
    """As the shell has it for what runs in the background."""
    code = (
        "import signal, sys; from l2lidar_node.programs import end_by_signal, interruptible\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN); end_by_signal()\n"
        "sys.exit(interruptible(lambda: signal.raise_signal(signal.SIGINT) or 5))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False)
    assert done.returncode == 5
