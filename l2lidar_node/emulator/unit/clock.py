"""The unit's own clock: about half speed, drifting, set by commands, 0 at every boot."""

from __future__ import annotations

import math
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.config import CrystalConfig
from l2lidar_node.types import DeviceNs

_NS = 1_000_000_000
_KEEP_NS = 10 * _NS  # no packet is stamped later than that after the instant it carries


class Epoch(NamedTuple):
    """From the true instant ``start_ns`` on, the clock counts from ``value_ns``."""

    start_ns: int
    value_ns: int


class UnitClock:
    """Tells what the unit's clock shows at a true instant.

    Parameters
    ----------
    config : CrystalConfig
        Rate of the clock.
    power_on_ns : int
        True instant of the first power-on; drift counts from here, also over later restarts.

    Notes
    -----
    Within an epoch the clock shows ``value + E(t) - E(start)`` truncated to whole nanoseconds,
    E being the closed integral of the rate (see :class:`CrystalConfig`): no error accumulates.
    """

    def __init__(self, config: CrystalConfig, power_on_ns: int) -> None:
        self._config = config
        self._origin_ns = power_on_ns
        self._drifts = bool(config.clock_drift_ppm_per_h or config.clock_wave_ppm)
        self._arrange([Epoch(power_on_ns, 0)])

    def set(self, now_ns: int, value_ns: int) -> None:
        """Make the clock show a value from a true instant on; instants must not decrease."""
        epochs = [*self._epochs, Epoch(now_ns, value_ns)]
        ends_ns = (epoch.start_ns for epoch in epochs[1:])
        recent = [end_ns > now_ns - _KEEP_NS for end_ns in ends_ns]
        self._arrange([*compress(epochs, recent), epochs[-1]])

    def _arrange(self, epochs: list[Epoch]) -> None:
        """Keep epochs, and what is needed of them again and again as arrays."""
        self._epochs = epochs
        self._starts_ns = np.array([epoch.start_ns for epoch in epochs], dtype=np.int64)
        self._values_ns = np.array([epoch.value_ns for epoch in epochs], dtype=np.int64)
        self._begun = self._elapsed(self._starts_ns)

    def step(self, now_ns: int, change_ns: int) -> None:
        """Move the clock by some nanoseconds of its own at a true instant, not below 0."""
        self.set(now_ns, max(0, self.at(now_ns) + change_ns))

    def at(self, now_ns: int) -> DeviceNs:
        """Return what the clock shows at a true instant."""
        return DeviceNs(int(self.stamps(np.array([now_ns], dtype=np.int64))[0]))

    def stamps(self, instants_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return what the clock shows at true instants.

        Parameters
        ----------
        instants_ns : ndarray, shape (N,), dtype int64
            Each is attributed to the epoch it lies in, so an instant before the last set still
            shows the clock as it was.

        Returns
        -------
        ndarray, shape (N,), dtype int64
            Nanoseconds of the unit's clock.
        """
        epoch = np.maximum(np.searchsorted(self._starts_ns, instants_ns, side="right") - 1, 0)
        elapsed = self._elapsed(instants_ns) - self._begun[epoch]
        shown = self._values_ns[epoch] + np.floor(elapsed).astype(np.int64)
        return np.asarray(shown, dtype=np.int64)

    def _elapsed(self, instants_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the integral of the rate from power-on [ns], exact to 2 ns over a month."""
        config = self._config
        t = (instants_ns - self._origin_ns).astype(np.float64)
        if not self._drifts:
            return np.asarray(t / config.clock_ratio)
        seconds = t / _NS
        angular = 2.0 * math.pi / config.clock_wave_s
        ppm_seconds = (
            0.5 * config.clock_drift_ppm_per_h / 3600.0 * seconds** 2
            + config.clock_wave_ppm / angular * (1.0 - np.cos(angular * seconds))
        )
        return np.asarray((t + ppm_seconds * 1e-6 * _NS) / config.clock_ratio)
