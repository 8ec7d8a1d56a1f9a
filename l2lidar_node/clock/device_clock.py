"""Device clock: maps device stamps to host stamps, and reports lock and clock events.

Two models in series. :class:`DeviceClockModel` takes the steps out of the stamps, so
that both streams share one even device time whatever syncs and reboots do. :class:`HostClockModel`
maps that to the host's clock (:mod:`l2lidar_node.clock.lower_envelope` has the estimator, and why
it is not a Kalman filter).
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from enum import Enum
from typing import Final

from l2lidar_node.clock.cadence import Cadence
from l2lidar_node.clock.device_clock_model import DeviceClockModel, Step
from l2lidar_node.clock.host_clock_model import HostClockModel
from l2lidar_node.config import ClockConfig
from l2lidar_node.types import DeviceNs, HostNs, Stream

_AGAIN_NS: Final = (
    1_000_000_000  # a single sync that did not take effect is repeated after this long
)
_SLACK_NS: Final = 50_000_000
_END_NS: Final = (1 << 32) * 1_000_000_000  # the device counts seconds in 32 bits
_FASTEST: Final = 2  # device seconds per true second, at most


class SyncSchedule:
    """When to send a time-sync command: never, until one took effect, or periodically.

    Attributes
    ----------
    in_force : bool
        Whether the device's clock counts from a sync of this host; always true if none is wanted.
    """

    def __init__(self, config: ClockConfig) -> None:
        self._wanted = config.enable_l2_host_sync
        self._once = config.l2_sync_mode == "once"
        interval = config.l2_sync_rate_ms * 1_000_000
        self._interval = max(interval, _AGAIN_NS) if self._once else interval
        self.reset()

    def reset(self) -> None:
        """Start over, as with a device that has just started."""
        self.in_force = not self._wanted
        self._sent: HostNs | None = None
        self._value = HostNs(0)

    def due(self, now: HostNs) -> bool:
        """Return whether a sync should be sent now; never where the device's clock has no room."""
        if not 0 <= now < _END_NS or not self._wanted or (self._once and self.in_force):
            return False
        return self._sent is None or not 0 <= now - self._sent < self._interval

    def sent(self, value: HostNs, sent: HostNs) -> None:
        """Record a sync that was sent."""
        self._value = value
        self._sent = sent

    def host_stepped(self, by_ns: int) -> None:
        """Record a step of the host's clock."""
        if self._sent is not None:
            self._sent = HostNs(self._sent + by_ns)

    def seen(self, stamp: int, arrival: int) -> None:
        """Look at a stamp: a sync is in force when it counts from the value that was sent."""
        if self.in_force or self._sent is None:
            return
        elapsed = arrival - self._sent
        since = stamp - self._value
        self.in_force = 0 <= since <= _FASTEST * elapsed + _SLACK_NS


UNCERTAIN_NS: Final = 1_000_000
"""Uncertainty from which users should know: at 1 m/s it moves points by 1 mm."""

_SILENCE_NS: Final = 1_000_000_000
_QUIET_NS: Final = 5_000_000_000  # between reports of the same kind
_AHEAD_NS: Final = 1_000_000_000  # system time: how far stamps may be ahead of arrivals
_ROUND_TRIPS: Final = 16
_EVENTS: Final = 64


class ClockEventKind(Enum):
    """Kinds of clock events."""

    LOCKED = "locked"
    REBOOT = "reboot"
    FOREIGN_SYNC = "foreign sync"
    HOST_STEP = "host step"
    EARLIER = "earlier arrivals"
    CORRECTED = "correction"
    UNCERTAIN = "uncertain"
    SILENCE = "silence"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class ClockEvent:
    """An event of one of the clocks, with a text for the log."""

    kind: ClockEventKind
    text: str


