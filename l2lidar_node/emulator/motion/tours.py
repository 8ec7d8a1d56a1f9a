"""Moves along a scene's tour: straight ways, turns on the spot, hits on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from l2lidar_node import rotations
from l2lidar_node.emulator.motion.motion import Motion, mount_quaternion, rpy_quaternions
from l2lidar_node.emulator.motion.spline import PoseSpline
from l2lidar_node.emulator.rng import Stream, generator
from l2lidar_node.emulator.world.scene import Scene
from l2lidar_node.types import F64

_RATE: Final = 200.0  # knots per second
_PEAK: Final = 1.875  # peak rate over mean rate of a step with no jerk at its ends
_TURNS_RAD: Final = np.deg2rad(8.0)  # smaller changes of heading happen while walking
_HIT_RATE: Final = 500.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Style:
    """How a tour is carried out.

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
        Amplitude of what a hand or a chassis does all the time [rad]; a tenth of it in metres.
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


def make(
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
    """Return a motion with blows that push the sensor by a centimetre and turn it by 4 degrees.

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
        if np.linalg.norm(flat) > 1e-6:  # else straight up: whoever stands there keeps looking
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
