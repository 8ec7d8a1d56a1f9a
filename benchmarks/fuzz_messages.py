"""Hostile messages for the nodes: wrong fields, frames, numbers, stamps, sizes, and raw bytes."""

from __future__ import annotations

import math
import random
import time
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import Imu, PointCloud2, PointField
from tf2_msgs.msg import TFMessage

CLOUD_FRAME: Final = "l2lidar_link"
IMU_FRAME: Final = "l2lidar_imu"
NUMBERS: Final = (
    0.0, -0.0, 1.0, -1.0, 1e-300, 1e30, -1e30, 1.7e308, math.nan, math.inf, -math.inf,
)  # fmt: skip
TEXTS: Final = ("", ".", "..", "/", "/etc/passwd", "a/b", "~/x", "\N{SNOWMAN}", "x" * 300, "\n")
_YEAR_S: Final = 365 * 86_400
_KINDS: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


class HostileMessages:
    """Makes messages that no sensor sends.

    Parameters
    ----------
    rng : random.Random
    """

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng

    def number(self) -> float:
        """Return any number."""
        rng = self.rng
        return rng.choice((rng.choice(NUMBERS), rng.gauss(0.0, 10.0), rng.uniform(-1e6, 1e6)))

    def frame(self) -> str:
        """Return the name of a frame, a likely one or any text."""
        return self.rng.choice((CLOUD_FRAME, CLOUD_FRAME, IMU_FRAME, "odom", *TEXTS))

    def raw(self) -> bytes:
        """Return bytes that are no message."""
        return b"\0\1\0\0" + self.rng.randbytes(self.rng.choice((0, 4, 40, 400)))

    def _stamp(self, header: Any) -> None:
        """Set a stamp: about now, years off, at the ends of time, not normalized."""
        rng = self.rng
        now = time.time() + rng.choice((0.0, 0.0, rng.gauss(0.0, 1.0), rng.gauss(0.0, 1e4),
                                        rng.uniform(-60.0, 60.0) * _YEAR_S))  # fmt: skip
        ends = (-(2**31), -1, 0, 2**31 - 1)
        seconds = rng.choice((int(now), int(now), int(now), rng.choice(ends)))
        header.stamp.sec = min(max(seconds, -(2**31)), 2**31 - 1)
        header.stamp.nanosec = rng.choice((0, rng.randrange(10**9), 2**32 - 1))

    def cloud(self) -> PointCloud2:
        """Return a cloud."""
        rng = self.rng
        names = rng.choice((
            ["x", "y", "z", "time"], ["x", "y", "z", "intensity", "t"], ["range", "azimuth"],
            ["x", "y", "z", "timestamp"], ["x", "y", "time"], ["x", "y", "z", "time", "t"],
            ["x", "y", "z"], [rng.choice(TEXTS), "x"], [],
        ))  # fmt: skip
        message = PointCloud2()
        message.header.frame_id = self.frame()
        self._stamp(message.header)
        count = rng.choice((0, 1, 2, 100, 5000))
        offset, kinds = 0, []
        for name in names:
            number = rng.choice((7, 7, 7, 8, rng.choice((1, 2, 3, 4, 5, 6, 99))))
            message.fields.append(PointField(name=name, offset=offset, datatype=number, count=1))
            kinds.append(_KINDS.get(number, "u4"))
            offset += np.dtype(kinds[-1]).itemsize
        if names and offset:
            message.data = self._points(names, kinds, count).tobytes()
        message.point_step = rng.choice((offset, offset, offset, 0, 2**32 - 1))
        message.width = rng.choice((count, count, count, 2**31))
        message.height = rng.choice((1, 1, 1, 0, 2**31))
        message.row_step = rng.choice((offset * count, offset * count, 0, 2**32 - 1))
        message.is_bigendian = rng.random() < 0.1
        return message

    def _points(self, names: list[str], kinds: list[str], count: int) -> NDArray[np.void]:
        rng = np.random.default_rng(self.rng.randrange(2**32))
        layout = [(f"{number}", kind) for number, kind in enumerate(kinds)]
        points = np.zeros(count, dtype=layout)
        with np.errstate(all="ignore"):
            for number, name in enumerate(names):
                if name in ("time", "t", "timestamp"):
                    length = self.rng.choice((0.0, 0.2, 20.0, 90.0, 1e9, -1.0))
                    values = np.linspace(0.0, length, count)
                else:
                    values = rng.normal(0.0, self.rng.choice((0.0, 5.0, 5.0, 1e8)), count)
                if count and self.rng.random() < 0.3:
                    values[rng.integers(count)] = self.number()
                points[f"{number}"] = values.astype(kinds[number])
        return points

    def sample(self) -> Imu:
        """Return an IMU sample."""
        message = Imu()
        message.header.frame_id = self.rng.choice((IMU_FRAME, IMU_FRAME, self.frame()))
        self._stamp(message.header)
        for vector in (message.angular_velocity, message.linear_acceleration):
            vector.x, vector.y, vector.z = (self.number() for _ in "xyz")
        message.orientation.w = self.number()
        return message

    def transforms(self) -> TFMessage:
        """Return transforms."""
        message = TFMessage()
        for _ in range(self.rng.choice((0, 1, 1, 3))):
            item = TransformStamped(child_frame_id=self.frame())
            item.header.frame_id = self.frame()
            q, p = item.transform.rotation, item.transform.translation
            q.w = self.rng.choice((1.0, self.number()))
            q.x, p.x, p.y, p.z = (self.rng.choice((0.0, self.number())) for _ in range(4))
            message.transforms.append(item)
        return message

    def odometry(self) -> Odometry:
        """Return a pose with a velocity."""
        message = Odometry(child_frame_id=self.frame())
        message.header.frame_id = self.frame()
        self._stamp(message.header)
        twist = message.twist.twist
        twist.linear.x, twist.linear.y, twist.angular.z = (self.number() for _ in range(3))
        self._pose(message.pose)
        return message

    def initial_pose(self) -> PoseWithCovarianceStamped:
        """Return a pose in a map."""
        message = PoseWithCovarianceStamped()
        message.header.frame_id = self.rng.choice(("map", self.frame()))
        self._stamp(message.header)
        self._pose(message.pose)
        return message

    def status(self) -> DiagnosticArray:
        """Return what a node may say of itself."""
        message = DiagnosticArray()
        self._stamp(message.header)
        for _ in range(self.rng.choice((0, 1, 1, 3))):
            values = [KeyValue(key=self.rng.choice(TEXTS), value=self.rng.choice(TEXTS))]
            item = DiagnosticStatus(name=self.rng.choice(TEXTS), message=self.rng.choice(TEXTS))
            item.level = bytes([self.rng.choice((0, 1, 2, 3, 255))])
            item.values = values * self.rng.choice((0, 1, 20))
            message.status.append(item)
        return message

    def _pose(self, pose: Any) -> None:
        q, p = pose.pose.orientation, pose.pose.position
        q.w = self.rng.choice((1.0, self.number()))
        q.x, p.x, p.y, p.z = (self.rng.choice((0.0, self.number())) for _ in range(4))
        if self.rng.random() < 0.5:
            pose.covariance = [self.number() for _ in range(36)]
