"""Whatever is in the messages, the checks judge it and do not raise."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from l2lidar_node.check.observation import Gathering
from l2lidar_node.check.report import judge
from l2lidar_node.check.requirements import CONSUMERS, worst
from l2lidar_node.clouds import DATATYPES, points_of
from l2lidar_node.types import Level
from tests.l2lidar_node.check import recordings

NAMES = ("x", "y", "z", "intensity", "ring", "time", "t", "timestamp", "time_stamp", "stamps", "")
numbers = st.integers(0, 40)
stamps = st.builds(
    lambda sec, nanosec: SimpleNamespace(sec=sec, nanosec=nanosec),
    st.integers(-(2**31), 2**31 - 1) | st.just(1_700_000_000),
    st.integers(0, 2**32 - 1),
)
headers = st.builds(
    lambda stamp, frame: SimpleNamespace(stamp=stamp, frame_id=frame),
    stamps,
    st.sampled_from(["", "/a", "l2lidar_link"]),
)
fields = st.builds(
    lambda name, offset, datatype, count: SimpleNamespace(
        name=name, offset=offset, datatype=datatype, count=count
    ),
    st.sampled_from(NAMES) | st.text(max_size=3),
    numbers | st.integers(0, 2**32 - 1),
    st.integers(0, 9),
    st.sampled_from([0, 1, 1, 1, 3, 2**32 - 1]),
)


@st.composite
def clouds(draw: st.DrawFn) -> Any:
    """A cloud of fields that fit, mostly, and of any bytes."""
    step = draw(st.integers(0, 48))
    width, height = draw(st.integers(0, 9)), draw(st.integers(0, 3))
    used = width * step
    row_step = draw(st.sampled_from([used, used, used, 0, used + 3, 2**32 - 1]))
    size = draw(st.sampled_from([row_step * height, used * height, 7]))
    return SimpleNamespace(
        header=draw(headers),
        height=height,
        width=draw(st.sampled_from([width, width, 2**32 - 1])),
        fields=draw(st.lists(fields, max_size=6)),
        is_bigendian=draw(st.booleans()),
        point_step=step,
        row_step=row_step,
        data=np.frombuffer(draw(st.binary(min_size=min(size, 600), max_size=600)), np.uint8),
        is_dense=draw(st.booleans()),
    )


@st.composite
def typical_clouds(draw: st.DrawFn) -> Any:
    """A cloud of the usual fields in any types, of any values."""
    names = draw(st.lists(st.sampled_from(NAMES[3:-1]), unique=True))
    codes = st.sampled_from(list(DATATYPES.values()))
    kinds = [(name, "<f4") for name in "xyz"] + [(name, f"<{draw(codes)}") for name in names]
    layout = np.dtype(kinds)
    count = draw(st.integers(0, 5))
    data = draw(st.binary(min_size=count * layout.itemsize, max_size=count * layout.itemsize))
    message = recordings.cloud(np.frombuffer(data, layout), 0)
    message.header = draw(headers)
    return message


@st.composite
def imus(draw: st.DrawFn) -> Any:
    value = st.floats(width=64) | st.sampled_from([0.0, 1.0, 9.81, math.nan, math.inf])

    def vector(names: str) -> Any:
        return SimpleNamespace(**{name: draw(value) for name in names})

    covariance = np.full(9, draw(value))
    return SimpleNamespace(
        header=draw(headers),
        orientation=vector("wxyz"),
        angular_velocity=vector("xyz"),
        linear_acceleration=vector("xyz"),
        orientation_covariance=covariance,
        angular_velocity_covariance=covariance,
        linear_acceleration_covariance=covariance,
    )


@settings(max_examples=75)
@given(
    st.lists(clouds() | typical_clouds(), max_size=4),
    st.lists(imus(), max_size=6),
    st.integers(-(2**62), 2**62),
)
def test_any_messages_are_judged(messages: list[Any], samples: list[Any], arrival: int) -> None:
    gathering = Gathering()
    for index, message in enumerate(messages):
        gathering.cloud(message, arrival + index)
    for index, sample in enumerate(samples):
        gathering.imu(sample, arrival + index)
    seen = gathering.observation()
    for consumer in CONSUMERS.values():
        for finding in judge(seen, consumer):
            assert finding.text
            assert finding.level is Level.OK or finding.fix


def test_nothing_at_all_is_not_ready() -> None:
    for consumer in CONSUMERS.values():
        assert worst(judge(Gathering().observation(), consumer)) is Level.ERROR


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"point_step": 10}, "does not fit point_step 10"),
        ({"fields": []}, "there are no fields"),
        ({"width": 10**6}, "B of data"),
        ({"row_step": 3}, "row_step 3"),
    ],
)
def test_an_impossible_cloud_is_refused_with_a_reason(change: dict[str, Any], said: str) -> None:
    message = recordings.copied(recordings.good("rko_lio")).clouds[0]
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(ValueError, match=said):
        points_of(message)


def test_rows_with_padding_are_read_without_it() -> None:
    message = recordings.copied(recordings.good("rko_lio")).clouds[0]
    whole = points_of(message)[:200]
    step = message.point_step
    rows = np.zeros((2, 100 * step + 5), np.uint8)
    rows[:, : 100 * step] = whole.view(np.uint8).reshape(2, -1)
    message.data, message.height, message.width = rows.reshape(-1), 2, 100
    message.row_step = rows.shape[1]
    assert (points_of(message) == whole).all()
