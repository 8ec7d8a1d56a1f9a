"""Individual L2 units: calibration, speeds, limits and errors."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.emulator.motion.motion import Kinematics, Motion
from l2lidar_node.emulator.rng import Stream, generator
from l2lidar_node.protocol import wire
from l2lidar_node.types import F64

Vector = tuple[float, float, float]

_DEG: Final = np.pi / 180.0
_NEAR_M: Final = 1.5  # nearer than this the range finder is not linear
_WARM_K: Final = 13.0  # by which the IMU warms up, see scanner.set_state
_GREY: Final = 0.5  # reflectivity at which the range is right


@dataclass(frozen=True, slots=True, kw_only=True)
class UnitErrors:
    """Differences of a unit from its reported calibration; none by default.

    Attributes
    ----------
    xi, beta, alpha : float
        True minus reported angle [rad].
    alpha_phase : float
        Standard deviation of what alpha differs by from power-up to power-up [rad].
    b : float
        True minus reported ``b_axis_dist`` [m].
    range_bias : float
        True minus reported range, at all ranges [m].
    range_scale : float
        True over reported scale, minus one.
    near : float
        What the range is short by at 0 m; falls to nothing at 1.5 m with the square [m].
    incidence : float
        What the range is long by at grazing incidence; as 1 - cos [m].
    intensity : float
        What the range of black is long by, and that of white short [m].
    head_wave : float
        Amplitude of the once-per-turn error of the reported head angle [rad].
    precession : tuple of float
        Tilt of the housing in step with the head, in the head frame about e_A and e_B [rad].
    precession_back : tuple of float
        Tilt that turns against the head, where the head's angle is 0 about x and y [rad].
    precession_pivot : float
        How far below the mounting face the housing is tilted [m].
    imu_rotation : tuple of float
        Rotation vector of the IMU in the cloud frame [rad].
    imu_position : tuple of float
        True minus published place of the IMU in the cloud frame [m].
    imu_time_offset : float
        By how much the stamps of IMU samples are late [s].
    gyro_scale : tuple of float
        Measured over true rate of each axis, minus one.
    gyro_skew : tuple of float
        Misalignment: how much of the rates about y, z and z goes into x, x and y [rad].
    gyro_bias_slope : tuple of float
        What warming up adds to the gyro's bias [rad/s/K].
    """

    xi: float = 0.0
    beta: float = 0.0
    alpha: float = 0.0
    alpha_phase: float = 0.0
    b: float = 0.0
    range_bias: float = 0.0
    range_scale: float = 0.0
    near: float = 0.0
    incidence: float = 0.0
    intensity: float = 0.0
    head_wave: float = 0.0
    precession: tuple[float, float] = (0.0, 0.0)
    precession_back: tuple[float, float] = (0.0, 0.0)
    precession_pivot: float = 0.0
    imu_rotation: Vector = (0.0, 0.0, 0.0)
    imu_position: Vector = (0.0, 0.0, 0.0)
    imu_time_offset: float = 0.0
    gyro_scale: Vector = (0.0, 0.0, 0.0)
    gyro_skew: Vector = (0.0, 0.0, 0.0)
    gyro_bias_slope: Vector = (0.0, 0.0, 0.0)

    @property
    def are_none(self) -> bool:
        """Whether the unit is perfect."""
        return self == UnitErrors()

    @property
    def rocks(self) -> bool:
        """Whether the mount moves with the head."""
        return any((*self.precession, *self.precession_back))

    def powered_up(self, seed: int, number: int) -> UnitErrors:
        """Return the errors after a power-up, with a new random phase of mirror and laser."""
        drawn = generator(seed, Stream.POWER_UP, number).standard_normal()
        return replace(self, alpha=self.alpha + self.alpha_phase * float(drawn), alpha_phase=0.0)

    def range_response(self, distance: F64, cosine: F64, reflectivity: F64) -> F64:
        """Return the range finder's error at a distance [m]; arrays of one shape."""
        nearness = np.clip(1.0 - distance / _NEAR_M, 0.0, 1.0)
        return np.asarray(
            -self.near * nearness**2
            + self.incidence * (1.0 - cosine)
            + self.intensity * (_GREY - reflectivity) / _GREY
        )

    def true_block(self, reported: NDArray[np.void]) -> NDArray[np.void]:
        """Return the true blocks of reported ones, dtype wire.CALIBRATION."""
        true = reported.copy()
        true["xi_angle"] += np.float32(self.xi)
        true["beta_angle"] += np.float32(self.beta)
        true["alpha_angle_bias"] += np.float32(self.alpha)
        true["b_axis_dist"] += np.float32(self.b)
        scale = reported["range_scale"].astype(np.float64) * (1.0 + self.range_scale)
        counts = self.range_bias / reported["range_scale"].astype(np.float64)
        true["range_scale"] = scale
        true["range_bias"] += counts.astype(np.float32)
        return true

    def gyro_matrix(self) -> F64:
        """Return the matrix from the true rates in the IMU frame to the measured ones, (3, 3)."""
        matrix = np.diag(1.0 + np.asarray(self.gyro_scale))
        matrix[0, 1], matrix[0, 2], matrix[1, 2] = self.gyro_skew
        return matrix

    def gyro_drift(self, t_s: F64) -> F64:
        """Return the bias that comes with warming up, shape (N, 3) [rad/s]."""
        warm = _WARM_K * (1.0 - np.exp(-np.maximum(t_s, 0.0) / 600.0))
        return np.outer(warm, self.gyro_bias_slope)

    def imu_quaternion(self) -> F64:
        """Return the rotation from the IMU frame to the cloud frame (w, x, y, z)."""
        return rotations.exp(self.imu_rotation)


