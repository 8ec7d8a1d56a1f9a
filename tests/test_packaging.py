"""Checks that what is built, installed and declared is what the code needs."""

import ast
import importlib
import importlib.metadata
import os
import re
import subprocess
import sys
import sysconfig
import time
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import pytest

from l2lidar_node.command_line import Verb

ROOT = Path(__file__).parent.parent
NAME = "l2lidar_node"
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()
SHARED_FOLDERS = ("config", "environment", "launch", "rviz", "urdf", "meshes")
EXECUTABLES = {
    *("l2lidar", "l2lidar_emulator", "l2lidar_node"),
    *("companion_node", "deskew_node", "odometry_node", "slam_node"),
}

# Of ROS 2, by import name, where it is not the package's own.
ROS_MODULES = re.compile(
    r"(rclpy|ament_index_python|launch|launch_ros|\w+_interfaces|\w+_msgs|\w+_srvs)$"
)
# By import name, where PyPI has another.
DISTRIBUTIONS = {
    "yaml": "PyYAML",
    "kiss_icp": "kiss-icp",
    "open3d": "open3d-cpu",
    "rerun": "rerun-sdk",
}


@cache
def imported(*folders: str) -> frozenset[str]:
    """Return the top-level names that the Python files of the folders import."""
    if len(folders) > 1:
        return frozenset().union(*map(imported, folders))
    names: set[str] = set()
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names.update(alias.name.split(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.add(node.module.split(".")[0])
    ours = {"__future__", "l2lidar_node", "l2lidar_proc"}
    return frozenset(names - set(sys.stdlib_module_names) - ours)


def shared_files(folder: Path) -> set[Path]:
    """Return the files of the shared folders relative to ``folder``."""
    return {
        path.relative_to(folder)
        for name in SHARED_FOLDERS
        for path in (folder / name).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_the_version_stands_once() -> None:
    assert importlib.metadata.version(NAME) == MANIFEST.findtext("version")


def test_the_changelog_knows_the_version() -> None:
    latest = re.search(r"^(Forthcoming|\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.rst").read_text(), re.M)
    assert latest is not None
    assert latest[0] in ("Forthcoming", MANIFEST.findtext("version"))


def test_every_ros_package_imported_is_declared() -> None:
    declared = {item.text for item in MANIFEST.iter("exec_depend")}
    used = {
        name
        for name in imported("l2lidar_node", "l2lidar_proc", "launch")
        if ROS_MODULES.match(name)
    }
    assert "rclpy" in used
    assert used - declared == set()


def test_rosdep_knows_the_python_packages_declared() -> None:
    """One key that it does not know makes it refuse all others."""
    known = (
        "filterpy-pip hypothesis matplotlib numpy open3d-pip pytest rich rosbags-pip scipy typer"
    )
    keys = {f"python3-{name}" for name in (*known.split(), "yaml")}  # looked up in its database
    declared = {str(item.text) for item in MANIFEST if item.tag.endswith("_depend")}
    assert {name for name in declared if name.startswith("python3-")} <= keys


def test_the_page_on_installing_names_what_is_declared() -> None:
    """What pip brings to a machine with ROS is a part of what setup.py asks for."""
    declared = {
        re.findall(r"[\w.-]+", line)[0] for line in importlib.metadata.requires(NAME) or []
    }
    lines = (ROOT / "requirements/ubuntu-pip.txt").read_text().splitlines()
    names = {re.findall(r"[\w.-]+", line)[0] for line in lines if not line.startswith("#")}
    assert "kiss-icp" in names
    assert names - declared == set()


def test_every_python_package_imported_is_declared() -> None:
    requirements = importlib.metadata.requires(NAME) or []
    declared = {re.findall(r"[\w.-]+", line)[0] for line in requirements if "extra ==" not in line}
    optional = {
        re.findall(r"[\w.-]+", line)[0]
        for line in requirements
        if re.search(r"""extra == ["'](view|slam)["']""", line)
    }
    used = {
        name for name in imported("l2lidar_node", "l2lidar_proc") if not ROS_MODULES.match(name)
    }
    assert {DISTRIBUTIONS.get(name, name) for name in used} - declared - optional == set()


@pytest.mark.ros
@pytest.mark.parametrize(
    ("module", "allowed"),
    [
        ("l2lidar_node.ros.driver_node", {"dpkt"}),
        ("l2lidar_proc.ros.deskew_node", {"dpkt", "scipy", "filterpy"}),
        ("l2lidar_proc.ros.odometry_node", {"dpkt", "scipy", "filterpy", "kiss_icp"}),
    ],
)
def test_a_node_needs_what_the_page_on_installing_says(module: str, allowed: set[str]) -> None:
    seen = subprocess.run(
        [sys.executable, "-c", f"import sys, {module}; print(*sys.modules)"],
        capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    heavy = {"dpkt", "scipy", "filterpy", "kiss_icp", "open3d", "rosbags", "typer", "matplotlib"}
    assert heavy & set(seen) <= allowed


@pytest.mark.parametrize(
    "entry", importlib.metadata.distribution(NAME).entry_points, ids=lambda entry: entry.name
)
def test_an_entry_point_leads_to_a_function(entry: importlib.metadata.EntryPoint) -> None:
    if ".ros." in entry.module:
        pytest.importorskip("rclpy", reason="needs rclpy")
    found = entry.load()
    if isinstance(found, Verb):
        module, _, name = found.target.partition(":")
        found = getattr(importlib.import_module(module), name)
    assert callable(found)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a workspace built as docs/install.md says: by the Python of a virtual environment.

    This environment stands for the machine's packages, which the new one sees as it would see
    those of Ubuntu.
    """
    pytest.importorskip("colcon_core", reason="needs colcon")
    folder = tmp_path_factory.mktemp("workspace")
    site = sysconfig.get_path("purelib")
    environment = {**os.environ, "PYTHONPATH": site}
    python = folder / ".venv/bin/python"
    log = ["--log-base", str(folder / "log")]
    for command in (
        [
            sys.executable,
            "-m",
            "venv",
            "--without-pip",
            "--system-site-packages",
            str(folder / ".venv"),
        ],
        [str(python), "-m", "colcon", *log, "build", "--base-paths", str(ROOT)],
    ):
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_colcon_builds_the_package(workspace: Path) -> None:
    """Executables, index entry and shared files are where ``ros2 run`` and launch files look."""
    prefix = workspace / "install" / NAME
    built = {path.name for path in (prefix / "lib" / NAME).iterdir() if os.access(path, os.X_OK)}
    assert built == EXECUTABLES
    assert (prefix / "share/ament_index/resource_index/packages" / NAME).is_file()
    assert shared_files(prefix / "share" / NAME) == shared_files(ROOT)
    installed = next(prefix.glob("lib/python3*/site-packages"))
    packages = {
        path.relative_to(ROOT)
        for name in (NAME, "l2lidar_proc")
        for path in (ROOT / name).rglob("*.py")
    }
    assert {path.relative_to(installed) for path in installed.rglob("*.py")} >= packages


@pytest.mark.parametrize("shell", ["sh", "bash"])
def test_the_programs_are_on_the_path_and_run_by_the_environment(
    workspace: Path, shell: str
) -> None:
    """After ``source install/setup.bash``, as docs/install.md says."""
    script = f". install/setup.{shell} && command -v l2lidar_emulator && l2lidar --version"
    environment = {
        "PATH": "/usr/bin:/bin",
        "HOME": str(workspace),
        "PYTHONPATH": sysconfig.get_path("purelib"),
    }
    done = subprocess.run(
        [shell, "-c", script],
        cwd=workspace, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    folder = workspace / "install" / NAME / "lib" / NAME
    assert done.stdout.split() == [
        str(folder / "l2lidar_emulator"), "l2lidar", str(MANIFEST.findtext("version")),
    ]  # fmt: skip
    first = (folder / "l2lidar").read_text().splitlines()[0]
    assert first == f"#!{workspace}/.venv/bin/python"


@pytest.mark.ros
def test_an_installed_package_finds_what_it_shares(workspace: Path) -> None:
    """The example robots of the demo, and the consumers' profiles of ``l2lidar check``."""
    program = (
        "from l2lidar_node.demo import report; "
        "from l2lidar_node.files import shared_file; "
        "print(report.__file__, report.mount('forward').shape, "
        "shared_file('config/consumers/lio_sam/driver.yaml'))"
    )
    done = subprocess.run(
        ["sh", "-c", f'. install/setup.sh && {sys.executable} -c "{program}"'],
        cwd=workspace, env={"PATH": "/usr/bin:/bin"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    prefix = workspace / "install" / NAME
    (installed,) = prefix.glob("lib/python3*/site-packages")
    assert done.stdout.split(maxsplit=1) == [
        f"{installed}/l2lidar_node/demo/report.py",
        f"(4, 4) {prefix}/share/{NAME}/config/consumers/lio_sam/driver.yaml\n",
    ]


@pytest.mark.ros
def test_transforms_have_the_type_every_ros_2_has() -> None:
    """Another machine's ROS 2 takes our transforms only if the message's type hash is its own."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from tf2_msgs.msg import TFMessage

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("probe", context=context)
    executor = SingleThreadedExecutor(context=context)
    publisher = node.create_publisher(TFMessage, "transforms", 1)
    deadline = time.monotonic() + 60.0
    while not (endpoints := node.get_publishers_info_by_topic("transforms")):
        assert time.monotonic() < deadline
        rclpy.spin_once(node, executor=executor, timeout_sec=0.05)
    (endpoint,) = endpoints
    assert str(endpoint.topic_type_hash) == (
        "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
    )
    publisher.destroy()
    node.destroy_node()
    context.shutdown()
