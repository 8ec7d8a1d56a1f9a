"""Driver for the Unitree L2 4D LiDAR: datagrams in, stamped sweeps and IMU samples out; imports no ROS."""

__version__ = "0.1.0"
