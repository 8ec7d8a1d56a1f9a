"""Scanner: rotates the head, casts the rays of each slot, fills the packets.

A :class:`View` is what a carrier leaves of them: sectors, cones, and the carrier's own body.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.emulator.motion.motion import Motion
from l2lidar_node.emulator.rng import Stream, generator
from l2lidar_node.emulator.unit import returns
from l2lidar_node.emulator.unit.returns import RangeNoise
from l2lidar_node.emulator.unit.units import UNITS, RockingMotion, Unit
from l2lidar_node.emulator.world.scene import Triangles, box, cone, ellipsoid
from l2lidar_node.emulator.world.world import World
from l2lidar_node.protocol import wire
from l2lidar_node.types import F64


@dataclass(frozen=True, slots=True)
class View:
    """A field of view: there are no returns from outside it.

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


# measured on a real unit: advance from packet to packet has a once-per-turn sinusoid and a rest
ADVANCE_WAVE_RAD: Final = np.deg2rad(0.20)
ADVANCE_REST_RAD: Final = np.deg2rad(0.087)
PERIOD_JITTER: Final = 1e-3

_TURN = 2.0 * np.pi


def on_its_mount(motion: Motion, unit: Unit, seed: int) -> Motion:
    """Return the motion of a unit on a moving mount, which its spinning head may rock."""
    if not unit.errors.rocks:
        return motion
    rate = 2.0 * np.pi / unit.head_period_s
    bias = float(unit.calibration_record["theta_angle_bias"])
    start = float(mean_angle(np.zeros(1), unit, seed)[0]) + bias
    return RockingMotion(motion, unit.errors, start, rate)


def mean_angle(t_s: NDArray[np.float64], unit: Unit, seed: int) -> NDArray[np.float64]:
    """Return the head's angle without wobble [rad], unwrapped; the seed sets its start."""
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


RAY: Final = np.dtype(
    [
        ("time", "<f8"),  # [s] on the motion's time line
        ("origin", "<f8", (3,)),  # [m] world frame
        ("direction", "<f8", (3,)),  # unit, world frame
        (
            "distance",
            "<f8",
        ),  # [m] noise-free distance of the beam's center ray, inf = nothing there
        ("measured", "<f8"),  # [m] what the packet's raw count decodes to, 0 = no return
    ]
)
"""The truth about one slot; ``distance`` and ``measured`` are along ``direction``."""

TWO_D_PERIOD_S: Final = 0.02  # a 2D packet covers one turn of a mirror at 50 Hz
WIDE_MARGIN_RAD: Final = np.deg2rad(
    6.0
)  # wide field of view: this much below the horizon on both sides


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Consecutive packets and their truth.

    Attributes
    ----------
    first : int
        Number of the first packet.
    packets : ndarray, shape (P,), dtype wire.POINTS_3D_PAYLOAD or wire.POINTS_2D_PAYLOAD
        ``info`` holds only the payload size; sequence number and stamp are the device's business.
    times_s : ndarray, shape (P,)
        Instant of each packet's slot 0 [s] on the motion's time line.
    rays : ndarray, shape (P, N), dtype RAY
        N is 300, in 2D mode 1800.
    """

    first: int
    packets: NDArray[np.void]
    times_s: NDArray[np.float64]
    rays: NDArray[np.void]

    @property
    def returned(self) -> NDArray[np.bool_]:
        """Which slots carry a range, shape (P, N)."""
        return np.asarray(self.packets["ranges"] > 0)

    @property
    def hits(self) -> NDArray[np.float64]:
        """Noise-free points on the beams' axes, world frame [m], (P, N, 3), NaN for none."""
        return self._along("distance")

    @property
    def measured_points(self) -> NDArray[np.float64]:
        """The measured points at their true places, world frame [m], (P, N, 3), NaN for none.

        They contain range noise, mixed pixels and quantisation but no motion distortion: a
        deskewed cloud differs from them by the error of the deskewing alone.
        """
        return self._along("measured")

    def _along(self, name: str) -> NDArray[np.float64]:
        distance = self.rays[name]
        distance = np.where((distance > 0) & np.isfinite(distance), distance, np.nan)
        points: NDArray[np.float64] = (
            self.rays["origin"] + self.rays["direction"] * distance[..., None]
        )
        return points


