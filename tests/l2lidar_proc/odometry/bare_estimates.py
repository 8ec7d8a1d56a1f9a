"""Estimates of an odometry with nothing but a pose and a status."""

from __future__ import annotations

import numpy as np

from l2lidar_node.types import F64, HostNs
from l2lidar_proc.odometry.estimate import AlignmentQuality, OdometryEstimate, Status


def estimate(stamp: int, T_map_lidar: F64, status: tuple[Status, ...] = ()) -> OdometryEstimate:
    return OdometryEstimate(
        HostNs(stamp), T_map_lidar, np.eye(6), np.zeros(3), np.zeros(3), np.eye(6),
        np.empty(0, np.dtype([("x", "<f4")])), status, AlignmentQuality(),
        np.zeros(3), np.zeros(3), np.zeros(3),
    )  # fmt: skip
