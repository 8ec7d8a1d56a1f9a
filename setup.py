"""Installs both Python packages and the files a ROS 2 package shares."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

HERE = Path(__file__).parent
MANIFEST = ElementTree.parse(HERE / "package.xml").getroot()
NAME = MANIFEST.findtext("name", "")
SHARED_FOLDERS = ("config", "environment", "launch", "rviz", "urdf", "meshes")


def shared_files() -> list[tuple[str, list[str]]]:
    """Return the shared folders' files, each at the same relative path below ``share``."""
    found: list[tuple[str, list[str]]] = [
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ]
    for top in SHARED_FOLDERS:
        for folder in sorted({path.parent for path in (HERE / top).rglob("*") if path.is_file()}):
            relative = folder.relative_to(HERE)
            if "__pycache__" not in relative.parts:
                names = sorted(path.name for path in folder.iterdir() if path.is_file())
                found.append(
                    (f"share/{NAME}/{relative}", [f"{relative}/{name}" for name in names])
                )
    return found


setup(
    name=NAME,
    version=MANIFEST.findtext("version"),
    description=MANIFEST.findtext("description"),
    license=MANIFEST.findtext("license"),
    author=MANIFEST.findtext("maintainer"),
    maintainer=MANIFEST.findtext("maintainer"),
    packages=find_packages(include=["l2lidar_node*", "l2lidar_proc*"]),
    package_data={"": ["py.typed"], "l2lidar_node.ros": ["*.xml"]},
    data_files=shared_files(),
    zip_safe=False,
    python_requires=">=3.11,<3.13",
    # The lower bounds let the packages of Ubuntu 24.04 do, which a sourced ROS 2 brings along.
    install_requires=[
        "numpy>=1.26.4",
        "scipy>=1.11.4",
        "filterpy>=1.4.5",
        "kiss-icp>=1.3,<2",
        # One library: its -cpu build is a quarter of the size and exists for one platform only.
        "open3d-cpu>=0.19; sys_platform == 'linux' and platform_machine == 'x86_64'",
        "open3d>=0.19; sys_platform != 'linux' or platform_machine != 'x86_64'",
        "dpkt>=1.9.8",
        "rosbags>=0.10.6",
        "PyYAML>=6.0.1",
        "zstandard>=0.22",
        "typer>=0.9",
        "rich>=13.7",
        "matplotlib>=3.6.3",
    ],
    extras_require={
        "bench": ["evo>=1.31"],
        "slam": ["gtsam>=4.3,<5"],
        "view": ["rerun-sdk>=0.20"],
        "docs": ["mkdocs>=1.6,<2", "mkdocs-material>=9.5,<10", "mkdocstrings[python]>=0.26"],
        "dev": [
            "hypothesis>=6.100",
            "import-linter>=2.1",
            "mypy>=2.4",
            "pytest>=9",
            "pytest-xdist>=3.6",
            "ruff>=0.9",
            "types-PyYAML",
            "xacro>=2.0",
            "yourdfpy>=0.0.56",
        ],
    },
    entry_points={
        "console_scripts": [
            "l2lidar_node = l2lidar_node.programs:l2lidar_node",
            "l2lidar_emulator = l2lidar_node.programs:l2lidar_emulator",
            "deskew_node = l2lidar_proc.programs:deskew_node",
            "companion_node = l2lidar_proc.programs:companion_node",
            "odometry_node = l2lidar_proc.programs:odometry_node",
            "slam_node = l2lidar_proc.programs:slam_node",
            "l2lidar = l2lidar_node.programs:l2lidar",
        ],
        # Verbs that a package adds to the command l2lidar.
        "l2lidar.verbs": [
            "deskew = l2lidar_proc.verbs:DESKEW",
            "odometry = l2lidar_proc.verbs:ODOMETRY",
            "slam = l2lidar_proc.verbs:SLAM",
            "export = l2lidar_proc.verbs:EXPORT",
        ],
    },
)
