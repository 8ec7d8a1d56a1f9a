"""Which calibration block is used for a packet: the unit's own, a file's, or parameters'."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from l2lidar_node.calibration.file import CalibrationFile, CalibrationFileError, load
from l2lidar_node.config import FileConfig, SweepConfig
from l2lidar_node.protocol import wire
from l2lidar_node.settings import SettingError

UNIT: Final = "unit"
PARAMETER: Final = "parameter"

_ANGLES: Final = {
    "alpha_angle_bias": "alpha_angle_bias",
    "beta_angle": "beta_angle",
    "xi_angle": "xi_angle",
    "theta_angle_bias": "theta_angle_bias",
    "b_axis_dist": "b_axis_dist",
}
"""Entries of a block by the field of the setting that replaces them."""
_RANGES: Final = {"range_scale": "range_scale", "range_bias": "range_bias"}
_REMEMBERED: Final = 16


def calibration_file(config: FileConfig) -> CalibrationFile | None:
    """Return the file that the settings name, None if they name none.

    Raises
    ------
    SettingError
        If it cannot be used.
    """
    if not config.calibration_file:
        return None
    try:
        return load(Path(config.calibration_file))
    except CalibrationFileError as error:
        raise SettingError(f"parameter 'calibration_file': {error}") from None


class BlockChoice:
    """Replaces the blocks that a unit reports by those to use.

    Parameters win over the file, the file over the unit. Recordings keep what the unit reports.

    Parameters
    ----------
    config : SweepConfig
        May be replaced while running through :meth:`configure`.
    file : CalibrationFile, optional
    """

    def __init__(self, config: SweepConfig, file: CalibrationFile | None = None) -> None:
        self.file = file
        self.configure(config)

    def configure(self, config: SweepConfig) -> None:
        """Use other parameters from now on."""
        self._config = config
        self._known: dict[bytes, bytes] = {}
        self._replaced = _ANGLES if config.override_angle_calibration else {}

    @property
    def is_needed(self) -> bool:
        """Whether any block might be replaced."""
        return self.file is not None or bool(self._replaced)

    def used(self, reported: bytes) -> bytes:
        """Return the 32 bytes to use for a packet that reports these.

        ``EnableCalRangeOVR`` is not in them: it acts on the ranges themselves.
        """
        found = self._known.get(reported)
        if found is None:
            found = reported if self.file is None else self.file.corrected(reported)
            if self._replaced:
                record = np.frombuffer(found, wire.CALIBRATION, 1).copy()
                for field, name in self._replaced.items():
                    record[name] = getattr(self._config, field)
                found = record.tobytes()
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            self._known[reported] = found
        return found

    def values(self, reported: bytes) -> dict[str, float]:
        """Return what is used by name, ranges of the parameters included."""
        record = np.frombuffer(self.used(reported), wire.CALIBRATION, 1)[0]
        values = {name: float(record[name]) for name in wire.CALIBRATION.names or ()}
        if self._config.override_range_calibration:
            values |= {name: getattr(self._config, field) for field, name in _RANGES.items()}
        return values

    def sources(self, reported: bytes) -> dict[str, str]:
        """Return where each entry that is used comes from: unit, a file's path, or parameter."""
        found = dict.fromkeys(wire.CALIBRATION.names or (), UNIT)
        if self.file is not None and self.file.matches(reported):
            found |= dict.fromkeys(self.file.correction, self.file.path)
        found |= dict.fromkeys(self._replaced.values(), PARAMETER)
        if self._config.override_range_calibration:
            found |= dict.fromkeys(_RANGES.values(), PARAMETER)
        return found