@dataclass(frozen=True, slots=True)
class ClockStatus:
    """Status of the device's clock.

    Attributes
    ----------
    locked : bool
        Whether stamps can be trusted.
    mode : str
        What stamps are made of: ``estimated``, ``device`` or ``system``.
    ratio : float
        Host nanoseconds per device nanosecond; the first guess until locked.
    offset_ns : int
        Host time minus device stamp of the latest packet.
    residual_ns : int
        Median height of the fitted packets above the line: how much arrivals vary.
    uncertainty_ns : int
        By how much stamps may be off, the constant part of the path delay aside; grows while the
        path delays every packet.
    late_ns : int
        How late even the least delayed of the latest packets was, beyond the path's constant part.
    slew_ppm : float
        How fast time servers are slewing the host's clock, where that is told [ppm].
    path_delay_ns : int
        Half the shortest measured round trip, which is taken off every stamp; 0 if not measured.
    synced : bool
        Whether a sync of this host is in force in the device.
    stepped_ns : int
        By how much the host's clock was set since the start.
    epochs : int
        Steps of the device's clock that were bridged.
    held : int
        Packets without a stamp because it would have been before an earlier one of the stream.
    unlocked : int
        Packets without a stamp because it would have been doubtful.
    events : dict
        How often each kind of event happened.
    """

    locked: bool
    mode: str
    ratio: float
    offset_ns: int
    residual_ns: int
    uncertainty_ns: int
    late_ns: int
    slew_ppm: float
    path_delay_ns: int
    synced: bool
    stepped_ns: int
    epochs: int
    held: int
    unlocked: int
    events: dict[ClockEventKind, int]


class _Mode(Enum):
    ESTIMATED = "estimated"
    DEVICE = "device"
    SYSTEM = "system"


# These begin a time line; a follower needs all of them.
_RARE: Final = frozenset({ClockEventKind.LOCKED, ClockEventKind.REBOOT, ClockEventKind.LOST})

# To look up a member of an Enum takes long.
_ESTIMATED, _DEVICE, _SYSTEM = _Mode.ESTIMATED, _Mode.DEVICE, _Mode.SYSTEM


