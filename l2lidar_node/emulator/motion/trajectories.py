"""Built-in motions, and tours of a scene in the style of robots and people."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node import rotations
from l2lidar_node.emulator.motion.motion import (
    Motion,
    PoseSpline,
    mount_quaternion,
    rpy_quaternions,
)
from l2lidar_node.emulator.rng import Stream, generator
from l2lidar_node.emulator.world.scene import Scene
from l2lidar_node.types import F64

MOTIONS: Final = ("still", "spin", "shake", "walk", "trot", "drone")
"""Names for :func:`make`."""

DEFAULT_SPEEDS: Final = {
    "still": 0.0,
    "spin": 1.0,
    "shake": 1.8,
    "walk": 0.7,
    "trot": 0.8,
    "drone": 1.0,
}
"""Speed by motion [m/s], for spin the rate and for shake the peak rate of each axis [rad/s]."""

_KNOTS_PER_S: Final = {
    "still": 4.0,
    "spin": 50.0,
    "shake": 50.0,
    "walk": 100.0,
    "trot": 250.0,
    "drone": 250.0,
}
_SHAKE_S: Final = 20.0  # one lap


def make(
    name: str,
    scene: Scene,
    *,
    speed: float = 0.0,
    rest_s: float = 2.0,
    mount: str | tuple[float, float, float] = "upright",
    seed: int = 0,
) -> Motion:
    """Return a built-in motion along a scene's route.

    Parameters
    ----------
    name : str
        One of :data:`MOTIONS`.
    scene : Scene
        Gives the route (walk, trot, drone) or the spot (still, spin, shake).
    speed : float
        [m/s], for spin and shake the rate [rad/s]; 0 = the motion's own.
    rest_s : float
        Rest at the beginning [s], see :class:`Motion`.
    mount : str or tuple of float
        See :func:`motion.mount_quaternion`.
    seed : int
        Shifts the phases of bobbing, swaying and vibrating.

    Raises
    ------
    ValueError
        For a name that is not known or a speed that is negative.
    """
    if name not in MOTIONS:
        raise ValueError(f"motion '{name}' is not known, expected one of {', '.join(MOTIONS)}")
    if not 0.0 <= speed < 100.0:
        raise ValueError(f"speed {speed!r} is out of range, expected 0 to 100")
    speed = speed or DEFAULT_SPEEDS[name]
    route = _Route(scene.route)
    lap_s = {"still": 2.0, "spin": 2.0 * np.pi / (speed or 1.0), "shake": _SHAKE_S}.get(
        name, route.length / (speed or 1.0)
    )
    lap = _Lap(lap_s, _KNOTS_PER_S[name], speed, scene, route, generator(seed, Stream.MOTION, 0))
    position, rpy = _GAITS[name](lap)
    curve = PoseSpline(lap.t, position, rpy_quaternions(rpy), periodic=True, degree=5)
    return Motion(curve, rest_s=rest_s, mount_wxyz=mount_quaternion(mount))


class _Route:
    """A closed smooth curve through corners, by distance along it."""

    def __init__(self, corners: NDArray[np.float64]) -> None:
        from scipy.interpolate import CubicSpline, make_interp_spline

        closed = np.vstack([corners, corners[:1]])
        knots = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))]
        self._curve = make_interp_spline(knots, closed, k=5, bc_type="periodic")
        self._u = np.linspace(0.0, knots[-1], 4001)
        pace = CubicSpline(self._u, np.linalg.norm(self._curve(self._u, nu=1), axis=1))
        self._pace, self._distance = pace, pace.antiderivative()
        self.length = float(self._distance(knots[-1]))

    def at(
        self, s: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return x y (N, 2) [m], unwrapped heading [rad] and curvature [1/m] at distances."""
        lap = np.mod(s, self.length)
        u = np.interp(lap, self._distance(self._u), self._u)
        for _ in range(3):  # Newton: without kinks, which would be jerks
            u = u - (self._distance(u) - lap) / self._pace(u)
        u = np.mod(u, self._u[-1])
        d1, d2 = self._curve(u, nu=1).T, self._curve(u, nu=2).T
        curvature = (d1[0] * d2[1] - d1[1] * d2[0]) / np.hypot(*d1) ** 3
        return self._curve(u), np.unwrap(np.arctan2(d1[1], d1[0])), curvature


