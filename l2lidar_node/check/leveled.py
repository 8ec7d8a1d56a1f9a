"""Tells clouds that were levelled with the onboard orientation from those as measured."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.check.attitude import rotated, unit
from l2lidar_node.check.findings import Finding, Level, not_judged, ok
from l2lidar_node.check.observation import Observation
from l2lidar_node.check.requirements import Consumer, Use
from l2lidar_node.clouds.rings import OPTICAL_CENTRE_M

F64 = NDArray[np.float64]

_SUBJECT: Final = "cloud"
_TILT_DEG: Final = 12.0
_BELOW_DEG: Final = -8.0  # the wide field of view ends at -6
_MANY: Final = 0.01
_FEW: Final = 0.002
_NEAREST_M: Final = 0.5
_MOST: Final = 200


def check(seen: Observation, consumer: Consumer) -> Iterator[Finding]:
    """Yield whether the clouds are levelled, where the consumer deskews by itself.

    An L2 sees nothing below its own horizon. Where it is tilted, points below the cloud's horizon
    that are above it once they are turned back by the orientation tell that they were turned.
    """
    if consumer.time is Use.IGNORED:
        return
    verdict, why = _verdict(seen)
    if verdict is None:
        yield not_judged(_SUBJECT, "levelled", f"whether imu_adjust is on, {why}")
    elif verdict:
        yield Finding(
            Level.ERROR if consumer.imu is Use.NEEDED else Level.WARN,
            _SUBJECT,
            "levelled",
            f"the clouds are turned into a levelled frame ({why}); {consumer.title} deskews by "
            "itself and needs them as measured",
            "set imu_adjust: false",
        )
    else:
        yield ok(_SUBJECT, "levelled", f"clouds are in the sensor's frame ({why})")


def _verdict(seen: Observation) -> tuple[bool | None, str]:
    if seen.is_levelled is not None:
        return seen.is_levelled, f"imu_adjust is {str(seen.is_levelled).lower()}"
    imu = seen.imu[np.isfinite(seen.imu["orientation_wxyz"]).all(axis=1)]
    imu = imu[np.argsort(imu["stamp"], kind="stable")]
    imu = imu[np.linalg.norm(imu["orientation_wxyz"], axis=1) > 0.1]
    if not len(imu):
        return None, "without orientations"
    raw, back = [], []
    for cloud in seen.clouds[:: max(len(seen.clouds) // _MOST, 1)]:
        if cloud.contents is None:
            continue
        at = min(int(np.searchsorted(imu["stamp"], cloud.stamp)), len(imu) - 1)
        q = unit(imu["orientation_wxyz"][at : at + 1].astype(np.float64))
        up = rotated(q, np.array([[0.0, 0.0, 1.0]]))[0, 2]
        points = cloud.contents.sample.astype(np.float64)
        points = points[np.linalg.norm(points, axis=1) > _NEAREST_M]
        if len(points) < 50 or np.degrees(np.arccos(np.clip(up, -1.0, 1.0))) < _TILT_DEG:
            continue
        raw.append(_below(points))
        back.append(min(_below(_turned_back(points, q, yaw)) for yaw in (False, True)))
    if not raw:
        return None, f"the sensor was not tilted by {_TILT_DEG:g} deg or more"
    below, below_back = float(np.median(raw)), float(np.median(back))
    if below > _MANY and below_back < _FEW:
        return True, f"{below:.0%} of the points are below the sensor's horizon, none turned back"
    if below < _FEW:
        return False, "no point is below the sensor's horizon"
    return None, "points are below the sensor's horizon either way"


def _below(points: F64) -> float:
    """Return the share of points that are below what an L2 can see."""
    level = np.hypot(points[:, 0], points[:, 1])
    elevation = np.degrees(np.arctan2(points[:, 2] - OPTICAL_CENTRE_M, level))
    return float((elevation < _BELOW_DEG).mean())


def _turned_back(points: F64, q: F64, with_yaw: bool) -> F64:
    """Return points turned back by an orientation, or by all of it but the yaw."""
    w, x, y, z = q[0]
    inverse = q * [1.0, -1.0, -1.0, -1.0]
    if not with_yaw:
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        turn = np.array([[np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]])
        points = rotated(np.repeat(turn, len(points), axis=0), points)
    return rotated(np.repeat(inverse, len(points), axis=0), points)
