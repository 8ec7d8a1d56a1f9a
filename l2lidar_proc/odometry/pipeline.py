"""Odometry pipeline: sweeps and IMU samples in, estimates out, for node and command line."""

from __future__ import annotations

from collections import Counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from l2lidar_node.types import Check, HostNs, Level, Sweep
from l2lidar_proc.motion.imu_buffer import Samples, Sequencer
from l2lidar_proc.motion.imu_corrections import ImuConvention, ImuExtrinsics
from l2lidar_proc.motion.sweep_motion import still_trajectory
from l2lidar_proc.motion.tracker import KnownMotion
from l2lidar_proc.odometry.config import OdometryConfig
from l2lidar_proc.odometry.estimate import DOUBTFUL, OdometryEstimate, Status
from l2lidar_proc.odometry.imu_calibration import ExtrinsicCheck
from l2lidar_proc.odometry.interface import Phase, SweepOdometry, SweepOrder, sweep_order
from l2lidar_proc.odometry.kiss import PlainOdometry
from l2lidar_proc.odometry.odometry import Odometry
from l2lidar_proc.recording.outputs import Trajectory

_MS: Final = 1_000_000
_MOTIONS: Final = 32  # sweeps whose motion is remembered
_BACKLOG: Final = 2  # clouds that wait: one may, while the one before is aligned

_SERIOUS: Final = {
    Status.PREDICTED,
    Status.SUSPECT,
    Status.LOST,
    Status.NO_IMU,
    Status.GRAVITY_UNTRUSTED,
}