def drawn(seed: int, size: float = 1.0) -> UnitErrors:
    """Return the errors of one unit of a population.

    Sizes are those seen on real units where any are published: beam angles of 0.2 to 0.5 degrees,
    a phase that differs by 0.27 degrees between two recordings, rates of 0.03 to 0.3 rad/s at the
    head's frequency. The others are what such parts have on data sheets.

    Parameters
    ----------
    seed : int
        Number of the unit.
    size : float
        Factor on every standard deviation.
    """
    source = generator(seed, Stream.UNIT, 0)

    def vector(sd: float) -> Vector:
        x, y, z = (size * sd * source.standard_normal(3)).tolist()
        return (x, y, z)

    def scalar(sd: float) -> float:
        return float(size * sd * source.standard_normal())

    return UnitErrors(
        xi=scalar(0.2 * _DEG),
        beta=scalar(0.25 * _DEG),
        alpha=scalar(0.2 * _DEG),
        alpha_phase=size * 0.1 * _DEG,
        b=scalar(0.2e-3),
        range_bias=scalar(0.02),
        range_scale=scalar(0.001),
        near=abs(scalar(0.02)),
        incidence=abs(scalar(0.003)),
        intensity=scalar(0.003),
        head_wave=scalar(0.05 * _DEG),
        precession=(scalar(0.03 * _DEG), scalar(0.03 * _DEG)),
        precession_back=(scalar(0.02 * _DEG), scalar(0.02 * _DEG)),
        imu_rotation=vector(0.4 * _DEG),
        imu_position=vector(0.002),
        imu_time_offset=scalar(0.002),
        gyro_scale=vector(0.004),
        gyro_skew=vector(0.002),
        gyro_bias_slope=vector(2e-4),
    )


TYPICAL: Final = UnitErrors(
    xi=0.19 * _DEG,
    beta=-0.28 * _DEG,
    alpha=0.13 * _DEG,
    alpha_phase=0.1 * _DEG,
    b=0.1e-3,
    range_bias=0.015,
    range_scale=0.0005,
    near=0.015,
    incidence=0.002,
    intensity=0.002,
    head_wave=0.03 * _DEG,
    precession=(0.03 * _DEG, -0.02 * _DEG),
    precession_back=(0.015 * _DEG, 0.01 * _DEG),
    imu_rotation=(0.3 * _DEG, -0.4 * _DEG, 0.5 * _DEG),
    imu_position=(0.001, -0.001, 0.002),
    imu_time_offset=0.0015,
    gyro_scale=(0.003, -0.002, 0.004),
    gyro_skew=(0.001, -0.001, 0.002),
    gyro_bias_slope=(1e-4, -1e-4, 1e-4),
)
"""A unit such as the one of the published recordings: angles 0.2 to 0.3 degrees off its block."""