class _Lap:
    """What a gait is made of: the knots of one lap, the route there, whole numbers of waves."""

    def __init__(
        self,
        period: float,
        rate: float,
        speed: float,
        scene: Scene,
        route: _Route,
        source: np.random.Generator,
    ) -> None:
        self.t = np.linspace(0.0, period, max(round(period * rate), 16) + 1)
        self.speed = speed
        self.scene = scene
        self._period = period
        self._source = source
        begin = source.uniform(0.0, route.length)
        self.xy, self.heading, self.curvature = route.at(begin + speed * self.t)
        self.left = np.stack([-np.sin(self.heading), np.cos(self.heading)], axis=1)

    def wave(self, frequency: float) -> NDArray[np.float64]:
        """Return a sine of about this frequency [Hz], fitted to the lap, shape (N,)."""
        turns = max(round(frequency * self._period), 1)
        return np.sin(
            2.0 * np.pi * turns / self._period * self.t + self._source.uniform(0.0, 2.0 * np.pi)
        )

    def pose(
        self,
        height: NDArray[np.float64],
        sideways: NDArray[np.float64],
        roll: NDArray[np.float64],
        pitch: NDArray[np.float64],
        yaw: NDArray[np.float64],
    ) -> _Poses:
        """Return poses on the route; angles [deg] are relative to the heading."""
        xy = self.xy + self.left * sideways[:, None]
        z = self.scene.ground(self.xy[:, 0], self.xy[:, 1]) + height
        rpy = np.deg2rad(np.stack([roll, pitch, yaw], axis=1))
        rpy[:, 2] += self.heading
        return np.column_stack([xy, z]), rpy


_Poses = tuple[
    NDArray[np.float64], NDArray[np.float64]
]  # positions (N, 3) [m], roll pitch yaw (N, 3) [rad]


def _spot(lap: _Lap, height: float) -> NDArray[np.float64]:
    x, y = lap.scene.spot
    z = float(lap.scene.ground(np.array(x), np.array(y))) + height
    return np.tile([x, y, z], (len(lap.t), 1))


def _still(lap: _Lap) -> _Poses:
    return _spot(lap, 1.0), np.zeros((len(lap.t), 3))


def _spin(lap: _Lap) -> _Poses:
    """Turn on a table, the sensor 40 mm off its axis."""
    yaw = lap.speed * lap.t
    zero = np.zeros_like(yaw)
    position = _spot(lap, 0.8) + 0.04 * np.column_stack([np.cos(yaw), np.sin(yaw), zero])
    return position, np.column_stack([zero, zero, yaw])


def _shake(lap: _Lap) -> _Poses:
    """Turn and shake in the hand about all three axes, as for calibrating an IMU."""
    frequencies = (0.45, 0.55, 0.35)  # so that no axis keeps step with another
    turns = [lap.speed / (2.0 * np.pi * f) * lap.wave(f) for f in frequencies]
    sways = [a * lap.wave(f) for a, f in ((0.06, 0.9), (0.06, 1.05), (0.05, 1.2))]
    return _spot(lap, 1.0) + np.column_stack(sways), np.column_stack(turns)


def _walk(lap: _Lap) -> _Poses:
    """Walk with the sensor in the hand: a bob per step, a sway per stride, a wandering look."""
    step, vigour = 1.8 * np.sqrt(lap.speed / 1.2), min(lap.speed / 1.2, 1.5)
    return lap.pose(
        1.1 + 0.025 * vigour * lap.wave(step) + 0.03 * lap.wave(0.11),
        0.025 * vigour * lap.wave(step / 2) + 0.04 * lap.wave(0.17),
        2.0 * vigour * lap.wave(step / 2) + 3.0 * lap.wave(0.31),
        1.5 * vigour * lap.wave(step) + 4.0 * lap.wave(0.23),
        3.0 * vigour * lap.wave(step / 2) + 12.0 * lap.wave(0.13),
    )


def _trot(lap: _Lap) -> _Poses:
    """Trot on four legs: body motion at 2-3 Hz, its harmonic at footfall, and vibration."""
    stride = 1.9 + 0.7 * lap.speed
    return lap.pose(
        0.42
        + 0.012 * lap.wave(stride)
        + 0.003 * lap.wave(2 * stride)
        + 1.5e-4 * lap.wave(17.0)
        + 4e-5 * lap.wave(31.0),
        0.010 * lap.wave(stride / 2) + 5e-5 * lap.wave(23.0),
        1.8 * lap.wave(stride / 2) + 0.4 * lap.wave(stride) + 0.03 * lap.wave(19.0),
        1.2 * lap.wave(stride) + 0.3 * lap.wave(2 * stride) + 0.02 * lap.wave(29.0),
        1.5 * lap.wave(stride / 2) + 4.0 * lap.wave(0.19),
    )


