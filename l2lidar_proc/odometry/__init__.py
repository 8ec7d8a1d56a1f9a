"""LiDAR-inertial odometry."""
