"""Settings of the virtual L2's electronics, from addresses to faults.

Names are unique over all groups: the command line makes one option of each.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Final

from l2lidar_node.protocol import wire
from l2lidar_node.settings import Form, setting

_PRODUCT: Final = Form(re.compile(r"[ -~]{1,23}"), "a product name", "1 to 23 ASCII characters")
_DATE: Final = Form(re.compile(r"[0-9]{6}"), "a date", "six digits such as 250715")


@dataclass(frozen=True, slots=True, kw_only=True)
class AddressConfig:
    """Factory network settings of the unit; commands 108 and 109 replace them."""

    lidar_ip: str = setting("127.0.0.1", "address the virtual L2 sends from and listens on")
    lidar_port: int = setting(
        wire.LIDAR_PORT,
        "UDP port the virtual L2 sends from and listens on, 0 = any free one",
        lo=0,
        hi=65535,
    )
    host: str = setting("127.0.0.1", "address the measurements are sent to")
    host_port: int = setting(
        wire.HOST_PORT, "UDP port the measurements are sent to", lo=1, hi=65535
    )
    reply_to_sender: bool = setting(
        False, "send to the sender of the last command instead of the stored host"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PowerConfig:
    """Start-up times, from power-on and from standby."""

    boot_scale: float = setting(
        1.0, "factor on all times of this group, 0 = no delays", lo=0.0, hi=10.0
    )
    link_s: float = setting(2.0, "power-on to the first command heard", unit="s", lo=0.0, hi=60.0)
    imu_s: float = setting(4.0, "power-on to the first IMU packet", unit="s", lo=0.0, hi=60.0)
    points_s: float = setting(
        25.0, "power-on to the first point packet", unit="s", lo=0.0, hi=120.0
    )
    wake_imu_s: float = setting(
        1.0, "start command to the first IMU packet", unit="s", lo=0.0, hi=60.0
    )
    wake_points_s: float = setting(
        15.0, "start command to the first point packet", unit="s", lo=0.0, hi=120.0
    )
    wakes: bool = setting(
        True, "whether a start command ends standby; some units need a power cycle instead"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentityConfig:
    """Identity that the unit reports."""

    hardware: str = setting("2.2.1.1", "hardware version, four numbers")
    firmware: str = setting("2.8.11.1", "firmware version, four numbers")
    product: str = setting("YS-L2", "product name, 1 to 23 ASCII characters", form=_PRODUCT)
    firmware_date: str = setting("250715", "firmware date as yymmdd", form=_DATE)
    mac: str = setting("4c:32:01:00:00:62", "hardware address the unit leaves the factory with")
    work_mode: int = setting(
        0,
        "work mode stored in a new unit's flash, bits of wire.WorkMode",
        lo=0,
        hi=wire.WORK_MODE_MASK,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class CrystalConfig:
    """Rate of the unit's clock: (1 + ppm(t) / 1e6) / clock_ratio, t from power-on."""

    clock_ratio: float = setting(
        1.99866, "true seconds per second of the unit's clock", lo=0.5, hi=3.0
    )
    clock_drift_ppm_per_h: float = setting(
        0.0, "steady change of the clock's rate", unit="ppm/h", lo=-1e4, hi=1e4
    )
    clock_wave_ppm: float = setting(
        0.0,
        "amplitude of a slow oscillation of the clock's rate, as caused by temperature",
        unit="ppm",
        lo=0.0,
        hi=1e3,
    )
    clock_wave_s: float = setting(600.0, "period of that oscillation", unit="s", lo=1.0, hi=1e5)


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayConfig:
    """Delays from measurement to transmission.

    A point packet is stamped at its first slot and leaves ``points_delay_us`` after its last slot
    was measured; an IMU packet is stamped at the sample and leaves ``imu_delay_us`` later.
    """

    points_delay_us: float = setting(
        150.0, "last slot measured to packet sent", unit="us", lo=0.0, hi=1e5
    )
    imu_delay_us: float = setting(150.0, "IMU sampled to packet sent", unit="us", lo=0.0, hi=1e5)
    reply_delay_us: float = setting(
        250.0, "command heard to answer sent", unit="us", lo=0.0, hi=1e5
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultConfig:
    """Faults and how often they occur.

    Everything is off by default. Probabilities are per datagram, those of damage per packet.
    """

    fault_from_s: float = setting(
        0.0, "no random fault before this time after power-on", unit="s", lo=0.0, hi=1e9
    )
    fault_until_s: float = setting(
        1e9, "no random fault after this time after power-on", unit="s", lo=0.0, hi=1e9
    )

    bad_crc: float = setting(0.0, "probability that one bit of the payload flips", lo=0.0, hi=1.0)
    truncate: float = setting(
        0.0, "probability that the end of a packet is missing", lo=0.0, hi=1.0
    )
    hostile_size: float = setting(
        0.0, "probability that the size field is 12, 24, 10001 or 0xFFFFFFFF", lo=0.0, hi=1.0
    )
    hostile_count: float = setting(
        0.0,
        "probability that a point packet claims 301 (2D: 1801) or 2^32-1 points, CRC right",
        lo=0.0,
        hi=1.0,
    )
    nan: float = setting(
        0.0,
        "probability that one float of a measurement is not a number, CRC right",
        lo=0.0,
        hi=1.0,
    )
    garbage: float = setting(
        0.0, "probability that a datagram of random bytes precedes a packet", lo=0.0, hi=1.0
    )

    coalesce: float = setting(
        0.0,
        "probability that a packet waits for the next one and shares its datagram",
        lo=0.0,
        hi=1.0,
    )
    split: float = setting(
        0.0, "probability that a datagram is cut at a random byte into two", lo=0.0, hi=1.0
    )

    loss: float = setting(0.0, "probability that a datagram is lost", lo=0.0, hi=1.0)
    command_loss: float = setting(
        0.0, "probability that a datagram from the host is lost", lo=0.0, hi=1.0
    )
    duplicate: float = setting(0.0, "probability that a datagram arrives twice", lo=0.0, hi=1.0)
    silence_at: tuple[float, ...] = setting(
        (), "times after power-on at which the cable is pulled", unit="s", lo=0.0
    )
    silence_s: float = setting(2.0, "how long the cable stays pulled", unit="s", lo=0.0, hi=1e6)

    jitter: str = setting(
        "none",
        "distribution of an additional path delay: even, or mostly nothing with a heavy tail; "
        "datagrams keep their order",
        choices=("none", "uniform", "heavy"),
    )
    jitter_ms: float = setting(
        0.5,
        "width of that delay: the maximum (uniform) or the 99th percentile (heavy)",
        unit="ms",
        lo=0.0,
        hi=1e3,
    )
    burst_ms: float = setting(
        0.0,
        "duration for which datagrams are withheld and then arrive at once, 0 = never",
        unit="ms",
        lo=0.0,
        hi=1e4,
    )
    burst_every_s: float = setting(1.0, "interval between such bursts", unit="s", lo=0.001, hi=1e5)
    reorder: float = setting(
        0.0,
        "probability that a datagram arrives reorder_ms late, after later ones",
        lo=0.0,
        hi=1.0,
    )
    reorder_ms: float = setting(
        10.0, "how late a reordered datagram is", unit="ms", lo=0.0, hi=1e3
    )

    reboot_at: tuple[float, ...] = setting(
        (), "times after power-on at which the unit restarts by itself", unit="s", lo=0.0
    )
    clock_step_at: tuple[float, ...] = setting(
        (), "times after power-on at which the unit's clock jumps", unit="s", lo=0.0
    )
    clock_step_ms: float = setting(
        -50.0, "how far the unit's clock jumps", unit="ms of the unit's clock", lo=-1e9, hi=1e9
    )
    foreign_sync_at: tuple[float, ...] = setting(
        (), "times after power-on at which another host sets the unit's clock", unit="s", lo=0.0
    )
    foreign_sync_error_s: float = setting(
        5.0, "how far that other host's clock is ahead of ours", unit="s", lo=-1e9, hi=1e9
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceConfig:
    """All settings of the virtual unit except its world."""

    addresses: AddressConfig = field(default_factory=AddressConfig)
    power: PowerConfig = field(default_factory=PowerConfig)
    identity: IdentityConfig = field(default_factory=IdentityConfig)
    crystal: CrystalConfig = field(default_factory=CrystalConfig)
    delays: DelayConfig = field(default_factory=DelayConfig)
    faults: FaultConfig = field(default_factory=FaultConfig)
    seed: int = setting(0, "seed of everything random", lo=0, hi=2**63 - 1)