def _drone(lap: _Lap) -> _Poses:
    """Fly: climb and sink, bank into turns, and the rotors' vibration."""
    room = lap.scene.headroom
    bank = -np.rad2deg(np.arctan(lap.speed**2 * lap.curvature / 9.81))
    return lap.pose(
        0.55 * room + 0.12 * room * lap.wave(0.09) + 0.02 * lap.wave(0.7) + 2e-5 * lap.wave(45.0),
        0.03 * lap.wave(0.4),
        bank + 1.5 * lap.wave(0.8) + 0.02 * lap.wave(38.0),
        2.0 + 2.0 * lap.wave(0.5) + 3.0 * lap.wave(0.13) + 0.02 * lap.wave(41.0),
        20.0 * lap.wave(0.07) + 1.0 * lap.wave(0.9),
    )


_GAITS: Final[dict[str, Callable[[_Lap], _Poses]]] = {
    "still": _still,
    "spin": _spin,
    "shake": _shake,
    "walk": _walk,
    "trot": _trot,
    "drone": _drone,
}


_RATE: Final = 200.0  # knots per second
_PEAK: Final = 1.875  # peak rate over mean rate of a step with no jerk at its ends
_TURNS_RAD: Final = np.deg2rad(8.0)  # smaller changes of heading happen while walking
_HIT_RATE: Final = 500.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Style:
    """Style of a tour.

    Attributes
    ----------
    speed : float
        Of the straight ways [m/s].
    turn_rate : float
        Peak of a turn on the spot [rad/s].
    height : float
        Of the sensor above the tour [m].
    bob : float
        Vertical amplitude of steps while under way [m].
    tremor : float
        Amplitude of what a hand or a chassis does all the time [rad]; a tenth of it in meters.
    glance : float
        Amplitude of slow looking up, down and around [rad].
    pause_s : float
        Rest at each stop [s].
    """

    speed: float = 0.5
    turn_rate: float = 0.8
    height: float = 1.3
    bob: float = 0.02
    tremor: float = 0.002
    glance: float = 0.08
    pause_s: float = 0.3


STYLES: Final[dict[str, Style]] = {
    "look": Style(),
    "drive": Style(
        speed=1.25, turn_rate=0.8, height=0.45, bob=0.0, tremor=0.0006, glance=0.0, pause_s=1.0
    ),
    "climb": Style(speed=0.55, turn_rate=1.2, height=1.2, bob=0.03, glance=0.12, pause_s=0.1),
}
"""Ways to carry out a tour: in the hand of someone who looks around, on wheels, up stairs."""


def tour(
    scene: Scene,
    style: Style,
    *,
    seconds: float,
    mount: str | tuple[float, float, float] = "upright",
    rest_s: float = 2.0,
    seed: int = 0,
) -> Motion:
    """Return a motion along a scene's tour; where that ends, it goes back the same way.

    Parameters
    ----------
    scene : Scene
        With a tour of at least two stops.
    style : Style
    seconds : float
        For how long there is motion; afterwards the sensor rests.
    mount : str or tuple of float
        See :func:`motion.mount_quaternion`.
    rest_s : float
        Rest at the beginning [s].
    seed : int
        Shifts the phases of what is not straight.

    Raises
    ------
    ValueError
        If the scene has no tour.
    """
    stops = scene.tour
    if len(stops) < 2:
        raise ValueError("this scene has no tour to follow")
    places, headings = _legs(np.vstack([stops, stops[-2::-1]]), style, seconds)
    t = np.arange(len(places)) / _RATE
    source = generator(seed, Stream.MOTION, 0)
    pace = np.linalg.norm(np.gradient(places, 1.0 / _RATE, axis=0), axis=1) / style.speed

    def wave(frequency: float) -> F64:
        wander = frequency * source.uniform(0.93, 1.07)
        return np.asarray(np.sin(2.0 * np.pi * wander * t + source.uniform(0.0, 2.0 * np.pi)))

    step = 1.7
    shake, glance = style.tremor, style.glance
    places[:, 2] += style.height + style.bob * pace * wave(step) + 0.1 * shake * wave(7.0)
    side = 0.6 * style.bob * pace * wave(step / 2.0) + 0.1 * shake * wave(9.0)
    places[:, 0] -= np.sin(headings) * side
    places[:, 1] += np.cos(headings) * side
    rpy = np.column_stack(
        [
            shake * (wave(6.3) + wave(9.1))
            + 0.3 * glance * wave(0.21)
            + 0.8 * style.bob * wave(step / 2),
            shake * (wave(5.7) + wave(8.3)) + glance * wave(0.17) + 0.8 * style.bob * wave(step),
            headings + shake * wave(7.9) + glance * wave(0.13),
        ]
    )
    curve = PoseSpline(t, places, rpy_quaternions(rpy), degree=5)
    return Motion(curve, rest_s=rest_s, mount_wxyz=mount_quaternion(mount))


