"""Says in words and figures how the odometry is doing."""

from __future__ import annotations

from collections import Counter
from typing import Final

import numpy as np

from l2lidar_proc.odometry.estimate import OdometryEstimate, Status
from l2lidar_proc.odometry.imu_calibration import ExtrinsicCheck

OK: Final = 0
WARN: Final = 1
ERROR: Final = 2

_SERIOUS: Final = {
    Status.PREDICTED,
    Status.SUSPECT,
    Status.LOST,
    Status.NO_IMU,
    Status.GRAVITY_UNTRUSTED,
}


def judged(
    last: OdometryEstimate | None,
    sweeps: int,
    since: int,
    counts: Counter[Status],
    refused: Counter[str],
    untied: str = "",
    check: ExtrinsicCheck | None = None,
) -> tuple[int, str, dict[str, str]]:
    """Return level, message and figures for a diagnostic status.

    Parameters
    ----------
    last : OdometryEstimate or None
        The newest.
    sweeps : int
        Sweeps so far.
    since : int
        Of these, sweeps since the last look.
    counts : Counter of Status
        How often what was reported.
    refused : Counter of str
        Clouds that could not be used, by reason.
    untied : str
        Why the poses are not those of the base frame; empty if they are.
    check : ExtrinsicCheck, optional
        Whether the gyro turns as the clouds do.
    """
    values = {"sweeps": str(sweeps)}
    values |= {f"{status.name.lower()} [sweeps]": str(count) for status, count in counts.items()}
    values |= {f"clouds refused: {reason}": str(count) for reason, count in refused.items()}
    if last is None:
        return WARN, "no clouds" if not since else "waiting for the first sweeps to fit", values
    quality = last.quality
    sigma = np.sqrt(np.diag(last.covariance))
    values |= {
        "position uncertainty [m]": f"{float(sigma[:3].max()):.4f}",
        "attitude uncertainty [deg]": f"{float(np.degrees(sigma[3:].max())):.3f}",
        "speed [m/s]": f"{float(np.linalg.norm(last.velocity)):.3f}",
        "points to align": str(quality.points),
        "points matched": str(quality.matched),
        "agreement [%]": f"{100.0 * quality.inlier_ratio:.1f}",
        "residual [mm]": f"{1e3 * quality.residual_m:.1f}",
        "weakest direction [%]": f"{100.0 * quality.degeneracy_ratio:.2f}",
        "innovations (NIS, 1 = as expected)": f"{quality.nis:.2f}",
        "innovations of the speed (NIS)": f"{quality.velocity_nis:.2f}",
        "tilt of the map [deg]": f"{float(np.degrees(last.tilt)):.2f}",
        "KISS-ICP threshold [m]": f"{quality.kiss_threshold_m:.3f}",
        "map cells": str(quality.map_cells),
        "gyro bias [rad/s]": " ".join(f"{axis:.4f}" for axis in last.gyro_bias),
        "accelerometer bias [m/s^2]": " ".join(f"{axis:.3f}" for axis in last.accel_bias),
    }
    finding = ""
    if check is not None:
        values |= check.values
        finding = check.finding
    if not since:
        return WARN, "no clouds", values
    is_warned = bool(last.status or finding)
    remarks = set(last.status)
    if Status.SKIPPED in remarks:  # the next one that is aligned makes up for it
        remarks -= {Status.PREDICTED}
    level = ERROR if untied or _SERIOUS & remarks else WARN if is_warned else OK
    words = [status.value for status in last.status] or ["aligned"]
    return level, "; ".join([*words, *filter(None, (finding, untied))]), values