_POOR: Final = 2.0


def named(name: str) -> UnitErrors:
    """Return the errors of a unit by name: perfect, typical, poor or the number of one.

    Raises
    ------
    ValueError
        For another name.
    """
    if name == "typical":
        return TYPICAL
    if name == "poor":
        return drawn(1, _POOR)
    if name.isdecimal() and len(name) <= 18:
        return drawn(int(name))
    if name == "perfect":
        return UnitErrors()
    raise ValueError(
        f"unit '{name}' is not known, expected perfect, typical, poor, a, fast or a number"
    )


class RockingMotion(Motion):
    """A motion on a mount that rocks in step with the head.

    Parameters
    ----------
    base : Motion
    errors : UnitErrors
    start_angle : float
        The head's angle with its bias at time 0 [rad].
    head_rate : float
        [rad/s]
    """

    def __init__(
        self, base: Motion, errors: UnitErrors, start_angle: float, head_rate: float
    ) -> None:
        self._base = base
        self._errors = errors
        self._start = start_angle
        self._rate = head_rate
        self.rest_s, self.ramp_s = base.rest_s, base.ramp_s

    @property
    def duration_s(self) -> float:
        """When the carrier comes to its final hold [s]."""
        return self._base.duration_s

    @property
    def lap_s(self) -> float:
        """How long one lap of the carrier takes [s]."""
        return self._base.lap_s

    def poses(self, t_s: F64) -> tuple[F64, F64]:
        """Return positions (N, 3) [m] and quaternions (N, 4); see :meth:`Motion.poses`."""
        position, quaternion = self._base.poses(t_s)
        tilt = self._tilt(np.asarray(t_s, np.float64), 0)
        turned = rotations.multiply(quaternion, rotations.exp(tilt))
        return position + self._shift(quaternion, tilt), turned

    def kinematics(self, t_s: F64) -> Kinematics:
        """Return the kinematics, to first order in the tilt; see :meth:`Motion.kinematics`."""
        t = np.asarray(t_s, np.float64)
        base = self._base.kinematics(t)
        tilt, speed, change = (self._tilt(t, order) for order in range(3))
        rocking = rotations.exp(tilt)
        back = np.swapaxes(rotations.matrices(rocking), 1, 2)
        q = base.quaternion_wxyz
        return Kinematics(
            base.position + self._shift(q, tilt),
            base.velocity + self._shift(q, speed),
            base.acceleration + self._shift(q, change),
            rotations.multiply(q, rocking),
            np.einsum("nij,nj->ni", back, base.angular_velocity) + speed,
            np.einsum("nij,nj->ni", back, base.angular_acceleration) + change,
        )

    def _tilt(self, t: F64, order: int) -> F64:
        """Return a derivative of the tilt's rotation vector in the cloud frame, shape (N, 3)."""
        angle = self._start + self._rate * t
        forward = (
            complex(*self._errors.precession) * (1j * self._rate) ** order * np.exp(1j * angle)
        )
        backward = (
            complex(*self._errors.precession_back)
            * (-1j * self._rate) ** order
            * np.exp(-1j * angle)
        )
        both = forward + backward
        return np.stack((both.real, both.imag, np.zeros(len(t))), axis=-1)

    def _shift(self, quaternion: F64, tilt: F64) -> F64:
        arm = np.array([0.0, 0.0, self._errors.precession_pivot])
        return np.asarray(
            np.einsum("nij,nj->ni", rotations.matrices(quaternion), np.cross(tilt, arm))
        )


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
