"""Values that flow between modules; imports nothing of this package."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Final, NamedTuple, NewType, Protocol

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

STANDARD_GRAVITY: Final = 9.80665
"""Standard acceleration of gravity [m/s^2], ISO 80000-3."""

HostNs = NewType("HostNs", int)
"""Nanoseconds since the Unix epoch on the host's clock."""

DeviceNs = NewType("DeviceNs", int)
"""Nanoseconds on the sensor's own clock, which runs at about half speed and steps."""

FIRST_STAMP: Final = HostNs(-(1 << 31) * 1_000_000_000)
LAST_STAMP: Final = HostNs((1 << 31) * 1_000_000_000 - 1)
"""2038-01-19 03:14:07.999999999 UTC: seconds of ROS 2 stamps have 32 bits."""


class StampError(ValueError):
    """A time outside the range of ROS stamps; the message says which."""


new_tuple = tuple.__new__
"""Makes a named tuple of a class and a tuple.

What is made hundreds of times a second is made so: the constructor is a function of Python.
"""


def is_ros_time(stamp: int) -> bool:
    """Return whether a ROS stamp can hold an instant [ns]: those from 1901 to 2038."""
    return FIRST_STAMP <= stamp <= LAST_STAMP


def split_stamp(stamp: int) -> tuple[int, int]:
    """Return seconds and nanoseconds of a ROS stamp.

    Raises
    ------
    StampError
        If a ROS stamp cannot hold the instant.
    """
    if not is_ros_time(stamp):
        raise StampError(
            f"the time {stamp / 1e9:.3f} s after 1970 is out of range: ROS 2 stamps cover "
            "1901-12-13 to 2038-01-19"
        )
    return divmod(int(stamp), 1_000_000_000)


POINT: Final = np.dtype(
    [
        ("x", "<f4"),  # [m] cloud frame
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "<f4"),  # [1] 0..255
        ("range", "<f4"),  # [m] calibrated
        ("time", "<f4"),  # [s] after Sweep.start
    ]
)
"""One measured point, 24 bytes. An array of points is in ascending order of ``time``."""

IMU_SAMPLE: Final = np.dtype(
    [
        ("stamp", "<i8"),  # [ns] host clock
        ("orientation_wxyz", "<f8", (4,)),  # unit quaternion, IMU to a z-up world, yaw arbitrary
        ("angular_velocity", "<f8", (3,)),  # [rad/s] IMU frame
        ("linear_acceleration", "<f8", (3,)),  # [m/s^2] IMU frame, specific force, +g up at rest
    ]
)
"""One IMU sample; an array of samples is in strictly ascending order of ``stamp``."""

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Level(IntEnum):
    """Severity, with the numbers of ``diagnostic_msgs/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Check:
    """Result of one check.

    Attributes
    ----------
    name : str
    level : Level
    message : str
        One sentence.
    values : dict
        Figures by name, the unit in the name.
    """

    name: str
    level: Level
    message: str
    values: dict[str, str]


class Stream(Enum):
    """The two streams of measurements that carry sequence numbers and device stamps."""

    POINTS = "points"
    IMU = "imu"

    __hash__ = object.__hash__  # by identity: members are keys that every packet looks up


class ImuSample(NamedTuple):
    """One IMU sample on the host's time line; fields as in :data:`IMU_SAMPLE`."""

    stamp: HostNs
    orientation_wxyz: Quaternion
    angular_velocity: Vector3
    linear_acceleration: Vector3


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """The points of consecutive packets, on the host's time line.

    Attributes
    ----------
    start : HostNs
        Instant of the first kept point, whose ``time`` is 0.
    end : HostNs
        Instant at which the last packet's last slot was measured; no point is later.
    points : ndarray, shape (N,), dtype POINT
        Cloud frame, ``time`` ascending, finite, read-only.
    packets : int
        Packets that were aggregated.
    missing : int
        Packets that the sequence numbers say are missing within the sweep.
    """

    start: HostNs
    end: HostNs
    points: NDArray[np.void]
    packets: int
    missing: int


class Datagram(NamedTuple):
    """Bytes with the host time at which they arrived."""

    data: bytes
    arrival: HostNs


NOT_AWAITED: Final = HostNs(0)
"""Instead of the time at which a datagram is expected: unknown."""


class TransportCounts(Protocol):
    """Counts of a transport."""

    @property
    def foreign(self) -> int:
        """Datagrams of other senders than the device, dropped."""

    @property
    def stranger(self) -> str:
        """Address of the last other sender; empty if there was none."""

    @property
    def kernel_drops(self) -> int:
        """Datagrams that were dropped because they were not read in time."""

    @property
    def send_errors(self) -> int:
        """Frames to the device that could not be sent."""


class Transport(TransportCounts, Protocol):
    """Source and sink of bytes."""

    def receive(self, timeout_s: float, awaited: HostNs = NOT_AWAITED) -> list[Datagram]:
        """Return what has arrived, waiting at most ``timeout_s`` for the first datagram.

        ``awaited`` is when the next datagram that matters is expected.
        """

    def send(self, frame: bytes) -> None:
        """Send one frame to the device."""

    def close(self) -> None:
        """Release what is held; may be called more than once."""