class Scanner:
    """The rotating head, the mirror and the range finder.

    Packet k (k >= 0) starts at ``k * period_s`` on the motion's time line. A packet depends on the
    seed and its number alone, not on which packets are asked for together. Asking for 20 or more
    at a time is fastest (0.3 ms each, one by one 1 ms).

    Parameters
    ----------
    world : World
    motion : Motion
        Moves the cloud frame.
    unit : Unit
    noise : RangeNoise
        ``RangeNoise.clean()`` leaves the raw count's step (0.978 mm, so at most 0.489 mm of error)
        alone.
    seed : int
    view : View, optional
        What the carrier leaves of the view; slots that look elsewhere return nothing.
    """

    def __init__(
        self,
        world: World,
        motion: Motion,
        unit: Unit = UNITS["a"],
        noise: RangeNoise | None = None,
        seed: int = 0,
        view: View | None = None,
    ) -> None:
        self.world = world
        self.motion = motion
        self.unit = unit
        self.noise = RangeNoise() if noise is None else noise
        self.seed = seed
        self.view = View() if view is None else view

    @property
    def period_s(self) -> float:
        """Time between the starts of 3D packets [s]."""
        return self.unit.packet_period_s

    def packets(
        self, first: int, count: int, *, wide_fov: bool = False
    ) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        """Return ``scan(...).packets`` and ``scan(...).times_s``."""
        scan = self.scan(first, count, wide_fov=wide_fov)
        return scan.packets, scan.times_s

    def scan(self, first: int, count: int, *, wide_fov: bool = False) -> Scan:
        """Return 3D packets ``first`` to ``first + count - 1`` with the truth about them.

        Parameters
        ----------
        first, count : int
        wide_fov : bool
            192 degrees instead of 180.
        """
        packets = np.zeros(count, wire.POINTS_3D_PAYLOAD)
        numbers = np.arange(first, first + count)
        times = numbers.astype(np.float64) * self.period_s
        packets["info"]["payload_size"] = wire.POINTS_3D_PAYLOAD.itemsize
        self._describe(packets, numbers, times)
        packets["point_num"] = wire.POINTS_PER_3D_PACKET
        packets["scan_period"] = self.period_s
        _set_fan(packets, self.period_s, wide_fov)
        set_angles(packets, times, self.unit, self.noise.head_wobble, self.seed, first)
        return self._measure(first, packets, times)

    def scan_2d(self, first: int, count: int, *, wide_fov: bool = False) -> Scan:
        """Return 2D packets with the truth about them; packet k starts at ``k * TWO_D_PERIOD_S``.

        The field values of real 2D packets are not published. Here one packet is one arc of 1800
        slots, 0.1 degrees apart (wide: 0.1067), from a mirror turning at 50 Hz, in the cloud
        frame's y-z plane.
        """
        packets = np.zeros(count, wire.POINTS_2D_PAYLOAD)
        numbers = np.arange(first, first + count)
        times = numbers.astype(np.float64) * TWO_D_PERIOD_S
        packets["info"]["payload_size"] = wire.POINTS_2D_PAYLOAD.itemsize
        self._describe(packets, numbers, times)
        packets["state"]["sys_rotation_period"] = round(TWO_D_PERIOD_S * 1e6)
        packets["state"]["com_rotation_period"] = 0
        packets["point_num"] = wire.POINTS_PER_2D_PACKET
        packets["scan_period"] = TWO_D_PERIOD_S
        _set_fan(packets, TWO_D_PERIOD_S, wide_fov)
        return self._measure(first, packets, times)

    def _describe(
        self, packets: NDArray[np.void], numbers: NDArray[np.int64], times: NDArray[np.float64]
    ) -> None:
        """Fill in calibration, range limits and state."""
        packets["calibration"] = self.unit.calibration_record
        packets["range_min"] = self.unit.range_min
        packets["range_max"] = self.unit.range_max
        set_state(packets, numbers, times, self.unit, self.seed)

    def _measure(self, first: int, packets: NDArray[np.void], times: NDArray[np.float64]) -> Scan:
        """Cast the rays that the unit's true block describes and fill in the returns."""
        count, slots = packets["ranges"].shape
        true = self._true(packets)
        rays = np.zeros((count, slots), RAY)
        rays["time"] = times[:, None] + packets["time_increment"].astype(np.float64)[
            :, None
        ] * np.arange(slots)
        origin, direction = local_rays(true)
        position, quaternion = self.motion.poses(rays["time"].ravel())
        turn = rotations.matrices(quaternion)
        flat = rays.reshape(-1)
        flat["origin"] = position + np.einsum("nij,nj->ni", turn, origin.reshape(-1, 3))
        flat["direction"] = np.einsum("nij,nj->ni", turn, direction.reshape(-1, 3))
        returns.fill(true, rays, self.world, self.noise, self.seed, first, self.unit.errors)
        if true is not packets:
            for name in ("ranges", "intensities"):
                packets[name] = true[name]
        if not self.view.whole:
            hidden = ~self.view.sees(direction)
            for name in ("ranges", "intensities"):
                packets[name][hidden] = 0
            rays["measured"][hidden] = 0.0
        return Scan(first, packets, times, rays)

    def _true(self, packets: NDArray[np.void]) -> NDArray[np.void]:
        """Return the packets as a unit would send them that knew itself."""
        errors = self.unit.errors
        if errors.are_none:
            return packets
        true = packets.copy()
        true["calibration"] = errors.true_block(packets["calibration"])
        if packets.dtype == wire.POINTS_3D_PAYLOAD:
            angle = packets["com_horizontal_angle_start"].astype(np.float64)
            wave = errors.head_wave * np.sin(angle + packets["calibration"]["theta_angle_bias"])
            true["com_horizontal_angle_start"] = angle + wave
        return true


