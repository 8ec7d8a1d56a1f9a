"""Tables what each consumer demands, as its source has it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from l2lidar_node.check.requirements import (
    Consumer,
    Input,
    Order,
    Subscription,
    TimeField,
    TimeUnit,
    Use,
)
from l2lidar_node.clouds.layouts import LAYOUTS
from l2lidar_node.types import Level

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
