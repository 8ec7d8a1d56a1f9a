"""Driver for the Unitree L2: datagrams in, stamped sweeps and IMU samples out; no ROS."""

from l2lidar_node import programs

__version__ = "0.1.0"

programs.begin()
