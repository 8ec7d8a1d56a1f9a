"""Geometry: point packets to POINT records, vectorized over a batch.

The model is the one of Unitree's BSD-3 header for a 3D packet's slot j::

    D     = range_scale (raw_j + range_bias)
    alpha = angle_min + alpha_angle_bias + j angle_increment
    theta = com_horizontal_angle_start + theta_angle_bias + j com_horizontal_angle_step
    A     = (-cos(beta) sin(xi) + sin(beta) cos(xi) sin(alpha)) D + b_axis_dist
    B     = cos(alpha) cos(xi) D
    x     = cos(theta) A - sin(theta) B
    y     = sin(theta) A + cos(theta) B
    z     = (sin(beta) sin(xi) + cos(beta) cos(xi) sin(alpha)) D + a_axis_dist

Angles and all that is common to many points are in double precision. What is done for each point
is in single precision like the result, which is off by up to 2.5e-7 of the distance. The vendor's
client accumulates the angles in single precision and is off by up to 0.4 mm at 5 m.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.protocol import wire
from l2lidar_node.records import joined, selected
from l2lidar_node.types import F32, F64, POINT

_TAYLOR_LIMIT_RAD: Final = 2e-3  # third-order remainder below 2e-9, 0.1 um at 50 m
_BLOCK_SLOTS: Final = 19_200  # projected at once: 64 3D packets, whose work arrays fit the cache
_STEP_RAD: Final = 1e-6  # the head's step per slot is rounded to this, to be the same for long


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
    kept : ndarray, shape (P, n), bool
        Which slots of each packet have a point.
    left_out : int
        Points that are missing because the rotation of their packet is not known.
    """

    points: NDArray[np.void]
    first_s: float
    kept: NDArray[np.bool_]
    left_out: int

    @property
    def counts(self) -> NDArray[np.intp]:
        """Points of each packet; shape (P,)."""
        counts: NDArray[np.intp] = np.count_nonzero(self.kept, axis=1)
        return counts


class _Table(NamedTuple):
    """Values common to all packets with the same constants; arrays over slots, shape (n,)."""

    alpha: F64  # [rad]
    j: F64  # from the middle slot
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
    within: NDArray[np.bool_]  # one of the limits
    distance: F32
    position: F32
    lines: F32  # shape (P, 2, n): positions are lines over the distance, slope and offset
    precise: F64


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
        self._constants = _constants(self._layout)
        self._slots = slots = self._layout["ranges"].shape[0]
        self._block = size = _BLOCK_SLOTS // slots
        self._work = _Work(
            grid=np.empty((size, slots), POINT),
            within=np.empty((size, slots), np.bool_),
            distance=np.empty((size, slots), np.float32),
            position=np.empty((size, slots), np.float32),
            lines=np.empty((size, 2, slots), np.float32),
            precise=np.empty((size, slots)),
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
        kept = np.empty((len(raw), self._slots), np.bool_)
        parts: list[NDArray[np.void]] = []
        left_out = 0
        first_s: float | None = None
        for block, constants in self._blocks(payloads, raw):
            packets, starts, keep = raw[block], start_s[block], kept[block]
            if used is not None:
                size = wire.CALIBRATION.itemsize
                constants = used(constants[:size]) + constants[size:]
            table = _table(constants, self._slots)
            work = _Work._make(array[: len(packets)] for array in self._work)
            _fill_ranges(packets, table, limits or RangeLimits(), override, work, keep)
            if rotations is not None:
                left_out += _leave_out(np.isnan(rotations[block, 0, 0]), keep)
            first = int(keep.argmax())
            if not keep.flat[first]:
                continue
            place = _place_3d if self._is_3d else _place_2d
            weights, basis = place(packets, table, constants)
            if rotations is not None:
                weights = rotations[block] @ weights
            _fill_positions(weights.astype(np.float32), basis, work)
            increment = packets["time_increment"].astype(np.float64)
            if first_s is None:
                packet, slot = divmod(first, self._slots)
                first_s = float(starts[packet] + slot * increment[packet])
            _fill_times(starts - first_s, increment, work)
            parts.append(selected(work.grid.reshape(-1), keep.reshape(-1)))
        points = parts[0] if len(parts) == 1 else joined([np.empty(0, POINT), *parts])
        return PointBatch(points, first_s or 0.0, kept, left_out)

    def _blocks(
        self, payloads: Sequence[bytes], raw: NDArray[np.void]
    ) -> Iterator[tuple[slice, bytes]]:
        """Yield packets that can be projected at once, and their constants.

        These are the same to the bit and the steps of the head's angle nearly so.
        """
        calibration, limits = self._constants
        end = 0
        for constants, group in groupby(data[calibration] + data[limits] for data in payloads):
            begin, end = end, end + sum(1 for _ in group)
            for lo in range(begin, end, self._block):
                block = slice(lo, min(lo + self._block, end))
                if not self._is_3d or _is_even(raw["com_horizontal_angle_step"][block].tolist()):
                    yield block, constants
                else:
                    yield from ((slice(i, i + 1), constants) for i in range(lo, block.stop))


def _constants(layout: np.dtype[np.void]) -> tuple[slice, slice]:
    """Return where a payload has its calibration, and its limits and angles."""
    fields = layout.fields
    assert fields is not None
    calibration, limits = fields["calibration"][1], fields["range_min"][1]
    return (
        slice(calibration, calibration + wire.CALIBRATION.itemsize),
        slice(limits, limits + 16),  # range_min, range_max, angle_min, angle_increment
    )


def _is_even(steps: list[float]) -> bool:
    """Tell whether the Taylor series of :func:`_place_3d` holds for these steps."""
    spread = max(steps) - min(steps) + _STEP_RAD
    return spread * wire.POINTS_PER_3D_PACKET / 2 <= _TAYLOR_LIMIT_RAD


@lru_cache(maxsize=16)
def _table(constants: bytes, count: int) -> _Table:
    """Return the table of a block: calibration, and limits and angles."""
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
    keep: NDArray[np.bool_],
) -> None:
    """Fill the calibrated ranges, the intensities and which slots are kept."""
    scale, bias = override or (table.scale, table.bias)
    counts, used = raw["ranges"], raw["point_num"]
    distance, within = work.distance, work.within
    np.multiply(counts, scale, out=work.precise)
    np.add(work.precise, scale * bias, out=distance, casting="same_kind")
    work.grid["range"] = distance
    work.grid["intensity"] = raw["intensities"]
    np.greater_equal(distance, np.float32(max(table.lo, limits.lo)), out=keep)
    np.less_equal(distance, np.float32(min(table.hi, limits.hi)), out=within)
    np.logical_and(keep, within, out=keep)
    np.not_equal(counts, 0, out=within)
    np.logical_and(keep, within, out=keep)
    if used.min() < counts.shape[1]:
        keep &= np.arange(counts.shape[1]) < used[:, None]


