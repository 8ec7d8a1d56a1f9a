"""Device health: metadata, and checks from the counts of a period.

OK needs no attention, WARN needs a look, ERROR means that data are missing or wrong.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

import numpy as np

from l2lidar_node.clock import UNCERTAIN_NS, ClockEventKind, ClockStatus
from l2lidar_node.config import NetworkConfig
from l2lidar_node.driver.device import DeviceState
from l2lidar_node.driver.driver import Counters, Driver
from l2lidar_node.driver.orientation import GravityReport
from l2lidar_node.protocol import wire
from l2lidar_node.types import STANDARD_GRAVITY, Check, HostNs, Level, Stream, TransportCounts


@dataclass(frozen=True, slots=True)
class Metadata:
    """Facts about one device; None or empty until it has reported them.

    Attributes
    ----------
    hardware, firmware, name, date : str
    product : str
        What stands behind the date in the version packet; many units leave it empty.
    work_mode : int or None
        Bits of :class:`wire.WorkMode`.
    work_mode_names : list of str
    calibration : dict
        What the unit reports; names and units as in :data:`wire.CALIBRATION`.
    calibration_crc : str
        CRC-32 of the block that the unit reports, eight hexadecimal digits: no two units have the
        same.
    calibration_used : dict
        What its points are made with.
    calibration_source : dict
        Where each entry of that is from: ``unit``, ``parameter``, or the path of a file.
    calibration_file : str
        The file that the settings name; it is used only if ``calibration_matches``.
    calibration_matches : bool or None
        Whether the file was made for what the unit reports; None without a file or a packet.
    slots : int or None
        Slots in a packet.
    angle_min_rad, angle_increment_rad : float or None
        Of the slots along the arc.
    time_increment_s : float or None
        Between slots.
    range_min_m, range_max_m : float or None
    imu_position_m : tuple
        In the cloud frame.
    cloud_frame, imu_frame : str
    """

    hardware: str
    firmware: str
    name: str
    date: str
    product: str
    work_mode: int | None
    work_mode_names: list[str]
    calibration: dict[str, float]
    calibration_crc: str
    calibration_used: dict[str, float]
    calibration_source: dict[str, str]
    calibration_file: str
    calibration_matches: bool | None
    slots: int | None
    angle_min_rad: float | None
    angle_increment_rad: float | None
    time_increment_s: float | None
    range_min_m: float | None
    range_max_m: float | None
    imu_position_m: tuple[float, float, float]
    cloud_frame: str
    imu_frame: str


def metadata(driver: Driver) -> Metadata:
    """Return the metadata of a driver's device."""
    version, parameters = driver.version, driver.parameters
    mode = None if parameters is None else parameters.work_mode
    packet = None
    if driver.last_points is not None:
        layout = wire.POINTS_3D_PAYLOAD if driver.config.sweep.frame3d else wire.POINTS_2D_PAYLOAD
        packet = np.frombuffer(driver.last_points, layout)[0]

    block = None if packet is None else packet["calibration"].tobytes()
    file = driver.blocks.file

    def told(name: str) -> float | None:
        return None if packet is None else float(packet[name])

    return Metadata(
        hardware=version.hardware if version else "",
        firmware=version.firmware if version else "",
        name=version.name if version else "",
        date=version.date if version else "",
        product=version.reserve if version else "",
        work_mode=mode,
        work_mode_names=[]
        if mode is None
        else [bit.name or "" for bit in wire.WorkMode if bit & mode],
        calibration={}
        if packet is None
        else {name: float(packet["calibration"][name]) for name in wire.CALIBRATION.names or ()},
        calibration_crc="" if block is None else f"{zlib.crc32(block):08x}",
        calibration_used={} if block is None else driver.blocks.values(block),
        calibration_source={} if block is None else driver.blocks.sources(block),
        calibration_file=driver.config.files.calibration_file,
        calibration_matches=None if file is None or block is None else file.matches(block),
        slots=None if packet is None else int(packet["point_num"]),
        angle_min_rad=told("angle_min"),
        angle_increment_rad=told("angle_increment"),
        time_increment_s=told("time_increment"),
        range_min_m=told("range_min"),
        range_max_m=told("range_max"),
        imu_position_m=wire.IMU_POSITION_M,
        cloud_frame=driver.config.frames.cloud,
        imu_frame=driver.config.frames.imu,
    )


