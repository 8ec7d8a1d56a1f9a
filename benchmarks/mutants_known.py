"""Mutants that are tried in every run, and why some of the others live."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault that once went unnoticed by every test.

    Attributes
    ----------
    path : str
        Of the module, below the repository.
    before, after : str
        What stands there once, and what instead.
    tests : tuple of str
        Files, or single tests, that have to notice it.
    """

    path: str
    before: str
    after: str
    tests: tuple[str, ...]


_BASE: Final = "l2lidar_proc/odometry/estimate.py"
_MESSAGES: Final = "l2lidar_node/ros/conversions.py"
_TRACKER: Final = "l2lidar_proc/motion/tracker.py"
_PROC: Final = "tests/l2lidar_proc"
_NODE: Final = "tests/l2lidar_node"

FAULTS: Final = (
    Fault(
        "l2lidar_proc/ros/odometry_messages.py",
        "quaternion.w, quaternion.x, quaternion.y, quaternion.z = w, x, y, z",
        "quaternion.w, quaternion.x, quaternion.y, quaternion.z = x, y, z, w",
        (f"{_PROC}/ros/test_odometry_messages.py",),
    ),
    Fault(
        _BASE,
        "velocity = estimate.velocity + rotations.cross(estimate.angular_velocity, arm)",
        "velocity = estimate.velocity",
        (f"{_PROC}/odometry/test_estimate.py",),
    ),
    Fault(
        _BASE,
        "twist[:3, 3:] = -skew(arm)",
        "twist[:3, 3:] = skew(arm)",
        (f"{_PROC}/odometry/test_estimate.py",),
    ),
    Fault(
        _MESSAGES,
        "(config.roll_covar, config.pitch_covar, config.yaw_covar)",
        "(config.yaw_covar, config.pitch_covar, config.roll_covar)",
        (f"{_NODE}/ros/test_conversions.py",),
    ),
    Fault(
        _MESSAGES,
        "(config.gyro_x_covar, config.gyro_y_covar, config.gyro_z_covar)",
        "(config.accel_x_covar, config.accel_y_covar, config.accel_z_covar)",
        (f"{_NODE}/ros/test_conversions.py",),
    ),
    Fault(
        "l2lidar_proc/motion/preintegration.py",
        " + (dt * dt / 12.0) * rotations.cross(before, after)",
        "",
        (f"{_PROC}/motion/test_preintegration.py",),
    ),
    Fault(
        "l2lidar_proc/odometry/initialization/map_initialization.py",
        "place = initial.state.rotation @ self.matcher.lever",
        "place = 0.0 * self.matcher.lever",
        (f"{_PROC}/odometry/test_odometry.py",),
    ),
    Fault(
        "l2lidar_proc/odometry/prediction.py",
        "max(settings.accel_noise * stated, accel.floor) * float(np.sqrt(period))",
        "max(settings.accel_noise * stated, accel.floor)",
        (f"{_PROC}/odometry/test_prediction.py",),
    ),
    Fault(
        "l2lidar_node/clock/cadence.py",
        "_MIN_TOLERANCE_NS: Final = 2_000.0",
        "_MIN_TOLERANCE_NS: Final = 20_000.0",
        (f"{_NODE}/clock/test_clock_parts.py",),
    ),
    Fault(
        "l2lidar_node/clock/host_clock_model.py",
        "if arrival < self._from:",
        "if False:",
        (f"{_NODE}/clock/test_clock_parts.py",),
    ),
    Fault(
        "l2lidar_node/clock/host_clock_model.py",
        "self._slewing.stepped(by_ns)\n        self._suspects.clear()",
        "self._slewing.stepped(by_ns)",
        (f"{_NODE}/clock/test_clock_parts.py",),
    ),
    Fault(
        _TRACKER,
        "if speed is not None and speed > self._config.still_speed:",
        "if False:",
        (f"{_PROC}/motion/test_tracker.py",),
    ),
    Fault(
        _TRACKER,
        "speed = self.filter.speed_near(end, self._config.velocity_max_age_ms * 1_000_000)",
        "speed = self.filter.speed_near(end, self._config.velocity_max_age_ms * 1_010_000)",
        (f"{_PROC}/motion/test_tracker.py",),
    ),
    Fault(
        _TRACKER,
        "            start, self._config.velocity_max_age_ms * 1_000_000",
        "            start, self._config.velocity_max_age_ms * 1_010_000",
        (f"{_PROC}/motion/test_tracker.py",),
    ),
    Fault(
        "l2lidar_node/driver/driver.py",
        "return self.send(commands.standby(), now), self.sent(commands.standby(), now)",
        "return self.send(commands.standby(), now), []",
        (f"{_NODE}/driver/test_driver.py",),
    ),
)
"""Faults named by those who tested the driver before; a run tries them all."""

