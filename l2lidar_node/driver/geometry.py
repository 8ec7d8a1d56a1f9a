"""Geometry: point packets to POINT records, vectorized over a batch, in double precision.

The model is the one of Unitree's BSD-3 header for a 3D packet's slot j::

    D     = range_scale (raw_j + range_bias)
    alpha = angle_min + alpha_angle_bias + j angle_increment
    theta = com_horizontal_angle_start + theta_angle_bias + j com_horizontal_angle_step
    A     = (-cos(beta) sin(xi) + sin(beta) cos(xi) sin(alpha)) D + b_axis_dist
    B     = cos(alpha) cos(xi) D
    x     = cos(theta) A - sin(theta) B
    y     = sin(theta) A + cos(theta) B
    z     = (sin(beta) sin(xi) + cos(beta) cos(xi) sin(alpha)) D + a_axis_dist

The vendor's client accumulates the angles in float32 and is off by up to 0.4 mm at 5 m; this is
not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.protocol import wire
from l2lidar_node.records import joined, selected
from l2lidar_node.types import F64, POINT

_TAYLOR_LIMIT_RAD: Final = 2e-3  # third-order remainder below 2e-9, 0.1 um at 50 m
_BLOCK_SLOTS: Final = 19_200  # projected at once: 64 3D packets, whose work arrays fit the cache
_CALIBRATION: Final = np.arange(52, 84, 4) // 4  # words of a payload, the same in 3D and 2D
_LIMITS_3D: Final = np.arange(96, 112, 4) // 4  # range_min, range_max, angle_min, angle_increment
_LIMITS_2D: Final = np.arange(88, 104, 4) // 4


class RangeCalibration(NamedTuple):
    """Replaces the unit's own range calibration: D = scale (raw + bias)."""

    scale: float  # [m per count]
    bias: float  # [counts]


class RangeLimits(NamedTuple):
    """Inclusive range limits of the user [m], in force besides the packet's own."""

    lo: float = 0.0
    hi: float = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class PointBatch:
    """Points of a batch of packets.

    Attributes
    ----------
    points : ndarray, shape (N,), dtype POINT
        In the order of packets and slots; ``time`` is relative to the first one.
    first_s : float
        Time of the first point on the time line of the packet starts; 0 without points.
    counts : ndarray, shape (P,), int
        Points of each packet.
    left_out : int
        Points that are missing because the rotation of their packet is not known.
    """

    points: NDArray[np.void]
    first_s: float
    counts: NDArray[np.intp]
    left_out: int


class _Table(NamedTuple):
    """Values common to all packets of one calibration; arrays over slots, shape (n,)."""

    alpha: F64  # [rad]
    j: F64  # from the middle slot
    j_complex: NDArray[np.complex128]  # the same
    uv: NDArray[np.complex128]  # multiplies D, radial + i tangential
    w: F64  # multiplies D on z
    a: float
    b: float
    theta_bias: float
    scale: float
    bias: float
    lo: float
    hi: float


class _Work(NamedTuple):
    """Work arrays over the packets and slots of a block."""

    grid: NDArray[np.void]  # dtype POINT
    keep: NDArray[np.bool_]
    distance: F64
    position: F64
    lines: F64  # shape (P, 2, n): positions are lines over the distance, slope and offset


