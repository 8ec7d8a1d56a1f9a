"""Spots that a sensor sees on the walls of a corridor with openings, as it passes them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from l2lidar_node.types import F64, HostNs
from l2lidar_proc import tuning
from l2lidar_proc.motion import filter as eskf
from l2lidar_proc.motion.filter import InertialState
from l2lidar_proc.odometry.walls.wall_profile import SPOT, Spots

AXES = np.eye(3)
EPOCH = 1_700_000_000_000_000_000  # [ns]
SPEED = 1.25  # [m/s]
SWEEP_S = 0.23
HALF_WIDTH = 1.2  # [m] of the corridor
LINES = np.deg2rad(7.27)  # from one upright line of an L2 to the next


class Opening(NamedTuple):
    """In the right wall: from and to [m], how far back [m], and its reflectivity."""

    start: float
    end: float
    depth: float
    reflectivity: float


WALL = 0.75
PAINTED = (Opening(3.0, 3.95, 0.0, 0.45), Opening(9.5, 10.45, 0.0, 0.45))
NICHES = (Opening(3.0, 4.2, 0.4, WALL), Opening(9.0, 10.0, 0.5, WALL))
DOORS = (Opening(3.0, 3.95, 0.05, 0.45), Opening(9.5, 10.45, 0.1, 0.45))


def state_at(seconds: float, error: float = 0.0) -> InertialState:
    """Return the state of a sensor that passes at constant speed, of which it is wrong."""
    zero, speed = np.zeros(3), SPEED + error
    return InertialState(
        HostNs(EPOCH + round(seconds * 1e9)),
        np.eye(3),
        np.array([speed * seconds, 0.0, 0.5]),
        np.array([speed, 0.0, 0.0]),
        zero,
        zero,
        np.array([0.0, 0.0, -9.81]),
    )


def known(speed: float) -> F64:
    """Return a covariance of which the velocity along x is known to a standard deviation."""
    covariance = 1e-10 * np.eye(eskf.ERRORS)
    covariance[6, 6] = speed**2
    return covariance


def swept(
    rng: np.random.Generator,
    seconds: float,
    openings: tuple[Opening, ...],
    error: float,
    *,
    bend: float = 0.0,
    sway: float = 0.0,
    has_intensity: bool = True,
) -> Spots:
    """Return what a sweep sees of a corridor, where a sensor with a wrong velocity places it.

    Upright lines at a random phase, seven rows of the wall each. The sensor sways by so much [m].
    """
    x, places = SPEED * seconds, []
    for side in (-1.0, 1.0):
        for angle in np.arange(LINES * (1.0 + rng.random()), np.deg2rad(60.0), LINES).tolist():
            slope = 1.0 / np.tan(angle)
            at, depth, brightness = x + HALF_WIDTH * slope, 0.0, 0.5 * np.log(WALL)
            for hole in openings if side < 0.0 else ():
                if not hole.start < at < hole.end:
                    continue
                back = at + hole.depth * slope
                if back > hole.end:  # the reveal, which faces the sensor more than walls do
                    depth, at = (hole.end - at) / slope, hole.end
                    brightness += 0.5 * np.log(slope)
                else:
                    at, depth, brightness = back, hole.depth, 0.5 * np.log(hole.reflectivity)
                break
            places.append((at, side, depth, brightness))
    at, side, depth, brightness = np.repeat(np.array(places), 7, axis=0).T
    at = at + 0.004 * rng.standard_normal(len(at))
    found = np.zeros(len(at), SPOT)
    state = state_at(seconds, error)
    found["stamp"] = state.stamp
    found["points"] = 8
    noise = 0.006 * rng.standard_normal(len(at))
    beside = sway * np.sin(2.0 * np.pi * seconds / 2.5)
    lateral = side * (HALF_WIDTH + depth + noise) - beside
    up = np.tile(0.15 + 0.3 * np.arange(7.0), len(places)) - 0.5
    sight = found["sight"]
    sight[:, 0], sight[:, 1], sight[:, 2] = at - x, lateral, up
    found["place"] = sight + state.position + (0.0, beside, 0.0)
    found["place"][:, 1] += bend * (at - 5.0) ** 2
    if has_intensity:
        reach = np.linalg.norm(sight, axis=1)
        found["brightness"] = brightness - 0.4 * np.log(reach)
        found["brightness"] += 0.5 * np.log(np.abs(lateral) / HALF_WIDTH)  # the incidence
        found["brightness"] += 0.02 * rng.standard_normal(len(at))
    return found[np.linalg.norm(sight, axis=1) < tuning.PROFILE_RANGE]


def passed(
    seed: int,
    openings: tuple[Opening, ...],
    error: float,
    *,
    bend: float = 0.0,
    sway: float = 0.0,
    has_intensity: bool = True,
    seconds: float = 5.5,
) -> Spots:
    """Return the spots of all sweeps of some seconds."""
    rng = np.random.default_rng(seed)
    return np.concatenate(
        [
            swept(rng, time, openings, error, bend=bend, sway=sway, has_intensity=has_intensity)
            for time in np.arange(0.0, seconds, SWEEP_S).tolist()
        ]
    )