POINTS_3D_HZ: Final = 1 / wire.MIRROR_PERIOD_S
POINTS_2D_HZ: Final = 1 / wire.PERIOD_2D_S

_USUAL_NS: Final = 1_000_000_000  # between two instants
_RATE_TOLERANCE: Final = 0.1
_LOSS_ERROR: Final = 0.05
_HELD_ERROR: Final = 0.5
_FLOOD_HZ: Final = 1000.0  # foreign datagrams; twice what a second L2 would send
_MAX_DATAGRAM_HZ: Final = 5000.0  # ten times what an L2 sends
_MIN_VALID_SHARE: Final = 0.1
_MAX_DIRT_PERCENT: Final = 5.0
_MAX_APD_CELSIUS: Final = 80.0
_MAX_IMU_CELSIUS: Final = 85.0
_GRAVITY_TOLERANCE: Final = 0.9  # [m/s^2]; units at rest have shown 9.6 to 10.1
_CLOCK_TROUBLES: Final = {
    ClockEventKind.REBOOT: "the device restarted",
    ClockEventKind.FOREIGN_SYNC: "another host sets the device's clock",
    ClockEventKind.HOST_STEP: "this host's clock was stepped",
    ClockEventKind.EARLIER: "packets arrive earlier than before",
    ClockEventKind.CORRECTED: "stamps had been too early and were corrected",
    ClockEventKind.SILENCE: "the device was silent",
    ClockEventKind.LOST: "the device's clock was lost and locked again",
}
_LATE_NS: Final = 500_000_000  # matters to a controller that uses these data
_WRONG_GRAVITY: Final = 15.0  # [m/s^2]; the accelerometer fault shows 18 to 21
_MAX_TILT_DEG: Final = 10.0


_CALIBRATION_UNITS: Final = {
    "a_axis_dist": "m",
    "b_axis_dist": "m",
    "theta_angle_bias": "rad",
    "alpha_angle_bias": "rad",
    "beta_angle": "rad",
    "xi_angle": "rad",
    "range_bias": "counts",
    "range_scale": "m/count",
}


@dataclass(frozen=True, slots=True)
class Period:
    """Counts of the transport and the driver at one instant."""

    now: HostNs
    counters: Counters
    foreign: int
    stranger: str
    kernel_drops: int
    send_errors: int
    clock_events: dict[ClockEventKind, int]
    held: int
    stepped_ns: int


def observe(driver: Driver, transport: TransportCounts, now: HostNs) -> Period:
    """Return the counts of this instant."""
    status = driver.clock_status()
    return Period(
        now,
        driver.counters.snapshot(),
        transport.foreign,
        transport.stranger,
        transport.kernel_drops,
        transport.send_errors,
        status.events,
        status.held,
        status.stepped_ns,
    )


def elapsed_ns(before: Period, after: Period) -> int:
    """Return the time between two instants, whatever was done to the host's clock in it [ns]."""
    return after.now - before.now - (after.stepped_ns - before.stepped_ns)


def judge(driver: Driver, before: Period, after: Period) -> list[Check]:
    """Return the checks of the time between two instants."""
    elapsed = elapsed_ns(before, after)
    # Where it was set back without being noticed, nothing tells the time.
    seconds = (elapsed if elapsed > 0 else _USUAL_NS) / 1e9
    checks = [
        _device(driver, before, after, seconds),
        _link(driver.config.network, before, after, seconds),
        _clock(driver.clock_status(), driver.round_trips, before, after),
        _points(before.counters, after.counters, seconds),
    ]
    if driver.last_points is not None:
        checks.append(_hardware(driver.last_points))
        checks += _calibration(driver, driver.last_points)
    report = driver.gravity.take()
    if report is not None:
        checks.append(_imu(report))
    return checks


