"""Describes individual L2 units: calibration, speeds of mirror and head, limits."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.unit.errors import UnitErrors, named
from l2lidar_node.protocol import wire


@dataclass(frozen=True, slots=True)
class Unit:
    """One unit as it left the factory.

    Attributes
    ----------
    name : str
    calibration : tuple of float
        What the unit reports, in the order of wire.CALIBRATION.
    mirror_period_us : int
        One turn of the fast mirror, so one 3D packet.
    head_period_s : float
        One turn of the head, on average.
    range_min, range_max : float
        What the packets state [m]; nothing outside is returned.
    errors : UnitErrors
        How the unit differs from what it reports.
    """

    name: str
    calibration: tuple[float, ...]
    mirror_period_us: int = 4639
    head_period_s: float = 0.229769
    range_min: float = 0.05
    range_max: float = 50.0
    errors: UnitErrors = field(default_factory=UnitErrors)

    @property
    def packet_period_s(self) -> float:
        """Time from one 3D packet's first slot to the next one's [s]."""
        return self.mirror_period_us * 1e-6

    @property
    def calibration_record(self) -> NDArray[np.void]:
        """The reported calibration block, shape (), dtype wire.CALIBRATION."""
        return np.array(self.calibration, dtype=wire.CALIBRATION)


_SHARED_AXES = (0.0445, 0.006586, 2.0769)  # a, b [m] and theta bias [rad]: the same on all units

UNITS: Final[dict[str, Unit]] = {
    unit.name: unit
    for unit in (
        Unit("a", (*_SHARED_AXES, 0.032398, 0.003818, 0.002945, -365.625, 0.000978)),
        Unit(
            "fast",
            (*_SHARED_AXES, 0.0395972, 0.015708, 0.00545415, -365.625, 0.000978),
            head_period_s=1 / 5.55,
        ),
    )
}
"""Known units: ``a`` turns its head at 4.35 Hz (49.5 packets a turn), ``fast`` at 5.55 Hz (38.8).

Calibrations as published for two units; the range constants of the second were not and are the
first one's.
"""


def unit(name: str, power_up: int = 0) -> Unit:
    """Return a unit by name: perfect (or a), fast, typical, poor, or the number of one.

    Parameters
    ----------
    name : str
    power_up : int
        How often it was switched on before; the phase of its mirror differs each time.

    Raises
    ------
    ValueError
        For a name that is not known.
    """
    if name in UNITS:
        return UNITS[name]
    found = named(name)
    if found.are_none:
        return UNITS["a"]
    number = int(name) if name.isdecimal() else 0
    return replace(UNITS["a"], name=name, errors=found.powered_up(number, power_up))
