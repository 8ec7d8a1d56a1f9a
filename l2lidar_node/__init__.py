"""Driver for the Unitree L2: datagrams in, stamped sweeps and IMU samples out; no ROS."""

__version__ = "0.1.0"