class Projector:
    """Turns batches of packets of one type into points.

    Its work arrays are kept from batch to batch, since fresh memory for them would cost more than
    the arithmetic; the points it returns are always new memory.

    Parameters
    ----------
    packet_type : int
        ``POINTS_3D``, or ``POINTS_2D`` whose points lie in the plane x = 0.
    """

    def __init__(self, packet_type: int) -> None:
        self._layout = wire.PAYLOADS[packet_type]
        self._is_3d = packet_type == wire.PacketType.POINTS_3D
        limits = _LIMITS_3D if self._is_3d else _LIMITS_2D
        self._constants = np.concatenate((_CALIBRATION, limits))
        self._slots = slots = self._layout["ranges"].shape[0]
        self._block = size = _BLOCK_SLOTS // slots
        self._work = _Work(
            grid=np.empty((size, slots), POINT),
            keep=np.empty((size, slots), np.bool_),
            distance=np.empty((size, slots)),
            position=np.empty((size, slots)),
            lines=np.empty((size, 2, slots)),
        )

    def points(
        self,
        payloads: Sequence[bytes],
        start_s: F64,
        limits: RangeLimits | None = None,
        override: RangeCalibration | None = None,
        rotations: F64 | None = None,
        used: Callable[[bytes], bytes] | None = None,
    ) -> PointBatch:
        """Return the points of a batch of packets.

        Parameters
        ----------
        payloads : sequence of bytes, length P
            Payloads of this projector's type, checked by
            :func:`l2lidar_node.protocol.packets.decode`.
        start_s : ndarray, shape (P,), float64
            Instant of each packet's first slot [s] on any time line near 0, ascending.
        limits : RangeLimits, optional
        override : RangeCalibration, optional
            Replaces scale and bias of every packet.
        rotations : ndarray, shape (P, 3, 3), float64, optional
            From the cloud frame to that of the points, for each packet; where it is not known,
            NaN, and the packet's points are left out. The cloud frame if not given.
        used : callable, optional
            Returns the calibration block to use for a reported one, both 32 bytes.

        Returns
        -------
        PointBatch
            Points with a return whose range is within both the packet's and the user's limits.
        """
        raw = np.frombuffer(b"".join(payloads), self._layout)
        parts: list[NDArray[np.void]] = []
        counts = np.empty(len(raw), np.intp)
        left_out = 0
        first_s: float | None = None
        for block, constants in self._blocks(raw):
            packets, starts = raw[block], start_s[block]
            if used is not None:
                size = wire.CALIBRATION.itemsize
                constants = used(constants[:size]) + constants[size:]
            table = _table(constants, self._slots)
            work = _Work._make(array[: len(packets)] for array in self._work)
            _fill_ranges(packets, table, limits or RangeLimits(), override, work)
            if rotations is not None:
                left_out += _leave_out(np.isnan(rotations[block, 0, 0]), work.keep)
            counts[block] = np.count_nonzero(work.keep, axis=1)
            first = int(work.keep.argmax())
            if not work.keep.flat[first]:
                continue
            place = _place_3d if self._is_3d else _place_2d
            weights, basis = place(packets, table)
            if rotations is not None:
                weights = rotations[block] @ weights
            _fill_positions(weights, basis, work)
            increment = packets["time_increment"].astype(np.float64)
            if first_s is None:
                packet, slot = divmod(first, self._slots)
                first_s = float(starts[packet] + slot * increment[packet])
            _fill_times(starts - first_s, increment, work)
            parts.append(selected(work.grid.reshape(-1), work.keep.reshape(-1)))
        points = parts[0] if len(parts) == 1 else joined([np.empty(0, POINT), *parts])
        return PointBatch(points, first_s or 0.0, counts, left_out)

    def _blocks(self, raw: NDArray[np.void]) -> Iterator[tuple[slice, bytes]]:
        """Yield packets that can be projected at once and their calibration and limits.

        These are the same to the bit and the steps of the head's angle nearly so.
        """
        words = raw.view(np.uint32).reshape(len(raw), -1)[:, self._constants]
        changed = (words[1:] != words[:-1]).any(axis=1)
        for begin, end in pairwise([0, *(np.flatnonzero(changed) + 1).tolist(), len(raw)]):
            constants = words[begin].tobytes()
            for lo in range(begin, end, self._block):
                block = slice(lo, min(lo + self._block, end))
                if not self._is_3d or _is_even(raw["com_horizontal_angle_step"][block]):
                    yield block, constants
                else:
                    yield from ((slice(i, i + 1), constants) for i in range(lo, block.stop))


def _is_even(step: NDArray[np.float32]) -> bool:
    """Tell whether the Taylor series of :func:`_place_3d` holds for these steps."""
    spread = float(step.max()) - float(step.min())
    return spread * wire.POINTS_PER_3D_PACKET / 2 <= _TAYLOR_LIMIT_RAD


@lru_cache(maxsize=16)
def _table(constants: bytes, count: int) -> _Table:
    """Return the table of a calibration: 32 bytes of it and 16 of limits and angles."""
    calibration = np.frombuffer(constants, wire.CALIBRATION, 1)[0].astype(
        [(name, "f8") for name in wire.CALIBRATION.names or ()]
    )
    range_min, range_max, angle_min, increment = np.frombuffer(
        constants, "<f4", 4, wire.CALIBRATION.itemsize
    ).astype(np.float64)
    alpha = angle_min + calibration["alpha_angle_bias"] + np.arange(count) * increment
    j: F64 = np.arange(count, dtype=np.float64) - (count - 1) / 2
    cos_beta, sin_beta = np.cos(calibration["beta_angle"]), np.sin(calibration["beta_angle"])
    cos_xi, sin_xi = np.cos(calibration["xi_angle"]), np.sin(calibration["xi_angle"])
    return _Table(
        alpha=alpha,
        j=j,
        j_complex=j.astype(np.complex128),
        uv=(-cos_beta * sin_xi + sin_beta * cos_xi * np.sin(alpha))
        + 1j * (np.cos(alpha) * cos_xi),
        w=sin_beta * sin_xi + cos_beta * cos_xi * np.sin(alpha),
        a=float(calibration["a_axis_dist"]),
        b=float(calibration["b_axis_dist"]),
        theta_bias=float(calibration["theta_angle_bias"]),
        scale=float(calibration["range_scale"]),
        bias=float(calibration["range_bias"]),
        lo=float(range_min),
        hi=float(range_max),
    )


