"""Deskew pipeline: sweeps, IMU samples and velocities in, deskewed and filtered clouds out.

Composes sequencer, tracker, filters and deskew; node, offline tool and tests all use this. A
:class:`~l2lidar_node.types.Check` says in words and figures how it is doing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from l2lidar_node import records
from l2lidar_node.types import F64, Check, HostNs, Level, Sweep
from l2lidar_proc.cloud import without_time
from l2lidar_proc.deskew import filters
from l2lidar_proc.deskew.config import ProcConfig
from l2lidar_proc.deskew.deskew import deskew
from l2lidar_proc.deskew.filters import FilterError, organise
from l2lidar_proc.motion.imu_buffer import ImuCounts, Reason, Release, Samples, Sequencer
from l2lidar_proc.motion.imu_corrections import ImuConvention, ImuExtrinsics
from l2lidar_proc.motion.sweep_motion import SweepTrajectory
from l2lidar_proc.motion.tracker import Flag, KnownMotion, MotionTracker, Quality
from l2lidar_proc.motion.twist_filter import TwistFilter

_MS: Final = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Deskewed:
    """A deskewed and filtered sweep.

    Attributes
    ----------
    stamp : HostNs
        The instant whose cloud frame the points are in.
    points : ndarray, shape (N,) or, organised, (P, 300)
        Fields of the sweep; ``time`` only if asked for or not deskewed, in seconds after
        ``stamp``, and never constant.
    sweep : Sweep
        What came in.
    quality : Quality
    waited_ns : int
        How long the sweep was held for the IMU.
    known : KnownMotion, optional
        Its motion, where an odometry in the same process had estimated that.
    """

    stamp: HostNs
    points: NDArray[np.void]
    sweep: Sweep
    quality: Quality
    waited_ns: int
    known: KnownMotion | None = None


@dataclass(frozen=True, slots=True)
class PipelineCounts:
    """Counts since the start.

    Attributes
    ----------
    sweeps : int
        Sweeps that came out; none that came in is lost.
    deskewed, still, passed_on : int
        Of these: moved, found at rest, passed on as they came.
    uncovered : int
        Sweeps whose end the IMU samples did not reach in time.
    jumps : int
        Times the clock jumped.
    """

    sweeps: int = 0
    deskewed: int = 0
    still: int = 0
    passed_on: int = 0
    uncovered: int = 0
    jumps: int = 0


class Pipeline:
    """Sequencer, tracker, deskew and filters.

    Parameters
    ----------
    config : ProcConfig
    T_cloud_imu : ndarray, shape (4, 4), optional
        IMU coordinates to cloud coordinates, in place of the configured ones.

    Attributes
    ----------
    tracker : MotionTracker
    extrinsics : ImuExtrinsics
        What is known of the IMU beside its place.
    T_cloud_imu : ndarray, shape (4, 4)
        The mount that is used.
    convention : ImuConvention
        In which unit and with which sign the accelerometer measures.
    odometry_motion : callable or None
        Returns the motion that an odometry in the same process has estimated for a sweep.
    odometry_convention : callable or None
        Returns the convention that an odometry with the same IMU has detected, None if it is not
        there. Without one the unit is detected here, and the sign stays.
    counts : PipelineCounts
    problems : str
        What the last filter that could not work said.
    """

    def __init__(self, config: ProcConfig, T_cloud_imu: F64 | None = None) -> None:
        self.extrinsics = ImuExtrinsics.of(config.motion)
        self.T_cloud_imu = self.extrinsics.mounted(
            config.motion.T_cloud_imu if T_cloud_imu is None else T_cloud_imu
        )
        self.tracker = MotionTracker(config.motion, self.T_cloud_imu)
        self._sequencer = Sequencer(config.deskew.imu_wait_ms * _MS)
        self.counts = PipelineCounts()
        self.problems = ""
        self.odometry_motion: Callable[[Sweep], KnownMotion | None] | None = None
        self._is_known = False  # the motion of the latest sweep, by the odometry
        self.convention = ImuConvention()
        self.odometry_convention: Callable[[], ImuConvention | None] | None = None
        self.configure(config)

    def mount(self, T_cloud_imu: F64) -> bool:
        """Take another mount of the IMU (4, 4); return whether it is another one.

        A rotation that is known better than by mounts takes the place of its own.
        """
        self.T_cloud_imu = self.extrinsics.mounted(T_cloud_imu)
        return self.tracker.mount(self.T_cloud_imu)

    def configure(self, config: ProcConfig) -> None:
        """Take new live settings."""
        self._config = config
        self.tracker.configure(config.motion)
        self._sequencer.wait_ns = config.deskew.imu_wait_ms * _MS

    @property
    def due_ns(self) -> int | None:
        """When :meth:`poll` should be called at the latest, None if nothing waits."""
        return self._sequencer.due_ns

    @property
    def is_waiting(self) -> bool:
        """Whether a sweep waits to be handed out."""
        return len(self._sequencer) > 0

    def imu(self, samples: Samples) -> None:
        """Take IMU samples, shape (N,), in any order and state."""
        samples = self._converted(self.extrinsics.corrected(samples))
        if self.tracker.imu(samples, is_needed=not self._is_known):
            self._jumped()
            self._sequencer.jump()

    def _converted(self, samples: Samples) -> Samples:
        """Return samples in rad/s and m/s^2; put those right that came before."""
        convention = self.convention
        rates, forces = convention.rate_factor, convention.factor
        theirs = self.odometry_convention() if self.odometry_convention is not None else None
        if theirs is not None and theirs.knows_unit:
            convention.adopt(theirs)
            samples = convention.applied(samples)
        else:
            samples = convention.in_units(samples)
        if (rates, forces) != (convention.rate_factor, convention.factor):
            self.tracker.rescale(convention.rate_factor / rates, convention.factor / forces)
        return samples

    def velocity(
        self, stamp: HostNs, velocity: ArrayLike, source: str, covariance: F64 | None = None
    ) -> bool:
        """Take a velocity; see :meth:`l2lidar_proc.motion.tracker.MotionTracker.velocity`.

        While an odometry in the same process knows the motion none is needed.
        """
        if self._is_known:
            return False
        return self.tracker.velocity(stamp, velocity, source, covariance)

    def sweep(self, sweep: Sweep, now: int) -> None:
        """Take a sweep that arrives at ``now`` [ns]."""
        if self._sequencer.push(sweep, now):
            self._jumped()
            newest = self.tracker.buffer.newest
            if newest is not None and newest > sweep.end + 1000 * _MS:
                # the IMU has not jumped yet: what it said is of another time
                self.tracker.reset()

    def reset(self) -> None:
        """Forget all motion: the next sweeps are of another time, or of another sensor."""
        self.tracker.reset()
        self._sequencer.jump()

    def finish(self, now: int) -> list[Deskewed]:
        """Return the waiting sweeps at ``now`` [ns], even if the IMU does not cover them."""
        self._sequencer.jump()
        return self.poll(now)

    def poll(self, now: int) -> list[Deskewed]:
        """Return the sweeps finished by ``now`` [ns], in order."""
        released = self._sequencer.release(self.tracker.buffer.newest, now)
        return [self._process(release) for release in released]

    def _process(self, release: Release) -> Deskewed:
        sweep = release.sweep
        known = self.odometry_motion(sweep) if self.odometry_motion is not None else None
        self._is_known = known is not None
        trajectory, quality = self.tracker.trajectory(sweep.start, sweep.end, known)
        if release.reason is Reason.CLOCK_JUMP:
            quality = replace(quality, flags=(*quality.flags, Flag.CLOCK_JUMP))
        deskews = Flag.NO_IMU not in quality.flags
        stamp, points, problems = self._assemble(sweep, trajectory if deskews else None)
        if problems:
            quality = replace(quality, flags=(*quality.flags, Flag.FILTER_LEFT_OUT))
            self.problems = problems
        self._count(quality)
        return Deskewed(stamp, points, sweep, quality, release.waited_ns, known)

    def _assemble(
        self, sweep: Sweep, trajectory: SweepTrajectory | None
    ) -> tuple[HostNs, NDArray[np.void], str]:
        """Filter, deskew, filter again; return stamp, points to publish, problem.

        Without a trajectory the points stay as they are and keep their times.
        """
        chain = self._config.filters
        before, problem = self._kept(sweep.points, chain.filters_before)
        points = (
            sweep.points
            if len(before) == len(sweep.points)
            else records.selected(sweep.points, before)
        )
        reference = self._config.deskew.reference if trajectory is not None else "start"
        stamp = _instant(reference, sweep, points)
        moved = (
            deskew(points, sweep.start, trajectory, stamp) if trajectory is not None else points
        )
        after, another = self._kept(moved, chain.filters_after)
        if len(after) < len(moved):
            points, moved = records.selected(points, after), records.selected(moved, after)
            if _instant(reference, sweep, points) != stamp:
                stamp = _instant(reference, sweep, points)
                moved = (
                    deskew(points, sweep.start, trajectory, stamp)
                    if trajectory is not None
                    else points
                )
        times = points["time"]
        # a constant time ends some consumers
        keeps = (
            (self._config.deskew.keep_time or trajectory is None)
            and len(times) > 0
            and bool(np.ptp(times) > 0.0)
        )
        moved = _timed(moved, times, sweep.start, stamp) if keeps else without_time(moved)
        if self._config.deskew.organised:
            moved = organise(moved, times)
        return stamp, moved, problem or another

    def _kept(
        self, points: NDArray[np.void], names: tuple[str, ...]
    ) -> tuple[NDArray[np.intp], str]:
        try:
            return filters.apply(points, names, self._config.filters), ""
        except FilterError as error:
            return np.arange(len(points)), str(error)

    def _count(self, quality: Quality) -> None:
        passed_on = Flag.NO_IMU in quality.flags
        counts = self.counts
        self.counts = replace(
            counts,
            sweeps=counts.sweeps + 1,
            still=counts.still + quality.is_still,
            passed_on=counts.passed_on + passed_on,
            deskewed=counts.deskewed + (not quality.is_still and not passed_on),
            uncovered=counts.uncovered + (passed_on or Flag.IMU_ENDS_EARLY in quality.flags),
        )

    def _jumped(self) -> None:
        self.counts = replace(self.counts, jumps=self.counts.jumps + 1)


def _instant(reference: str, sweep: Sweep, points: NDArray[np.void]) -> HostNs:
    """Return the instant to move the points to."""
    if reference == "middle":
        return HostNs((sweep.start + sweep.end) // 2)
    if reference == "end":
        return sweep.end
    if not len(points) or len(points) == len(sweep.points):
        return sweep.start
    return HostNs(sweep.start + round(float(points["time"][0]) * 1e9))


def _timed(
    points: NDArray[np.void], times: NDArray[np.float32], start: HostNs, stamp: HostNs
) -> NDArray[np.void]:
    """Return the points with times after the stamp in place of times after the start."""
    if stamp == start:
        return points
    timed = records.copied(points)
    # to whole nanoseconds, so that the first is exactly 0
    timed["time"] = np.round(times - np.float64((stamp - start) * 1e-9), 9) + 0.0
    return timed


def of_sweep(quality: Quality, waited_ns: int) -> Check:
    """Return the check of one sweep."""
    serious = {Flag.NO_IMU, Flag.ACCELEROMETER_FAULT, Flag.CLOCK_JUMP}
    if serious & set(quality.flags):
        level = Level.ERROR
    else:
        level = Level.WARN if quality.flags else Level.OK
    told = "; ".join(flag.value for flag in quality.flags)
    return Check("sweep", level, told or ("at rest" if quality.is_still else "deskewed"), {
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
    last: Check | None,
    imu: ImuCounts,
    motion: TwistFilter | None,
    refused: dict[str, int],
    *,
    is_leveled: bool,
    untied: str = "",
) -> Check:
    """Return the check of the period between two diagnostics.

    Parameters
    ----------
    before, after : PipelineCounts
    last : Check or None
        Of the newest sweep.
    imu : ImuCounts
    motion : TwistFilter or None
    refused : dict
        Clouds that could not be used, by reason.
    is_leveled : bool
        Whether the clouds come leveled, which they must not.
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
        "IMU samples refused: outlier": str(imu.outlier),
        "IMU samples refused: too old": str(imu.stale),
        **{f"clouds refused: {reason}": str(count) for reason, count in refused.items()},
        **({f"last: {name}": value for name, value in last.values.items()} if last else {}),
    }
    if motion is not None:
        values["gyro bias uncertainty [rad/s]"] = f"{motion.gyro_bias_sigma:.4f}"
        values["gravity [m/s^2]"] = f"{motion.gravity:.2f}"
    if is_leveled:
        text = "the clouds are leveled (imu_adjust), so deskewing makes them wrong"
        return Check("deskew", Level.ERROR, text, values)
    if not sweeps:
        return Check("deskew", Level.WARN, "no clouds", values)
    level, text = Level.OK, f"{sweeps} sweeps"
    if last is not None:
        level, text = last.level, f"{text}, the last one: {last.message}"
    if untied:
        level, text = max(level, Level.WARN), f"{text}; velocity not used: {untied}"
    return Check("deskew", level, text, values)
