"""What a carrier leaves of the sensor's view: sectors, cones, and the carrier's own body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.world.scene import Triangles, box, cone, ellipsoid
from l2lidar_node.types import F64


@dataclass(frozen=True, slots=True)
class View:
    """A window: nothing comes back from directions outside it.

    Attributes
    ----------
    sector : float
        Width in azimuth [rad], cloud frame; 2 pi = no limit.
    towards : float
        Azimuth of its middle [rad].
    cone : float
        Full opening angle of a cone around ``axis`` [rad]; 2 pi = no limit.
    axis : tuple of float
        Unit, cloud frame.
    """

    sector: float = 2.0 * np.pi
    towards: float = 0.0
    cone: float = 2.0 * np.pi
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @property
    def whole(self) -> bool:
        """Whether nothing is hidden."""
        return self.sector >= 2.0 * np.pi and self.cone >= 2.0 * np.pi

    def sees(self, directions: F64) -> NDArray[np.bool_]:
        """Return which unit directions (..., 3), cloud frame, are within the window."""
        azimuth = np.arctan2(directions[..., 1], directions[..., 0]) - self.towards
        off = np.abs(np.mod(azimuth + np.pi, 2.0 * np.pi) - np.pi)
        within = off <= self.sector / 2.0
        if self.cone < 2.0 * np.pi:
            within &= directions @ np.asarray(self.axis) >= np.cos(self.cone / 2.0)
        return np.asarray(within)


def _quadruped() -> Triangles:
    """Return a four-legged robot, the sensor on its head end: trunk behind and below, legs."""
    parts = [
        box((-0.62, -0.16, -0.20), (-0.06, 0.16, -0.06)),
        box((-0.34, -0.10, -0.06), (-0.18, 0.10, 0.10)),  # a computer on its back
        cone((-0.42, 0.05, -0.06), 0.006, 0.006, 0.42, 6),  # an antenna
    ]
    for x in (-0.58, -0.10):
        for y in (-0.2, 0.2):
            parts += [
                box((x - 0.05, y - 0.04, -0.34), (x + 0.05, y + 0.04, -0.1)),
                cone((x - 0.02, y, -0.56), 0.022, 0.03, 0.24, 8),
            ]
    return np.concatenate(parts)


def _backpack() -> Triangles:
    """Return a person who carries the sensor on a pole behind and above the head."""
    return np.concatenate(
        [
            ellipsoid((0.32, 0.0, -0.28), (0.10, 0.085, 0.13)),
            ellipsoid((0.30, 0.0, -0.72), (0.15, 0.26, 0.34)),
            box((0.05, -0.14, -0.85), (0.2, 0.14, -0.4)),
            cone((0.0, 0.0, -0.6), 0.015, 0.015, 0.55, 8),
        ]
    )


def _drone() -> Triangles:
    """Return a quadrotor with the sensor below: arms, rotors as discs, skids on both sides."""
    parts = [box((-0.12, -0.12, -0.16), (0.12, 0.12, -0.07))]
    for sx in (-1.0, 1.0):
        for sy in (-1.0, 1.0):
            parts.append(cone((0.28 * sx, 0.28 * sy, -0.12), 0.13, 0.13, 0.012, 12))
            parts.append(cone((0.28 * sx, 0.28 * sy, -0.15), 0.025, 0.02, 0.05, 8))
    for y in (-0.16, 0.16):
        parts.append(box((-0.2, y - 0.01, 0.16), (0.2, y + 0.01, 0.18)))
        for x in (-0.12, 0.12):
            parts.append(cone((x, y, -0.07), 0.008, 0.008, 0.24, 6))
    return np.concatenate(parts)


CARRIERS: Final[dict[str, Callable[[], Triangles]]] = {
    "quadruped": _quadruped,
    "backpack": _backpack,
    "drone": _drone,
}
"""Bodies around the sensor by name; triangles in the cloud frame of an upright mount [m]."""


def carrier(name: str) -> Triangles:
    """Return a carrier's body, shape (T, 3, 3).

    Raises
    ------
    ValueError
        For a name that is not known.
    """
    if name not in CARRIERS:
        raise ValueError(f"carrier '{name}' is not known, expected one of {', '.join(CARRIERS)}")
    return CARRIERS[name]()
