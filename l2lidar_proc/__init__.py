"""Companion of l2lidar_node: deskew, filters and odometry on sweeps; imports no ROS outside ``ros/``."""
