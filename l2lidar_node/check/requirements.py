"""Requirements of each consumer, from its source code, and findings of a check."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

from l2lidar_node.clouds import LAYOUTS
from l2lidar_node.types import Level


class Finding(NamedTuple):
    """The result of one check.

    Attributes
    ----------
    level : Level
    subject : str
        What was looked at: cloud, times, imu, frames, qos.
    check : str
        Name of the check, for programs.
    text : str
        What was found and what is required; one line.
    fix : str
        What to do; empty if nothing is needed.
    """

    level: Level
    subject: str
    check: str
    text: str
    fix: str = ""

    @property
    def line(self) -> str:
        """Everything in one line."""
        return f"{self.text}; {self.fix}" if self.fix else self.text


def ok(subject: str, check: str, text: str) -> Finding:
    """Return a finding that is fine."""
    return Finding(Level.OK, subject, check, text)


def not_judged(subject: str, check: str, text: str) -> Finding:
    """Return a finding that something could not be judged, and why."""
    return Finding(Level.OK, subject, check, f"not judged: {text}")


def worst(findings: list[Finding]) -> Level:
    """Return the worst level; OK of none."""
    return max((item.level for item in findings), default=Level.OK)


class Use(Enum):
    """Whether a consumer needs something, makes use of it, or ignores it."""

    NEEDED = Level.ERROR
    USED = Level.WARN
    IGNORED = Level.OK

    @property
    def level(self) -> Level:
        """How bad it is when it is missing."""
        return self.value


class TimeUnit(Enum):
    """How a consumer interprets the numbers of a time field."""

    S = "s after the stamp"
    NS = "ns after the stamp"
    EPOCH_S = "s since the epoch"
    EPOCH_AUTO = "s since the epoch below 1e14, else ns"  # DLIO
    SPREAD = "any unit"  # KISS-ICP and GenZ-ICP: first to last is the sweep
    RKO = "RKO-LIO's rules"
    GLIM = "GLIM's rules"


class TimeField(NamedTuple):
    """A time field that a consumer knows.

    Attributes
    ----------
    name : str
    codes : tuple of str
        Types it may have.
    unit : TimeUnit
    """

    name: str
    codes: tuple[str, ...]
    unit: TimeUnit


class Order(Enum):
    """The order of points in time that a consumer relies on."""

    ASCENDING = "ascending"
    LAST = "last"  # the last point is the latest
    ANY = "any"


class Subscription(NamedTuple):
    """QoS of a subscription.

    Attributes
    ----------
    reliability : str
        ``reliable``; ``best_effort``; ``default``, which middlewares take for either; or
        ``varies`` among versions.
    depth : int
        Length of its queue, 0 where that is not known.
    """

    reliability: str
    depth: int


_UNASKED: Final = Subscription("best_effort", 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Input:
    """One form of cloud that a consumer reads.

    Attributes
    ----------
    layout : str
        The driver's ``point_layout`` that gives it.
    fields : mapping
        Types by name of the fields it has to have.
    times : tuple of TimeField
        One of which it has to have; as the consumer prefers them.
    when : str
        The consumer's own setting for it; empty where there is no choice.
    """

    layout: str
    fields: Mapping[str, tuple[str, ...]]
    times: tuple[TimeField, ...] = ()
    when: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Consumer:
    """Requirements of one consumer.

    Attributes
    ----------
    name, title : str
        As typed and as written.
    inputs : tuple of Input
        The usual one first.
    time : Use
        Of the points' times: it deskews by itself.
    several_times : Level
        How bad a second time field is.
    constant_times : str
        What it does with times that are all the same.
    order : Order
    max_sweep_s : float
        From there on it mistakes the times.
    late_first : Level
        How bad it is that the first point is 1 ms or more after the stamp.
    is_dense : Use
        Of the cloud's word that no point is NaN.
    row_step : Use
        Of the length of a row.
    exact : bool
        It takes the layout's very bytes, not fields by name.
    contiguous : bool
        It takes y and z to follow x.
    ring_count : int
        Rows of its projection as in our configuration for it; 0 where it has none.
    fragment : Level
        How bad it is that the first cloud is part of a turn.
    moves_cloud_frame : bool
        With our configuration it makes the cloud frame the child of its odometry frame.
    imu, orientation : Use
    imu_rate_hz : float
        The least that it asks for.
    any_acceleration_unit : bool
        It scales accelerations by their mean norm.
    tf : Use
        Of transforms between the frame of the clouds, that of the IMU and the robot's.
    cloud_qos, imu_qos : Subscription
    """

    name: str
    title: str
    inputs: tuple[Input, ...]
    time: Use
    several_times: Level = Level.WARN
    constant_times: str = "does not deskew"
    order: Order = Order.ANY
    max_sweep_s: float = 1.0
    late_first: Level = Level.WARN
    is_dense: Use = Use.IGNORED
    row_step: Use = Use.USED
    exact: bool = False
    contiguous: bool = False
    ring_count: int = 0
    fragment: Level = Level.WARN
    moves_cloud_frame: bool = False
    imu: Use = Use.IGNORED
    orientation: Use = Use.IGNORED
    imu_rate_hz: float = 100.0
    any_acceleration_unit: bool = False
    tf: Use = Use.USED
    cloud_qos: Subscription
    imu_qos: Subscription = _UNASKED


_F4: Final = ("f4",)
_FLOATS: Final = ("f4", "f8")
_NUMBERS: Final = ("u4", "f4", "f8")
_XYZ: Final = {"x": _F4, "y": _F4, "z": _F4}
_XYZI: Final = {**_XYZ, "intensity": _F4}
_TIME_S: Final = TimeField("time", _F4, TimeUnit.S)
_T_NS: Final = TimeField("t", ("u4",), TimeUnit.NS)
_VELODYNE: Final = {**_XYZI, "ring": ("u2",)}
_SENSOR_DATA: Final = Subscription("best_effort", 5)


def _any_of(names: str, unit: TimeUnit) -> tuple[TimeField, ...]:
    return tuple(TimeField(name, _NUMBERS, unit) for name in names.split())


def _exactly(layout: str) -> dict[str, tuple[str, ...]]:
    """Return the fields of a layout but for the time."""
    kind = LAYOUTS[layout].without_time().dtype
    return {name: (kind[name].str[1:],) for name in kind.names or ()}


_LIO_SAM_RINGS: Final = 75  # N_SCAN of config/consumers/lio_sam, which a test holds equal

_KISS: Final = (
    Input(layout="native", fields=_XYZ, times=_any_of("t timestamp time", TimeUnit.SPREAD)),
)

_ALL: Final = (
    Consumer(
        name="lio_sam",
        title="LIO-SAM",
        inputs=(
            Input(layout="velodyne", fields=_VELODYNE, times=(_TIME_S,), when="sensor: velodyne"),
            Input(
                layout="ouster_legacy",
                fields={
                    **_XYZI,
                    "reflectivity": ("u2",),
                    "ring": ("u1",),
                    "noise": ("u2",),
                    "range": ("u4",),
                },
                times=(_T_NS,),
                when="sensor: ouster",
            ),
        ),
        time=Use.NEEDED,
        order=Order.LAST,
        is_dense=Use.NEEDED,
        ring_count=_LIO_SAM_RINGS,
        fragment=Level.ERROR,
        imu=Use.NEEDED,
        orientation=Use.NEEDED,
        imu_rate_hz=200.0,
        cloud_qos=_SENSOR_DATA,
        imu_qos=Subscription("best_effort", 2000),
    ),
    Consumer(
        name="fast_lio",
        title="FAST-LIO2",
        inputs=(
            Input(layout="velodyne", fields=_VELODYNE, times=(_TIME_S,), when="lidar_type: 2"),
            Input(
                layout="ouster_legacy",
                fields={**_XYZI, "ring": ("u1",)},
                times=(_T_NS,),
                when="lidar_type: 3",
            ),
        ),
        time=Use.NEEDED,
        constant_times="invents times from the azimuth",
        order=Order.LAST,
        imu=Use.NEEDED,
        any_acceleration_unit=True,
        cloud_qos=_SENSOR_DATA,
        imu_qos=Subscription("reliable", 10),
    ),
    Consumer(
        name="point_lio",
        title="Point-LIO",
        inputs=(
            Input(layout="unitree", fields=_VELODYNE, times=(_TIME_S,), when="lidar_type: 5"),
        ),
        time=Use.NEEDED,
        constant_times="invents times from the azimuth",
        order=Order.LAST,
        imu=Use.NEEDED,
        imu_rate_hz=200.0,
        cloud_qos=_SENSOR_DATA,
        imu_qos=Subscription("varies", 10),
    ),
    Consumer(
        name="rko_lio",
        title="RKO-LIO",
        inputs=(
            Input(
                layout="native",
                fields=_XYZ,
                times=_any_of("t timestamp time stamps", TimeUnit.RKO),
            ),
        ),
        time=Use.NEEDED,
        late_first=Level.ERROR,
        moves_cloud_frame=True,
        imu=Use.NEEDED,
        cloud_qos=Subscription("best_effort", 10),
        imu_qos=Subscription("best_effort", 100),
    ),
    Consumer(
        name="glim",
        title="GLIM",
        inputs=(
            Input(
                layout="native",
                fields={"x": _FLOATS, "y": _FLOATS, "z": _FLOATS},
                times=_any_of("t time time_stamp timestamp", TimeUnit.GLIM),
            ),
        ),
        time=Use.USED,
        order=Order.ASCENDING,
        moves_cloud_frame=True,
        imu=Use.NEEDED,
        any_acceleration_unit=True,
        cloud_qos=_SENSOR_DATA,
        imu_qos=Subscription("best_effort", 1000),
    ),
    Consumer(
        name="kiss_icp",
        title="KISS-ICP",
        inputs=_KISS,
        time=Use.USED,
        several_times=Level.ERROR,
        constant_times="aborts the process",
        contiguous=True,
        cloud_qos=_SENSOR_DATA,
    ),
    Consumer(
        name="genz_icp",
        title="GenZ-ICP",
        inputs=_KISS,
        time=Use.USED,
        several_times=Level.ERROR,
        constant_times="divides by zero",
        contiguous=True,
        cloud_qos=Subscription("reliable", 1),
    ),
    Consumer(
        name="dlio",
        title="DLIO",
        inputs=(
            Input(
                layout="velodyne",
                fields=_XYZI,
                times=(_T_NS, _TIME_S, TimeField("timestamp", ("f8",), TimeUnit.EPOCH_AUTO)),
            ),
        ),
        time=Use.USED,
        several_times=Level.ERROR,
        imu=Use.NEEDED,
        cloud_qos=Subscription("reliable", 1),
    ),
    Consumer(
        name="rtabmap",
        title="RTAB-Map",
        inputs=(
            Input(
                layout="velodyne",
                fields=_XYZ,
                times=(
                    _T_NS,
                    _TIME_S,
                    TimeField("stamps", _F4, TimeUnit.S),
                    TimeField("timestamp", ("f8",), TimeUnit.EPOCH_S),
                ),
            ),
        ),
        time=Use.USED,
        several_times=Level.ERROR,
        constant_times="refuses the cloud",
        order=Order.LAST,
        row_step=Use.NEEDED,
        imu=Use.USED,
        orientation=Use.USED,
        tf=Use.NEEDED,
        cloud_qos=Subscription("default", 1),
        imu_qos=Subscription("default", 0),
    ),
    Consumer(
        name="nav2",
        title="Nav2's costmaps",
        inputs=(Input(layout="xyzi", fields=_XYZ),),
        time=Use.IGNORED,
        tf=Use.NEEDED,
        cloud_qos=Subscription("best_effort", 50),
    ),
    Consumer(
        name="autoware",
        title="Autoware",
        inputs=(
            Input(
                layout="autoware",
                fields=_exactly("autoware"),
                times=(TimeField("time_stamp", ("u4",), TimeUnit.NS),),
            ),
        ),
        time=Use.NEEDED,
        exact=True,
        imu=Use.NEEDED,
        tf=Use.NEEDED,
        cloud_qos=_SENSOR_DATA,
        imu_qos=Subscription("reliable", 100),
    ),
)

CONSUMERS: Final[Mapping[str, Consumer]] = {consumer.name: consumer for consumer in _ALL}
"""Consumers by the name one types."""
