"""Topic names of the launch files, without a namespace."""

from __future__ import annotations

from typing import Final

from l2lidar_node.config import TopicConfig

POINTS: Final = TopicConfig().point_cloud_topic_id
IMU: Final = TopicConfig().imu_topic_id
POINTS_DESKEWED: Final = "/points_deskewed"
REGISTERED_POINTS: Final = "/registered_points"
LOCAL_MAP: Final = "/local_map"
PATH: Final = "/path"
ODOMETRY: Final = "/odometry"
MAP_POINTS: Final = "/map_points"
MAP_PATH: Final = "/map_path"
GRAPH: Final = "/graph"
ROBOT_DESCRIPTION: Final = "/robot_description"

DRIVER_TOPICS: Final = (POINTS, IMU)
"""Topics that upstream, and so the driver, names from the root."""
LIO_SAM_CLOUD: Final = "/lio_sam/mapping/cloud_registered"
LIO_SAM_MAP: Final = "/lio_sam/mapping/map_local"
LIO_SAM_PATH: Final = "/lio_sam/mapping/path"
LIO_SAM_ODOMETRY: Final = "/lio_sam/mapping/odometry"
LIO_SAM_TOPICS: Final = (LIO_SAM_CLOUD, LIO_SAM_MAP, LIO_SAM_PATH, LIO_SAM_ODOMETRY)
"""What LIO-SAM publishes and its layout shows; the cloud and the path reliable, in ``odom``."""
SHOWN_TOPICS: Final = (
    *DRIVER_TOPICS,
    POINTS_DESKEWED,
    REGISTERED_POINTS,
    LOCAL_MAP,
    PATH,
    ODOMETRY,
    MAP_POINTS,
    MAP_PATH,
    GRAPH,
    ROBOT_DESCRIPTION,
)
"""Topics that the RViz layouts may name, all from the root."""