class OdometryPipeline:
    """Sequencer and odometry, with trajectory and counts.

    Parameters
    ----------
    config : OdometryConfig
        Its mode decides which odometry runs.
    T_cloud_imu : ndarray, shape (4, 4)
        IMU coordinates to cloud coordinates.
    imu_wait_ms : int
        Longest wait for IMU samples up to the end of a sweep; plain KISS-ICP does not wait.
    extrinsics : ImuExtrinsics, optional
        What is known of the IMU beside its place.
    accelerometer : bool
        False: the accelerometer is watched, for its sign, but not used.
    max_skipped : int
        Most sweeps in a row that are not aligned while two or more clouds wait.

    Attributes
    ----------
    odometry : SweepOdometry
    trajectory : Trajectory
        Of the cloud frame.
    sweeps : int
        Sweeps that came in.
    counts : Counter of Status
        How often what was reported.
    last : OdometryEstimate or None
    convention : ImuConvention
        In which units the IMU measures, and with which sign its accelerometer.
    check : ExtrinsicCheck
        Whether the gyro turns as the clouds do.
    extrinsics : ImuExtrinsics
        What is known of the IMU beside its place.
    """

    def __init__(
        self,
        config: OdometryConfig,
        T_cloud_imu: NDArray[np.float64],
        imu_wait_ms: int = 50,
        extrinsics: ImuExtrinsics | None = None,
        *,
        accelerometer: bool = True,
        max_skipped: int = 0,
    ) -> None:
        self._config = config
        self._max_skipped = max_skipped
        self._uses_accelerometer = accelerometer
        self._wait_ns = imu_wait_ms * _MS if config.mode == "inertial" else 0
        self.extrinsics = extrinsics or ImuExtrinsics()
        self.convention = ImuConvention()
        self.mount(T_cloud_imu)

    def mount(self, T_cloud_imu: NDArray[np.float64]) -> None:
        """Take another mount of the IMU (4, 4); everything begins again.

        A rotation that is known better than by mounts takes the place of its own.
        """
        self.odometry: SweepOdometry = (
            PlainOdometry(self._config)
            if self._config.mode == "plain"
            else Odometry(self._config, self.extrinsics.mounted(T_cloud_imu))
        )
        self._begin()

    def is_mounted(self, T_cloud_imu: NDArray[np.float64]) -> bool:
        """Return whether a mount (4, 4) is the one that is used, or none is."""
        return not self._uses_imu or np.allclose(
            self.extrinsics.mounted(T_cloud_imu), self.odometry.T_cloud_imu, atol=1e-6
        )

    @property
    def _uses_imu(self) -> bool:
        return not isinstance(self.odometry, PlainOdometry)

    def configure(self, config: OdometryConfig) -> None:
        """Take new live settings."""
        self._config = config
        self.odometry.configure(config)

    def reset(self) -> None:
        """Forget map and trajectory; begin again with the next sweep."""
        self.odometry.reset()
        self._begin()

    def _begin(self) -> None:
        self._sequencer = Sequencer(self._wait_ns)
        self.convention.forget_motion()
        self.trajectory = Trajectory()
        self._motions: dict[tuple[HostNs, HostNs], KnownMotion] = {}
        self.sweeps = 0
        self._backlog = 0
        self._skipped = 0  # in a row
        self.counts: Counter[Status] = Counter()
        self.check = ExtrinsicCheck(self.odometry.T_cloud_imu[:3, :3])
        self.last: OdometryEstimate | None = None
        self._latest_start: HostNs | None = None  # of the sweep that was registered last

    def motion_of(self, sweep: Sweep) -> KnownMotion | None:
        """Return the motion that was estimated for a sweep, None if there is none."""
        return self._motions.get((sweep.start, sweep.end))

    def _remember(self, sweep: Sweep, registered: list[OdometryEstimate]) -> None:
        odometry = self.odometry
        if not registered or odometry.motion is None:
            return
        last = registered[-1]
        if Status.REFUSED in last.status:
            return
        if odometry.phase is Phase.STATIONARY:
            found = KnownMotion(still_trajectory(sweep.start, sweep.end), True)
        else:
            lever = odometry.T_cloud_imu[:3, 3]
            found = KnownMotion(
                odometry.motion.trajectory(lever),
                last.is_aligned,
                last.speed_sigma,
                not DOUBTFUL & set(last.status),
            )
        self._motions[(sweep.start, sweep.end)] = found
        while len(self._motions) > _MOTIONS:
            del self._motions[next(iter(self._motions))]

    @property
    def due_ns(self) -> int | None:
        """When :meth:`poll` should be called at the latest, None if nothing waits."""
        return self._sequencer.due_ns

    @property
    def newest_imu(self) -> HostNs | None:
        """Stamp of the newest IMU sample; None before the first, and where none is used."""
        return self.odometry.newest_imu

    def corrected(self, samples: Samples) -> Samples:
        """Return IMU samples (N,) as they are used; changes nothing, so any thread may ask."""
        return self._usable(self.convention.applied(self.extrinsics.corrected(samples)))

    def _usable(self, samples: Samples) -> Samples:
        if not self._uses_accelerometer:
            samples = samples.copy()
            samples["linear_acceleration"] = 0.0
        return samples

    def imu(self, samples: Samples) -> None:
        """Take IMU samples (N,) in any order and state.

        Where they show that the gyro measures in degrees per second, everything begins again.
        """
        was_in_degrees = self.convention.in_degrees
        samples = self._usable(self.convention.corrected(self.extrinsics.corrected(samples)))
        if self.convention.in_degrees != was_in_degrees and self._uses_imu:
            self.mount(self.odometry.T_cloud_imu)
        self.odometry.imu(samples)
        self.check.imu(samples)

    def sweep(self, sweep: Sweep, now: int, backlog: int = 0) -> None:
        """Take a sweep that arrives at ``now`` [ns].

        Parameters
        ----------
        sweep : Sweep
        now : int
        backlog : int
            How many more clouds have come already.
        """
        self.sweeps += 1
        self._backlog = backlog
        self._sequencer.push(sweep, now)

    def poll(self, now: int) -> list[OdometryEstimate]:
        """Return the estimates that are due by ``now`` [ns], in order."""
        estimates: list[OdometryEstimate] = []
        for release in self._sequencer.release(self.newest_imu, now):
            registered = self._registered(release.sweep)
            self._remember(release.sweep, registered)
            if not registered:
                self._note_unanswered(release.sweep)
            self._latest_start = release.sweep.start
            for estimate in registered:
                self.counts.update(estimate.status)
                if Status.REFUSED in estimate.status:
                    continue
                self.last = estimate
                self.trajectory.append(estimate.stamp, estimate.T_map_lidar)
                estimates.append(estimate)
                self._watch(estimate)
        return estimates

    def _note_unanswered(self, sweep: Sweep) -> None:
        """Count a sweep without an estimate if it will never have one: its clock stands still."""
        before = self._latest_start
        if before is not None and sweep_order(sweep.start - before) is SweepOrder.LATE:
            self.counts[Status.REFUSED] += 1

    def _registered(self, sweep: Sweep) -> list[OdometryEstimate]:
        """Register a sweep, or let it pass where too many others wait."""
        may_skip = self._backlog >= _BACKLOG and self._skipped < self._max_skipped
        registered = self.odometry.register(sweep, may_skip=may_skip)
        is_skipped = any(Status.SKIPPED in estimate.status for estimate in registered)
        self._skipped = self._skipped + 1 if is_skipped else 0
        return registered

    def _watch(self, estimate: OdometryEstimate) -> None:
        """Check the IMU against a pose; begin again where its accelerometer points backwards."""
        if not self._uses_imu:
            return
        self.check.pose(estimate)
        if not estimate.is_aligned:
            return
        T_map_imu = estimate.T_map_lidar @ self.odometry.T_cloud_imu
        if self.convention.watch(estimate.stamp, T_map_imu[:3, :3], T_map_imu[:3, 3]):
            self.mount(self.odometry.T_cloud_imu)