def _device(driver: Driver, before: Period, after: Period, seconds: float) -> Check:
    state = driver.state(after.now)
    packets = _measured(before, after)
    old, new = before.counters, after.counters
    rates = {stream: count / seconds for stream, count in packets.items()}
    values = {
        "state": state.value,
        "point packets [1/s]": f"{rates[Stream.POINTS]:.1f}",
        "IMU packets [1/s]": f"{rates[Stream.IMU]:.1f}",
        "datagrams [1/s]": f"{(new.datagrams - old.datagrams) / seconds:.1f}",
        "traffic [kB/s]": f"{(new.octets - old.octets) / seconds / 1e3:.1f}",
    }
    where = driver.config.network.where
    if state is DeviceState.WAITING:
        message = f"no data from {where} yet"
        if after.foreign > before.foreign and after.stranger:
            message += f", but from {after.stranger}: if that is the L2, set l2_ip to it"
        return Check("device", Level.ERROR, message, values)
    if state is DeviceState.STALLED:
        return Check("device", Level.ERROR, f"{where} has fallen silent", values)
    if state is DeviceState.STANDBY:
        return Check("device", Level.OK, "in standby as asked", values)
    if state is DeviceState.SPINNING_UP:
        left = driver.spin_up_left_s(after.now)
        values["seconds to go"] = f"{left:.0f}"
        message = f"spinning up, points in about {left:.0f} s" if left else "points are overdue"
        return Check("device", Level.WARN, message, values)
    if new.ignored_points > old.ignored_points and new.slots == old.slots:
        asked, measured = ("3D", "2D") if driver.config.sweep.frame3d else ("2D", "3D")
        message = f"it measures {measured} but frame3d asks for {asked}"
        return Check("device", Level.ERROR, message, values)
    nominal = POINTS_3D_HZ if driver.config.sweep.frame3d else POINTS_2D_HZ
    slow = rates[Stream.POINTS] < nominal * (1 - _RATE_TOLERANCE)
    imu_slow = 0 < rates[Stream.IMU] < wire.IMU_RATE_HZ * (1 - _RATE_TOLERANCE)
    if slow or imu_slow:
        return Check("device", Level.WARN, "streaming below its nominal rate", values)
    if not rates[Stream.IMU]:
        return Check("device", Level.WARN, "streaming points but no IMU", values)
    return Check("device", Level.OK, "streaming", values)


def _measured(before: Period, after: Period) -> dict[Stream, int]:
    def count(*kinds: wire.PacketType) -> int:
        return sum(after.counters.frames[kind] - before.counters.frames[kind] for kind in kinds)

    return {
        Stream.POINTS: count(wire.PacketType.POINTS_3D, wire.PacketType.POINTS_2D),
        Stream.IMU: count(wire.PacketType.IMU),
    }


def _link(network: NetworkConfig, before: Period, after: Period, seconds: float) -> Check:
    old, new = before.counters, after.counters
    values: dict[str, str] = {}
    lost = stale = 0
    for stream, counts in new.sequence.items():
        lost += counts.lost - old.sequence[stream].lost
        stale += counts.stale - old.sequence[stream].stale
        for name in ("lost", "late", "duplicates", "reordered", "restarts", "stale"):
            values[f"{stream.value} {name}"] = str(getattr(counts, name))
    for name, number in sorted(new.faults.items()):
        values[f"damaged: {name}"] = str(number)
    for name, number in sorted(new.rejected.items()):
        values[f"rejected: {name}"] = str(number)
    values["bytes outside packets"] = str(new.skipped_octets)
    values["stray acknowledgements"] = str(new.stray_acks)
    values["foreign datagrams"] = str(after.foreign)
    values["kernel drops"] = str(after.kernel_drops)
    values["send errors"] = str(after.send_errors)
    damaged = sum((new.faults - old.faults).values()) + sum((new.rejected - old.rejected).values())
    received = sum(_measured(before, after).values())
    drops = after.kernel_drops - before.kernel_drops
    foreign = after.foreign - before.foreign
    unsent = after.send_errors - before.send_errors
    datagrams = (new.datagrams - old.datagrams) / seconds
    is_forged = datagrams > _MAX_DATAGRAM_HZ and not network.serial_port
    is_grave = lost > _LOSS_ERROR * (received + lost)
    troubles = [
        text
        for number, text in (
            (lost, f"{lost} packets lost" + (f" in {received + lost}" if is_grave else "")),
            (damaged, f"{damaged} damaged or impossible packets"),
            (stale, f"{stale} packets from long ago dropped: a replay, or a second path?"),
            (drops, f"{drops} datagrams dropped by the kernel; raise receive_buffer_bytes"),
            (unsent, f"{unsent} commands could not be sent; check the cable and the network"),
            (foreign, _of_strangers(foreign, seconds, after.stranger)),
            (
                is_forged,
                f"{datagrams:.0f} datagrams/s claim to come from {network.l2_ip}: an L2 sends "
                "470, so another host uses its address",
            ),
        )
        if number > 0
    ]
    if troubles:
        level = Level.ERROR if is_grave else Level.WARN
        return Check("link", level, "; ".join(troubles), values)
    return Check("link", Level.OK, "no loss", values)


