"""Calibration file of one unit: corrections, their deviations, and the block they apply to."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from l2lidar_node.files import write_whole
from l2lidar_node.protocol import wire

FORMAT: Final = 1
_LARGEST_FILE: Final = 1_000_000  # [B]
_LIMITS: Final = {
    "alpha_angle_bias": math.radians(2.0),
    "beta_angle": math.radians(2.0),
    "xi_angle": math.radians(2.0),
    "b_axis_dist": 0.01,
    "range_bias": 0.5,
    "range_scale": 0.02,
}
"""Entries of a correction and the largest that is a calibration error; angles in radians, lengths
in meters, the scale relative to the reported one."""

_IMU_LIMITS: Final = {
    "rotation_rpy": math.radians(15.0),
    "gyro_bias": 0.2,
    "gyro_scale": 0.1,
    "gyro_skew": 0.05,
}
_LATEST_S: Final = 0.1


class CalibrationFileError(ValueError):
    """A calibration file that cannot be used; the message says why and what would be right."""


@dataclass(frozen=True, slots=True)
class ImuCalibration:
    """Calibration of a unit's IMU.

    Attributes
    ----------
    rotation_rpy : tuple of float
        Roll, pitch, yaw of the IMU in the cloud frame [rad].
    time_offset : float
        What its stamps are late by [s].
    gyro_bias : tuple of float
        [rad/s]
    gyro_scale : tuple of float
        Measured over true rate of each axis, minus one.
    gyro_skew : tuple of float
        Symmetric misalignment of x and y, x and z, y and z [rad].
    sd : dict
        Standard deviations by the names above.
    """

    rotation_rpy: tuple[float, float, float]
    time_offset: float
    gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyro_scale: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyro_skew: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sd: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CalibrationFile:
    """A correction of one unit in one mode.

    Attributes
    ----------
    block : bytes
        The 32 bytes that the unit reports: its identity. Nothing else is corrected.
    correction : dict
        What is added to entries of the block: angles [rad], ``b_axis_dist`` [m], ``range_bias``
        [m] to every range, and ``range_scale`` relative to the reported one.
    sd : dict
        Standard deviations of the same.
    imu : ImuCalibration or None
    about : dict
        Everything else that the file says, for people.
    path : str
        Empty where it was not read from a file.
    """

    block: bytes
    correction: dict[str, float]
    sd: dict[str, float] = field(default_factory=dict)
    imu: ImuCalibration | None = None
    about: dict[str, Any] = field(default_factory=dict)
    path: str = ""

    def matches(self, block: bytes) -> bool:
        """Return whether a block is that of this unit, to the bit."""
        return block == self.block

    def corrected(self, block: bytes) -> bytes:
        """Return the block to use instead of a reported one: that itself, unless it matches."""
        if not self.matches(block):
            return block
        record = np.frombuffer(block, wire.CALIBRATION, 1).copy()
        values = {name: float(record[name][0]) for name in wire.CALIBRATION.names or ()}
        for name in ("alpha_angle_bias", "beta_angle", "xi_angle", "b_axis_dist"):
            values[name] += self.correction.get(name, 0.0)
        # D = scale (raw + bias) becomes (1 + s) D + offset.
        values["range_scale"] *= 1.0 + self.correction.get("range_scale", 0.0)
        if values["range_scale"]:
            offset = self.correction.get("range_bias", 0.0)
            values["range_bias"] += offset / values["range_scale"]
        for name, value in values.items():
            record[name] = value
        return record.tobytes()

    def save(self, path: Path) -> None:
        """Write the file, complete or not at all."""
        write_whole(path, self.text())

    def text(self) -> str:
        """Return the content of the file."""
        record = np.frombuffer(self.block, wire.CALIBRATION, 1)[0]
        content: dict[str, Any] = {
            "format": FORMAT,
            "reported": {
                "block": self.block.hex(),
                **{name: _short(float(record[name])) for name in wire.CALIBRATION.names or ()},
            },
            "correction": {name: _short(value) for name, value in self.correction.items()},
            "sd": {name: _short(value) for name, value in self.sd.items()},
        }
        if self.imu is not None:
            content["imu"] = {
                "rotation_rpy": [_short(value) for value in self.imu.rotation_rpy],
                "time_offset": _short(self.imu.time_offset),
                "gyro_bias": [_short(value) for value in self.imu.gyro_bias],
                "gyro_scale": [_short(value) for value in self.imu.gyro_scale],
                "gyro_skew": [_short(value) for value in self.imu.gyro_skew],
                "sd": {name: _short(value) for name, value in self.imu.sd.items()},
            }
        content["about"] = self.about
        head = (
            "# Calibration of one L2, written by `l2lidar calibrate`; give it to the driver as\n"
            "# calibration_file, and to deskew and odometry too if it has a section `imu`.\n"
            "# SI units; range_bias in meters, range_scale relative.\n"
            "# Used for packets whose calibration block equals `block`, bit for bit.\n"
        )
        return head + yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def load(path: Path) -> CalibrationFile:
    """Return the calibration that a file holds.

    Raises
    ------
    CalibrationFileError
        If the file cannot be read or holds anything that cannot be a calibration.
    """
    try:
        with path.expanduser().open("rb") as stream:
            text = stream.read(_LARGEST_FILE + 1)
    except OSError as error:
        raise CalibrationFileError(f"{path}: {error.strerror}") from None
    if len(text) > _LARGEST_FILE:
        raise CalibrationFileError(f"{path}: too large for a calibration file (1 MB at most)")
    try:
        content = yaml.safe_load(text)
    except Exception as error:  # PyYAML has its own, and any other for tags that do not fit
        first = str(error).partition("\n")[0]
        raise CalibrationFileError(f"{path}: not YAML ({first})") from None
    try:
        return _parsed(content, str(path))
    except CalibrationFileError as error:
        raise CalibrationFileError(f"{path}: {error}") from None
    except ValueError:  # Python reads such integers in hexadecimal, but cannot name them
        raise CalibrationFileError(
            f"{path}: an integer of more than {sys.get_int_max_str_digits()} digits, expected "
            "numbers of a calibration"
        ) from None


def _parsed(content: object, path: str) -> CalibrationFile:
    whole = _mapping(content, "the file")
    if whole.get("format") != FORMAT:
        raise CalibrationFileError(
            f"format is {whole.get('format')!r}, expected {FORMAT}: a file that "
            "`l2lidar calibrate` wrote"
        )
    reported = _mapping(whole.get("reported"), "reported")
    block = _block(reported.get("block"))
    given = _mapping(whole.get("correction"), "correction")
    for name in given:
        if name not in _LIMITS:
            raise CalibrationFileError(
                f"correction.{name} is not known, expected {', '.join(_LIMITS)}"
            )
    correction = {
        str(name): _number(value, f"correction.{name}", _LIMITS[str(name)])
        for name, value in given.items()
    }
    sd = _deviations(whole.get("sd"), "sd")
    about = whole.get("about")
    return CalibrationFile(
        block,
        correction,
        sd,
        None if whole.get("imu") is None else _imu(_mapping(whole["imu"], "imu")),
        about if isinstance(about, dict) else {},
        path,
    )


def _imu(given: dict[Any, Any]) -> ImuCalibration:
    vectors = {
        name: _vector(given.get(name, [0.0, 0.0, 0.0]), f"imu.{name}", limit)
        for name, limit in _IMU_LIMITS.items()
    }
    return ImuCalibration(
        vectors["rotation_rpy"],
        _number(given.get("time_offset", 0.0), "imu.time_offset", _LATEST_S),
        vectors["gyro_bias"],
        vectors["gyro_scale"],
        vectors["gyro_skew"],
        _deviations(given.get("sd"), "imu.sd"),
    )


def _block(given: object) -> bytes:
    size = wire.CALIBRATION.itemsize
    try:
        block = bytes.fromhex(given) if isinstance(given, str) else b""
    except ValueError:
        block = b""
    if len(block) != size:
        raise CalibrationFileError(
            f"reported.block is {given!r:.80}, expected {2 * size} hexadecimal digits"
        )
    return block


def _mapping(given: object, name: str) -> dict[Any, Any]:
    if not isinstance(given, dict):
        raise CalibrationFileError(f"{name} is not a mapping of names to values")
    return given


def _deviations(given: object, name: str) -> dict[str, float]:
    if given is None:
        return {}
    return {
        str(key): _number(value, f"{name}.{key}", math.inf)
        for key, value in _mapping(given, name).items()
    }


def _vector(given: object, name: str, limit: float) -> tuple[float, float, float]:
    if not isinstance(given, list) or len(given) != 3:
        raise CalibrationFileError(f"{name} is {given!r:.80}, expected three numbers")
    x, y, z = (_number(value, name, limit) for value in given)
    return (x, y, z)


def _number(given: object, name: str, limit: float) -> float:
    value = math.nan
    try:
        if isinstance(given, int | float) and not isinstance(given, bool):
            value = float(given)
    except OverflowError:
        raise CalibrationFileError(
            f"{name} is {given!r:.80}, expected a number of at most {sys.float_info.max:.2g}"
        ) from None
    if not math.isfinite(value):
        raise CalibrationFileError(f"{name} is {given!r:.80}, expected a number")
    if abs(value) > limit:
        raise CalibrationFileError(
            f"{name} is {value:g}, expected {-limit:.4g} to {limit:.4g}: larger errors are "
            "not calibration errors"
        )
    return value


def _short(value: float) -> float:
    """Return a number without digits that mean nothing."""
    return float(f"{value:.9g}")