def judge(
    last: OdometryEstimate | None,
    sweeps: int,
    since: int,
    counts: Counter[Status],
    refused: Counter[str],
    untied: str = "",
    check: ExtrinsicCheck | None = None,
) -> Check:
    """Return how the odometry is doing.

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
        text = "waiting until the first sweeps match" if since else "no clouds"
        if since and 2 * counts[Status.REFUSED] > sweeps:
            text = "the stamps of the clouds do not advance"
        return Check("odometry", Level.WARN, text, values)
    quality = last.quality
    sigma = np.sqrt(np.diag(last.covariance))
    values |= {
        "position uncertainty [m]": f"{float(sigma[:3].max()):.4f}",
        "attitude uncertainty [deg]": f"{float(np.degrees(sigma[3:].max())):.3f}",
        "speed [m/s]": f"{float(np.linalg.norm(last.velocity)):.3f}",
        "points to align": str(quality.points),
        "points matched": str(quality.matched),
        "inlier ratio [%]": f"{100.0 * quality.inlier_ratio:.1f}",
        "residual [mm]": f"{1e3 * quality.residual_m:.1f}",
        "degeneracy ratio [%]": f"{100.0 * quality.degeneracy_ratio:.2f}",
        "innovations (NIS, 1 = as expected)": f"{quality.nis_per_dof:.2f}",
        "innovations of the speed (NIS)": f"{quality.velocity_nis_per_dof:.2f}",
        "tilt of the map [deg]": f"{float(np.degrees(last.tilt)):.2f}",
        "beams corrected by (xi, beta, alpha) [deg]": " ".join(
            f"{angle:.2f}" for angle in np.degrees(quality.beam_correction)
        ),
        "ranges corrected by [mm]": f"{1e3 * quality.range_correction:.0f}",
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
        return Check("odometry", Level.WARN, "no clouds", values)
    is_warned = bool(last.status or finding)
    remarks = set(last.status)
    if Status.SKIPPED in remarks:  # the next one that is aligned makes up for it
        remarks -= {Status.PREDICTED}
    level = Level.WARN if is_warned else Level.OK
    if untied or _SERIOUS & remarks:
        level = Level.ERROR
    words = [status.value for status in last.status] or ["aligned"]
    text = "; ".join([*words, *filter(None, (finding, untied))])
    return Check("odometry", level, text, values)
