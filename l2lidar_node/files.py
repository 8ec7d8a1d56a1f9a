"""Atomic file writes, files that the package shares, and the folder for those of services."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

DATA_DIR: Final = "~/.ros/l2lidar"
"""Folder of what services write, where the user names no other."""


def shared_file(name: str) -> Path | None:
    """Return a file that this package shares, as installed by colcon or pip, or of a checkout.

    Parameters
    ----------
    name : str
        Path in the checkout, for example ``urdf/l2lidar.xacro``.

    Returns
    -------
    Path or None
        None if there is no such file.
    """
    prefixes = [Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(":")]
    folders = [prefix / "share/l2lidar_node" for prefix in [*prefixes, Path(sys.prefix)]]
    for folder in [Path(__file__).resolve().parents[1], *folders]:
        if (folder / name).is_file():
            return folder / name
    return None


def free_name(path: Path) -> Path:
    """Return the path, or if there is such a file the first free one with ``-1``, ``-2`` added."""
    number = 0
    free = path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Give a name of the same suffix to write to; at the end the file replaces ``path``.

    After an exception what was written is removed, and ``path`` stays what it was. An error of the
    operating system names ``path``.
    """
    part = path.with_name(f".part-{path.name}")
    try:
        yield part
        os.replace(part, path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (part, str(part)):
            error.filename, error.filename2 = str(path), None
        raise


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file's content, text as UTF-8."""
    with whole(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


class DataFolder:
    """The folder that services of a node write to and read from.

    Every participant of the ROS domain can call services and set parameters. So their file names
    stay inside this folder, and nothing is overwritten unless the node was started with overwrite.

    Parameters
    ----------
    path : str
        ``~`` is the home folder; made when something is written.
    overwrite : bool
        Whether files may be replaced.
    """

    def __init__(self, path: str, overwrite: bool) -> None:
        self.path = Path(path).expanduser()
        self._overwrite = overwrite

    def file(self, name: str) -> Path:
        """Return the path of a file of this name.

        Raises
        ------
        FileNameError
            If it is not the name of a file in this folder.
        """
        if name in ("", ".", "..") or name != os.path.basename(name) or "\0" in name:
            raise FileNameError(
                f"{name!r} is not a file name: expected a name inside {self.path}, without folder"
            )
        return self.path / name

    def new_files(self, *names: str) -> list[Path]:
        """Return the paths of files to be written, their folder made.

        Raises
        ------
        FileNameError
            As :meth:`file`; or two names are the same; or one exists and must not be overwritten.
        OSError
            If the folder cannot be made.
        """
        paths = [self.file(name) for name in names]
        if len(set(paths)) < len(paths):
            raise FileNameError(f"{names[0]!r} would be written twice: expected another suffix")
        for path in paths:
            if path.is_dir() or (not self._overwrite and os.path.lexists(path)):
                raise FileNameError(
                    f"{path} exists: choose another name, move it away, or start the node with "
                    "overwrite: true"
                )
        self.path.mkdir(parents=True, exist_ok=True)
        return paths


class FileNameError(ValueError):
    """A file name that is not allowed; the message says why and what would be right."""