def _of_strangers(count: int, seconds: float, stranger: str) -> str:
    text = f"{count} datagrams of other senders refused"
    if stranger:
        text += f", the last seen from {stranger}"
    if count / seconds > _FLOOD_HZ:
        text += "; this is a flood: block it with a firewall"
    return text


def _clock(
    status: ClockStatus, round_trips: Collection[int], before: Period, after: Period
) -> Check:
    old, new = before.counters, after.counters
    unlocked = sum(new.unlocked.values()) - sum(old.unlocked.values())
    values = {
        "mode": status.mode,
        "ratio": f"{status.ratio:.7f}",
        "offset [s]": f"{status.offset_ns / 1e9:.6f}",
        "residual [ms]": f"{status.residual_ns / 1e6:.3f}",
        "uncertainty [ms]": f"{status.uncertainty_ns / 1e6:.3f}",
        "latency [ms]": f"{status.late_ns / 1e6:.3f}",
        "host clock slewed [ppm]": f"{status.slew_ppm:+.1f}",
        "path delay [ms]": f"{status.path_delay_ns / 1e6:.3f}",
        "epochs": str(status.epochs),
        "packets without stamp": str(sum(new.unlocked.values())),
        **{f"{kind.value} events": str(count) for kind, count in status.events.items()},
    }
    if round_trips:
        values |= {
            "round trip min [ms]": f"{min(round_trips) / 1e6:.3f}",
            "round trip mean [ms]": f"{sum(round_trips) / len(round_trips) / 1e6:.3f}",
            "round trip max [ms]": f"{max(round_trips) / 1e6:.3f}",
        }
    if not status.locked:
        level = Level.WARN if unlocked else Level.OK
        return Check("clock", level, "not locked yet" if unlocked else "no data yet", values)
    held, measured = after.held - before.held, sum(_measured(before, after).values())
    if held > _HELD_ERROR * measured:
        message = (
            f"{held} of {measured} packets not published: their stamps would be before earlier "
            "ones; if a clock was set back, restart the node"
        )
        return Check("clock", Level.ERROR, message, values)
    troubles = [
        text
        for kind, text in _CLOCK_TROUBLES.items()
        if after.clock_events.get(kind, 0) > before.clock_events.get(kind, 0)
    ]
    if status.uncertainty_ns > UNCERTAIN_NS:
        uncertain_ms = status.uncertainty_ns / 1e6
        troubles.append(f"every packet is delayed, stamps may be {uncertain_ms:.1f} ms off")
    if status.late_ns > _LATE_NS:
        troubles.append(
            f"packets arrive {status.late_ns / 1e9:.1f} s late; the stamps are corrected for that"
        )
    if troubles:
        return Check("clock", Level.WARN, f"locked; {', '.join(troubles)}", values)
    return Check("clock", Level.OK, "locked", values)


def _points(old: Counters, new: Counters, seconds: float) -> Check:
    slots = new.slots - old.slots
    share = (new.points - old.points) / slots if slots else 0.0
    values = {
        "sweeps [1/s]": f"{(new.sweeps - old.sweeps) / seconds:.2f}",
        "points [1/s]": f"{(new.points - old.points) / seconds:.0f}",
        "valid share [%]": f"{100 * share:.1f}",
        "empty sweeps": str(new.empty_sweeps),
        "fragments of turns dropped": str(new.fragments),
        "packets in fragments": str(new.fragment_packets),
        "points without orientation": str(new.unleveled),
    }
    if new.unleveled > old.unleveled:
        message = "imu_adjust drops points for lack of IMU data"
        return Check("points", Level.WARN, message, values)
    if not slots and new.fragments > old.fragments:
        message = "no turn was complete, and parts of turns are dropped"
        return Check("points", Level.WARN, message, values)
    if not slots:
        return Check("points", Level.OK, "no cloud was completed recently", values)
    if share < _MIN_VALID_SHARE:
        return Check(
            "points", Level.WARN, "hardly any returns; check whether the sensor is covered", values
        )
    return Check("points", Level.OK, f"{100 * share:.0f} % of the slots return", values)


