"""Turns the head: angle of each packet with the measured wobble, and the state block."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.emulator.rng import Stream, generator
from l2lidar_node.emulator.unit.units import Unit

# measured on a real unit: advance from packet to packet has a once-per-turn sinusoid and a rest
ADVANCE_WAVE_RAD: Final = np.deg2rad(0.20)
ADVANCE_REST_RAD: Final = np.deg2rad(0.087)
PERIOD_JITTER: Final = 1e-3

_TURN = 2.0 * np.pi


def mean_angle(t_s: NDArray[np.float64], unit: Unit, seed: int) -> NDArray[np.float64]:
    """Return the head's angle without wobble [rad], not wrapped; the seed says where it starts."""
    start = generator(seed, Stream.HEAD, 0).uniform(0.0, _TURN)
    return np.asarray(start + _TURN / unit.head_period_s * t_s)


def set_angles(
    packets: NDArray[np.void],
    times: NDArray[np.float64],
    unit: Unit,
    wobble: float,
    seed: int,
    first: int,
) -> None:
    """Fill in the head's angle at slot 0 and its step per slot.

    The step is that of the reported head period, as on real units, where it does not follow the
    wobble.

    Parameters
    ----------
    packets : ndarray, shape (P,), dtype wire.POINTS_3D_PAYLOAD
        ``state`` and ``time_increment`` are filled in already.
    times : ndarray, shape (P,)
        Instants of slot 0 [s].
    wobble : float
        1 = as measured, 0 = the head turns evenly.
    """
    mean = mean_angle(times, unit, seed)
    advance = _TURN * unit.packet_period_s / unit.head_period_s
    wave = ADVANCE_WAVE_RAD / (2.0 * np.sin(advance / 2.0)) * np.sin(mean)
    rest = ADVANCE_REST_RAD / np.sqrt(2.0) * _per_packet(seed, Stream.HEAD, first, len(packets))
    angle = np.mod(mean + wobble * (wave + rest), _TURN).astype(np.float32)
    # rounding to float32 may reach a full turn
    packets["com_horizontal_angle_start"] = np.where(angle < np.float32(_TURN), angle, 0.0)
    turn_s = packets["state"]["com_rotation_period"] * 1e-6
    packets["com_horizontal_angle_step"] = (
        _TURN * packets["time_increment"].astype(np.float64) / turn_s
    )


def set_state(
    packets: NDArray[np.void],
    numbers: NDArray[np.int64],
    times: NDArray[np.float64],
    unit: Unit,
    seed: int,
) -> None:
    """Fill in the state block: periods as measured, slowly warming up, voltages with a ripple."""
    state = packets["state"]
    ripple = _per_packet(seed, Stream.STATE, int(numbers[0]) if len(numbers) else 0, len(packets))
    warm = 1.0 - np.exp(-np.maximum(times, 0.0) / 600.0)
    state["sys_rotation_period"] = unit.mirror_period_us
    jitter = np.clip(PERIOD_JITTER * ripple, -3.0 * PERIOD_JITTER, 3.0 * PERIOD_JITTER)
    state["com_rotation_period"] = np.round(unit.head_period_s * 1e6 * (1.0 + jitter))
    state["apd_temperature"] = np.round(36.0 + 8.0 * warm + 0.02 * ripple, 1)
    state["imu_temperature"] = np.round(48.0 + 13.0 * warm + 0.02 * ripple, 1)
    state["apd_voltage"] = 154.16 + 0.6 * (warm - 1.0) + 0.02 * ripple
    state["laser_voltage"] = 51.38 + 0.01 * ripple


def _per_packet(seed: int, stream: Stream, first: int, count: int) -> NDArray[np.float64]:
    """Return one standard normal number per packet, shape (count,)."""
    # number 0 of the head's stream is the starting angle
    return np.array(
        [generator(seed, stream, k + 1).standard_normal() for k in range(first, first + count)]
    )
