"""Says in words and figures how the deskew is doing."""

from __future__ import annotations

import math
from dataclasses import dataclass

from l2lidar_node.types import Level
from l2lidar_proc.deskew.pipeline import PipelineCounts
from l2lidar_proc.motion.imu_buffer import ImuCounts
from l2lidar_proc.motion.tracker import Flag, Quality
from l2lidar_proc.motion.twist_filter import TwistFilter


@dataclass(frozen=True, slots=True)
class Report:
    """A judgement with figures.

    Attributes
    ----------
    level : Level
    message : str
    values : dict of str
        Figures by name, the unit in the name.
    """

    level: Level
    message: str
    values: dict[str, str]


def of_sweep(quality: Quality, waited_ns: int) -> Report:
    """Return what there is to say about one sweep."""
    serious = {Flag.NO_IMU, Flag.ACCELEROMETER_FAULT, Flag.CLOCK_JUMP}
    if serious & set(quality.flags):
        level = Level.ERROR
    else:
        level = Level.WARN if quality.flags else Level.OK
    told = "; ".join(flag.value for flag in quality.flags)
    return Report(level, told or ("at rest" if quality.is_still else "deskewed"), {
        "IMU coverage [%]": f"{100.0 * quality.imu_covered:.1f}",
        "largest IMU gap [ms]": f"{quality.imu_gap_ns * 1e-6:.1f}",
        "rotation [deg]": f"{math.degrees(quality.rotation_rad):.2f}",
        "translation [m]": f"{quality.translation_m:.3f}",
        "velocity source": quality.velocity_source or "none",
        "velocity age [ms]": f"{quality.velocity_age_ns * 1e-6:.0f}",
        "velocity uncertainty [m/s]": f"{quality.velocity_sigma:.3f}",
        "gyro bias [rad/s]": " ".join(f"{axis:.4f}" for axis in quality.bias),
        "at rest": str(quality.is_still).lower(),
        "gravity trusted": str(quality.is_gravity_trusted).lower(),
        "waited for the IMU [ms]": f"{waited_ns * 1e-6:.1f}",
    })  # fmt: skip


def of_period(
    before: PipelineCounts,
    after: PipelineCounts,
    last: Report | None,
    imu: ImuCounts,
    motion: TwistFilter | None,
    refused: dict[str, int],
    *,
    is_levelled: bool,
    untied: str = "",
) -> Report:
    """Return what there is to say about the time between two looks.

    Parameters
    ----------
    before, after : PipelineCounts
    last : Report or None
        Of the newest sweep.
    imu : ImuCounts
    motion : TwistFilter or None
    refused : dict
        Clouds that could not be used, by reason.
    is_levelled : bool
        Whether the clouds come levelled, which they must not.
    untied : str
        Why velocities that came are not used; empty if they are.
    """
    sweeps = after.sweeps - before.sweeps
    values = {
        "sweeps": str(after.sweeps),
        "deskewed": str(after.deskewed),
        "at rest": str(after.still),
        "passed on as they came": str(after.passed_on),
        "not covered by the IMU in time": str(after.uncovered),
        "clock jumps": str(after.jumps),
        "IMU samples": str(imu.accepted),
        "IMU samples put in order": str(imu.reordered),
        "IMU samples refused: duplicate": str(imu.duplicate),
        "IMU samples refused: impossible": str(imu.invalid),
        "IMU samples refused: too old": str(imu.stale),
        **{f"clouds refused: {reason}": str(count) for reason, count in refused.items()},
        **({f"last: {name}": value for name, value in last.values.items()} if last else {}),
    }
    if motion is not None:
        values["gyro bias uncertainty [rad/s]"] = f"{motion.gyro_bias_sigma:.4f}"
        values["gravity [m/s^2]"] = f"{motion.gravity:.2f}"
    if is_levelled:
        text = "the clouds come levelled (imu_adjust), so deskewing makes them wrong"
        return Report(Level.ERROR, text, values)
    if not sweeps:
        return Report(Level.WARN, "no clouds", values)
    level, text = Level.OK, f"{sweeps} sweeps"
    if last is not None:
        level, text = last.level, f"{text}, the last one: {last.message}"
    if untied:
        level, text = max(level, Level.WARN), f"{text}; velocity not used: {untied}"
    return Report(level, text, values)
