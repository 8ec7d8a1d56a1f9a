"""Writes files that are complete or as they were before, whatever ends the program meanwhile."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


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

    After an exception what was written is removed, and ``path`` stays what it was.
    """
    part = path.with_name(f".part-{path.name}")
    try:
        yield part
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file's content, text as UTF-8."""
    with whole(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