def _leave_out(unknown: NDArray[np.bool_], keep: NDArray[np.bool_]) -> int:
    """Keep no point of some packets; return how many those were."""
    if not unknown.any():
        return 0
    left_out = int(np.count_nonzero(keep[unknown]))
    keep[unknown] = False
    return left_out


def _place_2d(raw: NDArray[np.void], table: _Table, constants: bytes) -> tuple[F64, F32]:
    """Return weights and basis of 2D packets, see :func:`_fill_positions`."""
    weights = np.zeros((len(raw), 3, 2))
    weights[:, 1, 0] = weights[:, 2, 1] = 1.0
    return weights, _basis_2d(constants, len(table.j))


@lru_cache(maxsize=16)
def _basis_2d(constants: bytes, slots: int) -> F32:
    table = _table(constants, slots)
    basis = np.zeros((2, 2, slots), np.float32)
    basis[0, 0] = np.cos(table.alpha)
    basis[1, 0] = np.sin(table.alpha)
    basis[1, 1] = table.a
    return basis


def _place_3d(raw: NDArray[np.void], table: _Table, constants: bytes) -> tuple[F64, F32]:
    """Return weights and basis of 3D packets, see :func:`_fill_positions`.

    The head angle of slot j is split into the packet's mid angle, j times a step that all packets
    have nearly (the basis) and j times what the packet's own step differs from it, whose rotation
    is a short Taylor series. So there is no sine per point. Complex numbers stand for (x, y).
    """
    step = raw["com_horizontal_angle_step"].astype(np.float64)
    start = raw["com_horizontal_angle_start"].astype(np.float64) + table.theta_bias
    common = round(float(step[0]) / _STEP_RAD)
    delta = step - common * _STEP_RAD
    middle = start + step * ((len(table.j) - 1) / 2)
    cos, sin = np.cos(middle), np.sin(middle)
    weights = np.zeros((len(raw), 3, 7))
    for order in range(3):
        weights[:, 0, order] = weights[:, 1, order + 3] = cos
        weights[:, 1, order] = sin
        weights[:, 0, order + 3] = -sin
        factor = delta / (order + 1)
        cos, sin = -factor * sin, factor * cos  # the derivative
    weights[:, 2, 6] = 1.0
    return weights, _basis_3d(constants, len(table.j), common)


@lru_cache(maxsize=16)
def _basis_3d(constants: bytes, slots: int, common: int) -> F32:
    """Return the basis of 3D packets for a step of the head in multiples of ``_STEP_RAD``."""
    table = _table(constants, slots)
    series = np.empty((3, 2, slots), np.complex128)
    np.exp(1j * common * _STEP_RAD * table.j, out=series[0, 1])
    np.multiply(table.uv, series[0, 1], out=series[0, 0])
    series[0, 1] *= table.b
    np.multiply(series[0], table.j, out=series[1])
    np.multiply(series[1], table.j, out=series[2])
    basis = np.empty((7, 2, slots), np.float32)
    basis[:3], basis[3:6] = series.real, series.imag
    basis[6, 0], basis[6, 1] = table.w, table.a
    return basis


def _fill_positions(weights: F32, basis: F32, work: _Work) -> None:
    """Fill x, y and z.

    Each is a line over the distance: its slopes and offsets over the slots, shape (2, n), are a
    weighted sum of those in ``basis``, shape (K, 2, n). A packet has three rows of ``weights``,
    shape (P, 3, K), one per axis; to rotate a packet is to rotate these.
    """
    basis = basis.reshape(len(basis), -1)
    for axis, name in enumerate(("x", "y", "z")):
        np.matmul(weights[:, axis], basis, out=work.lines.reshape(len(weights), -1))
        np.multiply(work.lines[:, 0], work.distance, out=work.position)
        np.add(work.position, work.lines[:, 1], out=work.grid[name])


def _fill_times(start_s: F64, increment: F64, work: _Work) -> None:
    slots = work.precise.shape[1]
    np.matmul(np.stack((start_s, increment), axis=1), _powers(slots), out=work.precise)
    work.grid["time"] = work.precise


@lru_cache(maxsize=4)
def _powers(slots: int) -> F64:
    """Return the powers 0 and 1 of the numbers of the slots; shape (2, n)."""
    return np.stack((np.ones(slots), np.arange(slots, dtype=np.float64)))
