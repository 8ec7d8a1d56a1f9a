"""The example robots: where the sensor sits on them, and what a cloud looks like from there."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from l2lidar_node.config import FrameConfig
from l2lidar_node.types import F64

BASE_FRAME: Final = "base_link"
_EXAMPLES: Final = Path(__file__).resolve().parents[2] / "urdf" / "examples"
_BIN_M: Final = 0.05


def mount(example: str) -> F64:
    """Return the pose of the cloud frame in ``base_link`` on an example robot, (4, 4).

    Parameters
    ----------
    example : str
        ``top`` or ``forward``.

    Raises
    ------
    OSError
        If there is no such robot: the demo runs from the repository.
    """
    robot = ElementTree.parse(_EXAMPLES / f"l2_{example}_mount_example.urdf").getroot()
    joints = {_attribute(joint, "child", "link"): joint for joint in robot.iter("joint")}
    pose, link = np.eye(4), FrameConfig().cloud
    while link != BASE_FRAME:
        step = np.eye(4)
        rpy = [float(value) for value in _attribute(joints[link], "origin", "rpy").split()]
        step[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
        step[:3, 3] = [float(value) for value in _attribute(joints[link], "origin", "xyz").split()]
        pose, link = step @ pose, _attribute(joints[link], "parent", "link")
    return pose


def _attribute(joint: ElementTree.Element, tag: str, name: str) -> str:
    found = joint.find(tag)
    return "" if found is None else found.get(name, "")


def moved(points: NDArray[np.void], T_base_cloud: F64) -> NDArray[np.void]:
    """Return points (N,) with x, y, z in the base frame instead of the cloud frame [m]."""
    out = points.copy()
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float64)
    for axis, column in zip("xyz", (xyz @ T_base_cloud[:3, :3].T).T, strict=True):
        out[axis] = column + T_base_cloud["xyz".index(axis), 3]
    return out


def floor_and_ceiling(points: NDArray[np.void]) -> tuple[float, float]:
    """Return the heights at which the lower and the upper half have most points (N,) [m]."""
    z = points["z"].astype(np.float64)
    middle = 0.5 * (float(np.percentile(z, 1)) + float(np.percentile(z, 99)))
    return _densest(z[z < middle]), _densest(z[z >= middle])


def _densest(values: F64) -> float:
    if not len(values):
        return float("nan")
    bins = np.floor(values / _BIN_M).astype(np.int64)
    found, counts = np.unique(bins, return_counts=True)
    return float(np.median(values[bins == found[counts.argmax()]]))


def as_message(T_base_cloud: F64) -> Any:
    """Return the mount as a message for ``/tf_static``."""
    from geometry_msgs.msg import TransformStamped
    from tf2_msgs.msg import TFMessage

    item = TransformStamped(child_frame_id=FrameConfig().cloud)
    item.header.frame_id = BASE_FRAME
    place, turn = item.transform.translation, item.transform.rotation
    place.x, place.y, place.z = T_base_cloud[:3, 3].tolist()
    turn.x, turn.y, turn.z, turn.w = Rotation.from_matrix(T_base_cloud[:3, :3]).as_quat().tolist()
    return TFMessage(transforms=[item])
