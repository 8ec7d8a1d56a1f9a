"""Companion of the driver: deskew, filters, odometry and SLAM; no ROS outside ``ros``."""

from l2lidar_node import programs

programs.begin()
