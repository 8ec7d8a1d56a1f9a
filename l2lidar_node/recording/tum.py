"""Reads and writes trajectories in the TUM text format: stamp x y z qx qy qz qw per line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

POSE: Final = np.dtype(
    [("stamp", "<i8"), ("position", "<f8", (3,)), ("quaternion_wxyz", "<f8", (4,))]
)
"""One pose: stamp [ns], position [m], unit quaternion body to world."""

_NANOSECONDS = 1_000_000_000


class TrajectoryError(ValueError):
    """A trajectory that cannot be used; the message names file, line and reason."""


def parse(text: str, name: str = "trajectory") -> NDArray[np.void]:
    """Return the poses of a TUM text.

    Parameters
    ----------
    text : str
        Lines of eight numbers; empty lines and those that begin with ``#`` are skipped.
    name : str
        What to call it in error messages.

    Returns
    -------
    ndarray, shape (N,), dtype POSE
        Strictly ascending stamps (digits of the stamp are kept exactly to the nanosecond), unit
        quaternions.

    Raises
    ------
    TrajectoryError
        For a line that is not eight finite numbers, a zero quaternion, or a stamp that does not
        rise.
    """
    rows: list[tuple[int, list[float], list[float]]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        where = f"{name}, line {number}"
        if len(fields) != 8:
            raise TrajectoryError(f"{where}: expected 8 numbers, found {len(fields)}")
        try:
            stamp = _nanoseconds(fields[0])
            x, y, z, qx, qy, qz, qw = (float(field) for field in fields[1:])
        except (ValueError, OverflowError):
            raise TrajectoryError(f"{where}: not a number in {line.strip()[:80]!r}") from None
        if not np.isfinite([x, y, z, qx, qy, qz, qw]).all():
            raise TrajectoryError(f"{where}: a value is not finite")
        norm = float(np.linalg.norm([qw, qx, qy, qz]))
        if not 0.5 < norm < 2.0:
            raise TrajectoryError(f"{where}: the quaternion's norm is {norm:g}, expected 1")
        if rows and stamp <= rows[-1][0]:
            raise TrajectoryError(
                f"{where}: stamp {fields[0]} is not later than the one before it"
            )
        rows.append((stamp, [x, y, z], [qw / norm, qx / norm, qy / norm, qz / norm]))
    poses = np.zeros(len(rows), POSE)
    if rows:
        stamps, positions, quaternions = zip(*rows, strict=True)
        poses["stamp"] = stamps
        poses["position"] = positions
        poses["quaternion_wxyz"] = quaternions
    return poses


def load(path: str | Path) -> NDArray[np.void]:
    """Return the poses of a TUM file, see :func:`parse`.

    Raises
    ------
    TrajectoryError
        As :func:`parse`, or if the file cannot be read.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise TrajectoryError(f"{path}: cannot be read as a trajectory: {error}") from None
    return parse(text, str(path))


def render(poses: NDArray[np.void]) -> str:
    """Return poses (dtype POSE) as TUM text; stamps with nine decimals, values to 1e-9."""
    lines = []
    for stamp, position, (w, x, y, z) in poses.tolist():
        values = " ".join(f"{value:.9f}" for value in (*position, x, y, z, w))
        lines.append(f"{_seconds(stamp)} {values}\n")
    return "".join(lines)


def pose_array(
    stamps_ns: Sequence[int] | NDArray[np.int64],
    positions: NDArray[np.float64],
    quaternions_wxyz: NDArray[np.float64],
) -> NDArray[np.void]:
    """Return a POSE array of stamps (N,) [ns], positions (N, 3) [m] and quaternions (N, 4)."""
    poses = np.zeros(len(stamps_ns), POSE)
    poses["stamp"] = stamps_ns
    poses["position"] = positions
    poses["quaternion_wxyz"] = quaternions_wxyz
    return poses


def _nanoseconds(text: str) -> int:
    """Read decimal seconds without the 0.2 us that a double costs at today's epoch."""
    whole, dot, fraction = text.partition(".")
    digits = whole.lstrip("+-") + fraction
    if dot and digits.isascii() and digits.isdigit():
        size = int(whole.lstrip("+-") or "0") * _NANOSECONDS + int(fraction[:9].ljust(9, "0"))
        value = -size if whole.startswith("-") else size
    else:
        value = round(float(text) * _NANOSECONDS)
    if abs(value) >= 2**62:
        raise OverflowError(text)
    return value


def _seconds(stamp_ns: int) -> str:
    sign = "-" if stamp_ns < 0 else ""
    whole, fraction = divmod(abs(stamp_ns), _NANOSECONDS)
    return f"{sign}{whole}.{fraction:09d}"