REASONS: Final[dict[tuple[str, str], str]] = {
    (
        "l2lidar_node/protocol/wire.py",
        "WIDE_FOV = 1 << 0  # 192 degrees instead of 180; acts at once: 1 << 0 -> 1 >> 0",
    ): "the same number",
    (
        "l2lidar_node/protocol/framing.py",
        "at = data.find(wire.MAGIC, at + 1): 1 -> 2",
    ): "a magic begins at `at`, so none begins one byte later",
    (
        "l2lidar_node/protocol/packets.py",
        "if not math.isfinite(norm + p + q + r + ax + ay + az):: norm + p + q + r + ax -> "
        "norm + p + q + r - ax",
    ): "a difference is as little finite as a sum",
    (
        "l2lidar_node/clock/device_clock.py",
        "self._now = 0  # arrival of the latest packet: 0 -> 1",
    ): "replaced by the first packet, before anything reads it",
    (
        "l2lidar_node/clock/host_clock_model.py",
        "self._before_step = 0  # packets that were still told in the time before a step: 0 -> 1",
    ): "set to 0 by the first step that is told, before anything counts",
    (
        "l2lidar_node/clock/lower_envelope.py",
        "heights = [(h - h0) - ratio * (u - u0) for u, h in packets]: h - h0 -> h + h0",
    ): "the lowest height, which is shifted as well, is taken off again",
    (
        "l2lidar_node/clock/lower_envelope.py",
        "self._fitted_u = packets[-1][0]: 0 -> 1",
    ): "the bounds of the ratio do not widen in the first 100 ms: by 1e-7 of it",
    (
        "l2lidar_node/clock/lower_envelope.py",
        "span = (packets[-1][0] - u0) * line.ratio: 1 -> 2",
    ): "the span of 16 blocks and more is one block shorter",
    (
        "l2lidar_node/clock/lower_envelope.py",
        "return _SAFETY * error / span if span > 0.0 else 1.0: 0.0 -> 1.0",
    ): "no span is longer than 0 and shorter than a nanosecond",
    (
        "l2lidar_node/clock/device_clock.py",
        "self.in_force = 0 <= since <= _FASTEST * elapsed + _SLACK_NS: 0 -> 1",
    ): "one nanosecond",
    (
        "l2lidar_node/driver/sweep.py",
        'period = 2 * math.pi if self._config.cut == "turn" else math.pi: 2 -> 3',
    ): "angles are below one turn, so their multiples of either period are 0",
    (
        "l2lidar_proc/motion/filter.py",
        "np.linspace(preintegrated.anchor, knot, tuning.COVARIANCE_STEPS + 1).astype(int): "
        "tuning.COVARIANCE_STEPS + 1 -> tuning.COVARIANCE_STEPS - 1",
    ): "a tuned number of steps of the same integral: two less do as well",
    (
        "l2lidar_proc/motion/carrier_priors.py",
        "noise = np.array([[(tuning.SPEED_BOUND_SHARE * max_speed) ** 2]]): 2 -> 3",
    ): "2 % of the bound, beside an excess of several times the bound, is nothing either way",
}
"""By module and change, as ``docs/results/mutants.md`` shows them."""