def _fill_ranges(
    raw: NDArray[np.void],
    table: _Table,
    limits: RangeLimits,
    override: RangeCalibration | None,
    work: _Work,
) -> None:
    """Fill the calibrated ranges, the intensities and which slots are kept."""
    scale, bias = override or (table.scale, table.bias)
    counts, used = raw["ranges"], raw["point_num"]
    distance, keep = work.distance, work.keep
    np.multiply(counts, scale, out=distance)
    distance += scale * bias
    work.grid["range"] = distance
    work.grid["intensity"] = raw["intensities"]
    np.greater_equal(distance, max(table.lo, limits.lo), out=keep)
    keep &= distance <= min(table.hi, limits.hi)
    keep &= counts > 0
    if (used < counts.shape[1]).any():
        keep &= np.arange(counts.shape[1]) < used[:, None]


def _leave_out(unknown: NDArray[np.bool_], keep: NDArray[np.bool_]) -> int:
    """Keep no point of some packets; return how many those were."""
    if not unknown.any():
        return 0
    left_out = int(np.count_nonzero(keep[unknown]))
    keep[unknown] = False
    return left_out


def _place_2d(raw: NDArray[np.void], table: _Table) -> tuple[F64, F64]:
    """Return weights and basis of 2D packets, see :func:`_fill_positions`."""
    basis = np.zeros((2, 2, len(table.alpha)))
    basis[0, 0] = np.cos(table.alpha)
    basis[1, 0] = np.sin(table.alpha)
    basis[1, 1] = table.a
    weights = np.zeros((len(raw), 3, 2))
    weights[:, 1, 0] = weights[:, 2, 1] = 1.0
    return weights, basis


def _place_3d(raw: NDArray[np.void], table: _Table) -> tuple[F64, F64]:
    """Return weights and basis of 3D packets, see :func:`_fill_positions`.

    The head angle of slot j is split into the packet's mid angle, j times the mean step of all
    packets (the basis) and j times what the packet's own step differs from it, whose rotation is a
    short Taylor series. So there is no sine per point. Complex numbers stand for (x, y).
    """
    step = raw["com_horizontal_angle_step"].astype(np.float64)
    start = raw["com_horizontal_angle_start"].astype(np.float64) + table.theta_bias
    middle = (len(table.j) - 1) / 2
    mean = float(step.mean())
    delta = step - mean

    series = np.empty((3, 2, len(table.j)), np.complex128)
    np.exp(1j * mean * table.j, out=series[0, 1])
    np.multiply(table.uv, series[0, 1], out=series[0, 0])
    series[0, 1] *= table.b
    np.multiply(series[0], table.j_complex, out=series[1])
    np.multiply(series[1], table.j_complex, out=series[2])
    basis = np.empty((7, 2, len(table.j)))
    basis[:3], basis[3:6] = series.real, series.imag
    basis[6, 0], basis[6, 1] = table.w, table.a

    turn = np.empty((len(raw), 3), np.complex128)
    turn[:, 0] = np.exp(1j * (start + step * middle))
    turn[:, 1] = turn[:, 0] * (1j * delta)
    turn[:, 2] = turn[:, 1] * (0.5j * delta)
    weights = np.zeros((len(raw), 3, 7))
    weights[:, 0, :3], weights[:, 0, 3:6] = turn.real, -turn.imag
    weights[:, 1, :3], weights[:, 1, 3:6] = turn.imag, turn.real
    weights[:, 2, 6] = 1.0
    return weights, basis


def _fill_positions(weights: F64, basis: F64, work: _Work) -> None:
    """Fill x, y and z.

    Each is a line over the distance: its slopes and offsets over the slots, shape (2, n), are a
    weighted sum of those in ``basis``, shape (K, 2, n). A packet has three rows of ``weights``,
    shape (P, 3, K), one per axis; to rotate a packet is to rotate these.
    """
    basis = basis.reshape(len(basis), -1)
    for axis, name in enumerate(("x", "y", "z")):
        np.matmul(weights[:, axis], basis, out=work.lines.reshape(len(weights), -1))
        np.multiply(work.lines[:, 0], work.distance, out=work.position)
        np.add(work.position, work.lines[:, 1], out=work.position)
        work.grid[name] = work.position


def _fill_times(start_s: F64, increment: F64, work: _Work) -> None:
    slots = np.arange(work.position.shape[1], dtype=np.float64)
    np.multiply.outer(increment, slots, out=work.position)
    np.add(work.position, start_s[:, None], out=work.position)
    work.grid["time"] = work.position