class DeviceClock:
    """The device's clock as seen from the host.

    Pure: time only passes through the arguments, so a recording gives the same stamps as the live
    device.

    Parameters
    ----------
    config : ClockConfig

    Attributes
    ----------
    happened : deque of ClockEvent
        What :meth:`events` will return; only to be read.

    Notes
    -----
    Stamps of a stream never go backwards and are never after the packet's arrival. Where both
    are impossible, after the host's clock was set back, packets get no stamp until it has passed
    the latest one. Stamps that count from the device's power-on begin anew when it restarts.

    System time tells nothing about packets that arrive at once. They follow each other without
    overlap, and so their measurements may end up to 1 s after the arrival; packets beyond that
    get no stamp.
    """

    def __init__(self, config: ClockConfig) -> None:
        self._guess = config.time_scale_num / config.time_scale_denom
        self._schedule = SyncSchedule(config)
        self.happened: deque[ClockEvent] = deque(maxlen=_EVENTS)
        self._counts: Counter[ClockEventKind] = Counter()
        self._reported: dict[ClockEventKind, tuple[int | None, int]] = {}
        self._now = 0  # arrival of the latest packet
        self._stepped_ns = 0
        self._held = 0
        self._unlocked = 0
        self._begin_stamps()
        self.configure(config)
        self.reset()

    def configure(self, config: ClockConfig) -> None:
        """Use another value of the live settings from the next packet on."""
        self._config = config
        if config.use_system_time:
            self._mode = _Mode.SYSTEM
        elif config.enable_l2_time_correction:
            self._mode = _Mode.ESTIMATED
        else:
            self._mode = _Mode.DEVICE

    def reset(self) -> None:
        """Forget the device; stamps still never go backwards."""
        self._host = HostClockModel(self._guess)
        self._device = DeviceClockModel(self._guess, self._host.lateness)
        self._restarts = 0
        self._schedule.reset()
        self._last_u: int | None = None
        self._is_certain = True
        self._offset = 0
        self._round_trips: deque[int] = deque(maxlen=_ROUND_TRIPS)

    def observe(
        self,
        stream: Stream,
        seq: int,
        stamp: DeviceNs,
        arrival: HostNs,
        duration_ns: int = 0,
    ) -> HostNs | None:
        """Return the host instant of a packet's stamp.

        Parameters
        ----------
        stream : Stream
            Whose packet it is; each stream's come in the order of their numbers.
        seq : int
            Its sequence number.
        stamp : DeviceNs
            What the device's clock showed at the first measurement.
        arrival : HostNs
            When it reached this host.
        duration_ns : int
            True time from the first to the last measurement in it; it cannot have left before.

        Returns
        -------
        HostNs or None
            After every earlier one of the stream and at least ``duration_ns`` before ``arrival``,
            with system time up to 1 s later. None while no trustworthy stamp can be told, see
            :class:`ClockStatus`.
        """
        host = self._host
        device = self._device
        left = arrival - duration_ns
        self._now = arrival
        u = device.place(stream, seq, stamp, arrival)
        if u is None:
            self._notice()
        elif device.is_firm:
            host.add(u, left)
            if u >= host.due:
                self._update(u, stamp, arrival)
        mode = self._mode
        if mode is _ESTIMATED:
            if u is not None and host.ready:
                result = host.at(u)
                if result > left:
                    result = left
            elif self._config.publish_unlocked:
                result = left
            else:
                self._unlocked += 1
                return None
        elif mode is _SYSTEM:
            # Points of packets that arrive at once must not overlap, nor stay behind a clock that
            # was set back.
            result = max(left, self._ends[stream] + 1)
            if result > left + _AHEAD_NS:
                self._held += 1
                return None
        else:
            if not (self._schedule.in_force or self._config.publish_unlocked):
                self._unlocked += 1
                return None
            result = min(stamp, left)
        if result <= self._last[stream]:
            self._held += 1
            return None
        self._last[stream] = result
        self._ends[stream] = result + duration_ns
        return HostNs(result)

    def interchangeable(self) -> tuple[DeviceNs, Cadence] | None:
        """Return while it does not matter which stream's packets are observed first.

        Returns
        -------
        tuple of (DeviceNs, Cadence) or None
            Stamp up to which it does not as long as the cadence, a copy of that of the points,
            predicts each of them, and :meth:`predicts_imu` each IMU sample. None where it does.
        """
        forecast = self._device.forecast() if self._host.ready else None
        if forecast is None:
            return None
        until = min(self._host.due + forecast.base, forecast.end)
        return DeviceNs(until), forecast.cadence

    def predicts_imu(self, seq: int, stamp: DeviceNs) -> bool:
        """Tell whether an IMU sample is the predicted next one, see :meth:`interchangeable`."""
        return self._device.predicts_imu(seq, stamp)

    def synced(self, value: HostNs, sent: HostNs) -> None:
        """Record that a time-sync command with this value was sent at ``sent``."""
        self._schedule.sent(value, sent)
        self._device.synced(value, sent)

    def host_stepped(self, by_ns: int, at: HostNs) -> None:
        """Record a step of the host's clock.

        Parameters
        ----------
        by_ns : int
            0 says that steps are told from here on: then none is inferred from arrivals.
        at : HostNs
            What it showed when that was noticed.
        """
        if by_ns:
            self._schedule.host_stepped(by_ns)
            self._device.host_stepped(by_ns, at)
            self._report_step(by_ns, is_told=False)
        self._host.stepped(by_ns, at)

    def host_slewed(self, by_ns: int, at: HostNs) -> None:
        """Record the total slewing of the host's clock at ``at`` [ns].

        To be called whenever the last two calls do not predict it. From the first call on, slewing
        is not inferred from arrivals.
        """
        self._host.slewed(by_ns, at)

    def sync_due(self, now: HostNs) -> bool:
        """Return whether a time-sync command should be sent now."""
        return self._schedule.due(now)

    def round_trip(self, rtt_ns: int) -> None:
        """Take a measured time from a latency request to its echo [ns]."""
        if rtt_ns < 0 or not self._config.enable_latency_measure:
            return
        self._round_trips.append(rtt_ns)
        self._host.advance_ns = min(self._round_trips) // 2

    def status(self) -> ClockStatus:
        """Return the present status."""
        line = self._host.line
        return ClockStatus(
            locked=self._locked,
            mode=self._mode.value,
            ratio=line.ratio,
            offset_ns=self._offset,
            residual_ns=round(line.excess),
            uncertainty_ns=round(self._host.uncertainty_ns),
            late_ns=self._host.late_ns,
            slew_ppm=1e6 * self._host.slew_rate,
            path_delay_ns=self._host.advance_ns,
            synced=self._schedule.in_force,
            stepped_ns=self._stepped_ns,
            epochs=self._device.epochs,
            held=self._held,
            unlocked=self._unlocked,
            events=dict(self._counts),
        )

    def events(self) -> list[ClockEvent]:
        """Return the events since the last call, oldest first."""
        happened = list(self.happened)
        self.happened.clear()
        return happened

    def _begin_stamps(self) -> None:
        self._last = {Stream.IMU: 0, Stream.POINTS: 0}
        self._ends = {Stream.IMU: 0, Stream.POINTS: 0}  # of the last packet's measurements

    @property
    def _locked(self) -> bool:
        if self._mode is _ESTIMATED:
            return self._host.ready
        return self._mode is _SYSTEM or self._schedule.in_force

    def _update(self, u: int, stamp: int, arrival: int) -> None:
        """Do what need not be done for every packet."""
        host = self._host
        was_ready = host.ready
        host.update(u)
        self._schedule.seen(stamp, arrival)
        self._device.ratio = host.line.ratio
        if not host.ready:
            return
        self._offset = host.at(u) - stamp
        if not was_ready:
            self._report(ClockEventKind.LOCKED, f"locked, clock ratio {host.line.ratio:.6f}")
        if self._last_u is not None and (u - self._last_u) * host.line.ratio > _SILENCE_NS:
            seconds = (u - self._last_u) * host.line.ratio * 1e-9
            self._report(ClockEventKind.SILENCE, f"device was silent for {seconds:.1f} s")
        self._last_u = u
        while host.steps:
            self._report_step(host.steps.popleft(), is_told=host.is_told)
        self._watch_uncertainty()
        self._notice()

    def _notice(self) -> None:
        """Report what the device line noticed, and begin anew where it does."""
        device = self._device
        while device.steps:
            step, change = device.steps.popleft()
            if step is not Step.FOREIGN_SYNC:
                self._schedule.reset()
            if step is Step.REBOOT:
                self._report(ClockEventKind.REBOOT, "device restarted, locking the clock again")
                if self._mode is _DEVICE and not self._config.enable_l2_host_sync:
                    # Its clock is below all earlier stamps for as long as it had been on.
                    self._begin_stamps()
            elif step is Step.FOREIGN_SYNC:
                self._host.reanchor()
                self._report(
                    ClockEventKind.FOREIGN_SYNC,
                    f"another host stepped the device's clock by {change * 1e-9:+.3f} s",
                )
            else:
                self._report(
                    ClockEventKind.LOST, "lost track of the device's clock, locking again"
                )
        if device.restarts != self._restarts:
            self._restarts = device.restarts
            self._host.reset()
            self._last_u = None

    def _watch_uncertainty(self) -> None:
        """Report when stamps become uncertain, once until they are certain again."""
        uncertainty = self._host.uncertainty_ns
        if self._is_certain and uncertainty > UNCERTAIN_NS:
            self._is_certain = False
            text = f"every packet is delayed, stamps may be {uncertainty * 1e-6:.1f} ms off"
            self._report(ClockEventKind.UNCERTAIN, text)
        elif uncertainty < 0.5 * UNCERTAIN_NS:
            self._is_certain = True

    def _report_step(self, step: int, *, is_told: bool) -> None:
        """Report a step of published stamps; where steps are told, arrivals show only delays."""
        if not is_told:
            self._stepped_ns += step
            text = f"host clock stepped by {step * 1e-9:+.3f} s{_hold(step)}"
            self._report(ClockEventKind.HOST_STEP, text)
        elif step < 0:
            text = f"packets arrive {-step * 1e-9:.3f} s earlier than before{_hold(step)}"
            self._report(ClockEventKind.EARLIER, text)
        else:
            text = f"stamps were {step * 1e-6:.1f} ms too early because of delayed packets"
            self._report(ClockEventKind.CORRECTED, text)

    def _report(self, kind: ClockEventKind, text: str) -> None:
        """Count what happened and report it, what keeps happening once every few seconds."""
        self._counts[kind] += 1
        if kind not in _RARE:
            at, more = self._reported.get(kind, (None, 0))
            if at is not None and 0 <= self._now - at < _QUIET_NS:
                self._reported[kind] = (at, more + 1)
                return
            if more:
                text = f"{text} (and {more} more since the last report)"
            self._reported[kind] = (self._now, 0)
        self.happened.append(ClockEvent(kind, text))


def _hold(step: int) -> str:
    return f", stamps are held for {-step * 1e-9:.3f} s" if step < 0 else ""