def _calibration(driver: Driver, payload: bytes) -> list[Check]:
    """Return the values that replace the reported calibration, if any."""
    start = wire.DATA_INFO.itemsize + wire.INSIDE_STATE.itemsize
    reported = payload[start : start + wire.CALIBRATION.itemsize]
    blocks = driver.blocks
    sources = blocks.sources(reported)
    own = np.frombuffer(reported, wire.CALIBRATION, 1)[0]
    values = {
        f"{name} [{_CALIBRATION_UNITS[name]}]": f"{used:.7g} ({source}; reported {own[name]:.7g})"
        for (name, used), source in zip(
            blocks.values(reported).items(), sources.values(), strict=True
        )
    }
    if blocks.file is not None and not blocks.file.matches(reported):
        message = (
            f"{blocks.file.path} was made for another unit or mode: the unit's own calibration "
            "is used; run l2lidar calibrate"
        )
        return [Check("calibration", Level.ERROR, message, values)]
    others = sorted(set(sources.values()) - {"unit"})
    if not others:
        return []
    return [Check("calibration", Level.OK, f"corrected by {' and '.join(others)}", values)]


def _hardware(payload: bytes) -> Check:
    state = np.frombuffer(payload, wire.INSIDE_STATE, 1, wire.DATA_INFO.itemsize)[0]
    values = {
        "mirror period [us]": str(state["sys_rotation_period"]),
        "head period [us]": str(state["com_rotation_period"]),
        "dirt index [%]": f"{state['dirty_index']:.2f}",
        "upper link loss": f"{state['packet_lost_up']:.4f}",
        "lower link loss": f"{state['packet_lost_down']:.4f}",
        "APD temperature [degC]": f"{state['apd_temperature']:.1f}",
        "APD voltage [V]": f"{state['apd_voltage']:.2f}",
        "laser voltage [V]": f"{state['laser_voltage']:.2f}",
        "IMU temperature [degC]": f"{state['imu_temperature']:.1f}",
    }
    troubles = [
        text
        for wrong, text in (
            (state["dirty_index"] > _MAX_DIRT_PERCENT, "the cover is dirty"),
            (state["apd_temperature"] > _MAX_APD_CELSIUS, "the detector is hot"),
            (state["imu_temperature"] > _MAX_IMU_CELSIUS, "the IMU is hot"),
            (
                state["packet_lost_up"] + state["packet_lost_down"] > 0.01,
                "packets are lost inside the sensor",
            ),
            (
                not all(np.isfinite(state[name]) for name in state.dtype.names or ()),
                "it reports values that are not numbers",
            ),
        )
        if wrong
    ]
    if troubles:
        return Check("hardware", Level.WARN, "; ".join(troubles), values)
    return Check("hardware", Level.OK, "healthy", values)


def _imu(report: GravityReport) -> Check:
    values = {
        "specific force [m/s^2]": f"{report.norm:.3f}",
        "orientation against gravity [deg]": f"{report.tilt_deg:.2f}",
    }
    if report.norm > _WRONG_GRAVITY:
        message = (
            f"|a| is {report.norm:.1f} m/s^2: the accelerometer fault of a unit that was not "
            "level at power-on; power it up level and still"
        )
        return Check("imu", Level.ERROR, message, values)
    if abs(report.norm - STANDARD_GRAVITY) > _GRAVITY_TOLERANCE:
        return Check("imu", Level.WARN, f"|a| is {report.norm:.1f} m/s^2, not gravity", values)
    if report.tilt_deg > _MAX_TILT_DEG:
        message = f"the orientation is {report.tilt_deg:.0f} degrees off gravity"
        return Check("imu", Level.WARN, message, values)
    return Check("imu", Level.OK, "agrees with gravity", values)
