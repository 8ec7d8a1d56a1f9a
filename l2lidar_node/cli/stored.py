"""What a unit stores, as people write it: work modes and the fields of the parameter block."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from l2lidar_node.protocol import wire
from l2lidar_node.protocol.wire import WorkMode

_NAMES: Final = {bit.name.lower(): bit for bit in WorkMode if bit.name}
_AT_ONCE: Final = WorkMode.WIDE_FOV | WorkMode.IMU_OFF
STANDARD: Final = "standard"


def work_mode(text: str, now: int) -> int:
    """Return the work mode that a text names.

    Parameters
    ----------
    text : str
        A number (``0``, ``0x10``); names joined by commas (``wide_fov,imu_off``; ``standard`` for
        none); or changes to what is set now (``+imu_off,-wide_fov``).
    now : int
        The mode that is set.

    Raises
    ------
    ValueError
        If it is none of that.
    """
    try:
        number = int(text, 0)
    except ValueError:
        return _named(text, now)
    if text[:1] in "+-" or number & ~wire.WORK_MODE_MASK:
        raise ValueError(f"work mode {text}: expected 0 to {wire.WORK_MODE_MASK:#x}")
    return number


def _named(text: str, now: int) -> int:
    parts = [part.strip().lower() for part in text.split(",")]
    changes = [part for part in parts if part[:1] in ("+", "-")]
    if changes and len(changes) < len(parts):
        raise ValueError(f"work mode {text}: either all names have a sign or none has")
    mode = now if changes else 0
    for part in parts:
        name = part.lstrip("+-")
        if name == STANDARD and not changes:
            continue
        if name not in _NAMES:
            known = ", ".join([STANDARD, *_NAMES])
            raise ValueError(f"work mode {text}: '{name}' is not known, expected {known}")
        mode = mode & ~_NAMES[name] if part.startswith("-") else mode | _NAMES[name]
    return int(mode)


def work_mode_text(mode: int) -> str:
    """Return a work mode as number and names."""
    names = [name for name, bit in _NAMES.items() if mode & bit]
    rest = mode & ~int(sum(_NAMES.values()))
    if rest:
        names.append(f"unknown bits {rest:#x}")
    return f"{mode} ({', '.join(names) or STANDARD})"


def needs_restart(before: int, after: int) -> bool:
    """Tell whether a change of the work mode acts only after a restart."""
    return bool((before ^ after) & ~int(_AT_ONCE))


def parameter_fields(payload: bytes) -> dict[str, float]:
    """Return the fields of a parameter block whose meaning is known, by dotted name."""
    row = np.frombuffer(payload, wire.PARAMETERS_PAYLOAD, 1)[0]
    return {name: float(_at(row, name)) for name in _fields()}


def with_parameters(payload: bytes, changes: list[str]) -> bytes:
    """Return a parameter block with fields replaced.

    Parameters
    ----------
    payload : bytes
    changes : list of str
        Each ``name=value``.

    Raises
    ------
    ValueError
        If a name is not known or a value is no finite number.
    """
    block = np.frombuffer(payload, wire.PARAMETERS_PAYLOAD, 1).copy()
    for text in changes:
        name, sign, value = text.partition("=")
        if not sign:
            raise ValueError(f"{text}: expected NAME=VALUE")
        if name not in _fields():
            raise ValueError(f"{name}: not known, expected one of {', '.join(_fields())}")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not abs(number) <= float(np.finfo(np.float32).max):
            raise ValueError(f"{name}: '{value}' is not a finite number")
        *groups, field = name.split(".")
        part: Any = block
        for group in groups:
            part = part[group]
        part[field] = number
    fields = parameter_fields(block.tobytes())
    if not 0.0 <= fields["range_min"] < fields["range_max"]:
        raise ValueError("range_min must be at least 0 and less than range_max")
    return block.tobytes()


def _fields() -> list[str]:
    """Return the dotted names of the known fields."""
    names = ["range_min", "range_max"]
    for group in wire.PARAMETERS_PAYLOAD.names or ():
        if group.startswith("calibration"):
            names += [f"{group}.{field}" for field in wire.CALIBRATION.names or ()]
    return names


def _at(row: Any, name: str) -> Any:
    for part in name.split("."):
        row = row[part]
    return row
