"""What is done with the driver's sweeps: deskew, filters, odometry; no ROS outside ``ros``."""

from l2lidar_node import programs

programs.begin()