def local_rays(packets: NDArray[np.void]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return origins and unit directions (P, N, 3) of every slot in the cloud frame.

    The point of a range D is ``origin + D * direction``: the protocol's formula, which is affine
    in D, taken apart. Evaluated in double precision from the packets' float32 fields.
    """
    slots = np.arange(packets["ranges"].shape[1])
    c = {
        name: packets["calibration"][name].astype(np.float64)[:, None]
        for name in wire.CALIBRATION.fields or ()
    }
    alpha = _ramp(packets["angle_min"], packets["angle_increment"], slots) + c["alpha_angle_bias"]
    origin = np.zeros((*alpha.shape, 3))
    origin[..., 2] = c["a_axis_dist"]
    direction = np.zeros_like(origin)
    if packets.dtype == wire.POINTS_2D_PAYLOAD:
        direction[..., 1], direction[..., 2] = np.cos(alpha), np.sin(alpha)
        return origin, direction
    theta = c["theta_angle_bias"] + _ramp(
        packets["com_horizontal_angle_start"], packets["com_horizontal_angle_step"], slots
    )
    sin_beta, cos_beta = np.sin(c["beta_angle"]), np.cos(c["beta_angle"])
    sin_xi, cos_xi = np.sin(c["xi_angle"]), np.cos(c["xi_angle"])
    sin_theta, cos_theta = np.sin(theta), np.cos(theta)
    along = -cos_beta * sin_xi + sin_beta * cos_xi * np.sin(alpha)
    across = np.cos(alpha) * cos_xi
    origin[..., 0] = cos_theta * c["b_axis_dist"]
    origin[..., 1] = sin_theta * c["b_axis_dist"]
    direction[..., 0] = cos_theta * along - sin_theta * across
    direction[..., 1] = sin_theta * along + cos_theta * across
    direction[..., 2] = sin_beta * sin_xi + cos_beta * cos_xi * np.sin(alpha)
    return origin, direction


def _ramp(
    start: NDArray[np.float32], step: NDArray[np.float32], slots: NDArray[np.int64]
) -> NDArray[np.float64]:
    values: NDArray[np.float64] = (
        start.astype(np.float64)[:, None] + step.astype(np.float64)[:, None] * slots
    )
    return values


def _set_fan(packets: NDArray[np.void], turn_s: float, wide_fov: bool) -> None:
    """Fill in the mirror's angles and the slots' times: its speed is constant."""
    slots = packets["ranges"].shape[1]
    margin = WIDE_MARGIN_RAD if wide_fov else 0.0
    increment = (np.pi + 2.0 * margin) / slots
    packets["angle_min"] = -margin
    packets["angle_increment"] = increment
    packets["time_increment"] = turn_s * increment / (2.0 * np.pi)