def hit(motion: Motion, seconds: float, instants: Sequence[float], seed: int = 0) -> Motion:
    """Return a motion with blows that push the sensor by a centimeter and turn it by 4 degrees.

    A blow lasts 120 ms; at its height the sensor accelerates by some 30 m/s^2.

    Parameters
    ----------
    motion : Motion
    seconds : float
        Length of what is returned.
    instants : sequence of float
        Middle of each blow [s].
    seed : int
        Gives the directions.
    """
    t = np.arange(0.0, seconds, 1.0 / _HIT_RATE)
    places, quaternions = motion.poses(t)
    rng = np.random.default_rng((seed, 11))
    for instant in instants:
        u = np.clip((t - instant) / 0.06, -1.0, 1.0)
        bump = (1.0 - u * u) ** 5
        places = places + bump[:, None] * _direction(rng) * 0.01
        turn = bump[:, None] * _direction(rng) * np.deg2rad(4.0)
        half = np.linalg.norm(turn, axis=1, keepdims=True) / 2.0
        blow = np.hstack([np.cos(half), 0.5 * turn * np.sinc(half / np.pi)])
        quaternions = rotations.multiply(quaternions, blow)
    return Motion(PoseSpline(t, places, quaternions, degree=5), rest_s=0.0)


def _direction(rng: np.random.Generator) -> F64:
    drawn = rng.normal(size=3)
    return np.asarray(drawn / np.linalg.norm(drawn))


def _legs(stops: F64, style: Style, seconds: float) -> tuple[F64, F64]:
    """Return places (N, 3) and headings (N,) at the knots of a tour."""
    places, headings = [stops[:1]], []
    heading = float(np.arctan2(*(stops[1, :2] - stops[0, :2])[::-1]))
    headings.append(np.array([heading]))
    for start, end in pairwise(stops):
        flat = end[:2] - start[:2]
        if np.linalg.norm(flat) > 1e-6:  # else straight up: keep the heading
            change = float(np.arctan2(flat[1], flat[0])) - heading
            change = float(np.mod(change + np.pi, 2.0 * np.pi) - np.pi)
            if abs(change) > _TURNS_RAD:
                rise = _rise(abs(change) * _PEAK / style.turn_rate)
                places.append(np.repeat(start[None], len(rise), axis=0))
                headings.append(heading + change * rise)
                heading += change
        way = end - start
        share = _cruise(float(np.linalg.norm(way)), style.speed)
        places.append(start + share[:, None] * way)
        headings.append(np.full(len(share), heading))
        hold = round(style.pause_s * _RATE)
        places.append(np.repeat(end[None], hold, axis=0))
        headings.append(np.full(hold, heading))
        if sum(map(len, headings)) > seconds * _RATE:
            break
    return np.concatenate(places), np.concatenate(headings)


def _rise(length: float) -> F64:
    """Return a step from 0 to 1 within ``length`` seconds, with no jerk at its ends."""
    s = np.arange(1, max(round(length * _RATE), 8) + 1) / max(round(length * _RATE), 8)
    return np.asarray(s**3 * (10.0 + s * (-15.0 + 6.0 * s)))


def _cruise(length: float, speed: float) -> F64:
    """Return shares of a way: a smooth start and stop of 1 s with even speed between."""
    ramp = 1.0
    if length < 1.2 * speed * ramp:
        return _rise(length * _PEAK / speed)
    span = length / speed + ramp
    t = np.arange(1, round(span * _RATE) + 1) / _RATE
    pace = _rise_value(t / ramp) * _rise_value((span - t) / ramp)
    way = np.cumsum(pace)
    return np.asarray(way / way[-1])


def _rise_value(s: F64) -> F64:
    s = np.clip(s, 0.0, 1.0)
    return np.asarray(s**3 * (10.0 + s * (-15.0 + 6.0 * s)))
