"""Verbs that this package adds to the ``l2lidar`` command through entry points."""

from typing import Final

from l2lidar_node.command_line import DATA, Verb

DESKEW: Final = Verb(
    "deskew",
    "l2lidar_proc.verbs.deskew:deskew",
    DATA,
    "Deskew and filter the clouds of a recording, as deskew_node does live.",
)
ODOMETRY: Final = Verb(
    "odometry",
    "l2lidar_proc.verbs.odometry:odometry",
    DATA,
    "Estimate the trajectory of a recording, as odometry_node does live; with map and plot.",
)
SLAM: Final = Verb(
    "slam",
    "l2lidar_proc.verbs.slam:slam",
    DATA,
    "Build a map with loop closure from a recording, as slam_node does live.",
)
EXPORT: Final = Verb(
    "export",
    "l2lidar_proc.verbs.slam:export_map",
    DATA,
    "Write a map as g2o, TUM, KITTI, nav2, PLY, PCD, or for interactive_slam or QN.",
)
