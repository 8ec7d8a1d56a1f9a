"""What the set-up says where it cannot go on, with parts of the machine replaced."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
BASE_PYTHON = str(vars(sys)["_base_executable"])  # of a venv: the interpreter it was made with


NOWHERE = {
    "PIP_INDEX_URL": "http://127.0.0.1:9/simple",
    "PIP_RETRIES": "0",
    "PIP_CONFIG_FILE": "/dev/null",
}


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Return a folder with what the set-up reads, beside an empty folder for replaced programs."""
    folder = tmp_path / "project"
    for name in ("scripts", "requirements"):
        shutil.copytree(ROOT / name, folder / name)
    for name in ("setup.py", "setup.cfg", "package.xml", "Makefile"):
        shutil.copy(ROOT / name, folder)
    (tmp_path / "bin").mkdir()
    # Whatever happens, no test installs anything.
    replace_program(folder, "apt-get", "exit 1")
    replace_program(folder, "sudo", "exit 1")
    return folder


def replace_program(project: Path, name: str, script: str) -> None:
    program = project.parent / "bin" / name
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)


def run(project: Path, *command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    # The interpreter this one was made from: it has the right version and no ROS 2 of its own.
    environment = {"PYTHON": BASE_PYTHON, "HOME": str(project.parent)} | environment
    environment["PATH"] = f"{project.parent / 'bin'}:/usr/local/bin:/usr/bin:/bin"
    return subprocess.run(
        command or [str(project / "scripts/setup.sh")],
        env=environment,
        cwd=project,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )


def test_programs_that_are_started_keep_what_they_have_compiled(tmp_path: Path) -> None:
    """Also where the environment forbids it, in what make runs and in what tests start."""
    makefile = tmp_path / "Makefile"
    asked = 'print("forbidden" if __import__("sys").dont_write_bytecode else "kept")'
    makefile.write_text(f"include {ROOT / 'Makefile'}\nasked:\n\t@{sys.executable} -c '{asked}'\n")
    said = subprocess.run(
        ["make", "--no-print-directory", "-f", str(makefile), "asked"],
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert said.stdout.strip() == "kept"
    said = subprocess.run(
        [sys.executable, "-c", asked], capture_output=True, text=True, check=True
    )
    assert said.stdout.strip() == "kept"


def test_a_machine_without_wheels_is_told_to_install_ros(project: Path) -> None:
    replace_program(project, "uname", "echo Linux riscv64")
    done = run(project)
    assert done.returncode == 1
    assert "no ROS 2 wheels for Linux riscv64" in done.stderr
    assert "source /opt/ros/jazzy/setup.bash" in done.stderr


def test_missing_system_packages_are_named(project: Path) -> None:
    replace_program(project, "ldconfig", "echo 'libGL.so.1 (libc6) => /lib/libGL.so.1'")
    done = run(project)
    assert done.returncode == 1
    said = done.stderr.split("apt-get ")[1].splitlines()[0]
    assert {"libusb-1.0-0", "libegl1", "libgomp1"} <= set(said.split())
    assert "libgl1" not in said
    assert not (project / ".venv").exists()


def test_a_ros_that_is_named_but_not_sourced_is_explained(project: Path) -> None:
    replace_program(
        project, "ldconfig", "printf '%s \\n' libusb-1.0.so.0 libGL.so.1 libEGL.so.1 libgomp.so.1"
    )
    done = run(project, ROS_DISTRO="jazzy")
    assert done.returncode == 1
    assert "cannot import rclpy" in done.stderr
    assert not (project / ".venv").exists()


@pytest.mark.parametrize("command", [(), ("make", "setup")], ids=["script", "make"])
def test_an_interpreter_that_will_not_do_is_refused(project: Path, command: Any) -> None:
    """Named by PYTHON it is not passed over for another one, neither by make nor by the script."""
    done = run(project, *command, PYTHON="/bin/false")
    assert done.returncode != 0
    assert "PYTHON is '/bin/false', which is not a Python 3.11 or 3.12" in done.stderr
    assert not (project / ".venv").exists()


def test_an_unreachable_package_index_is_explained_and_the_next_run_goes_on(project: Path) -> None:
    """What was made before pip failed stays, also where the next command leaves PYTHON out."""
    replace_program(
        project, "ldconfig", "printf '%s \\n' libusb-1.0.so.0 libGL.so.1 libEGL.so.1 libgomp.so.1"
    )
    first = run(project, "make", "setup", **NOWHERE)
    assert f"creating .venv with {BASE_PYTHON}" in first.stdout
    assert first.returncode != 0
    assert "PIP_INDEX_URL" in first.stderr
    assert "setuptools" in first.stderr
    assert (project / ".venv/.setup/made").is_file()
    assert not (project / ".venv/.setup/ros").exists()
    again = run(project, "make", "setup", PYTHON="", **NOWHERE)
    assert "PIP_INDEX_URL" in again.stderr
    assert "making" not in again.stdout
