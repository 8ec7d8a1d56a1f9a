"""Submap SLAM on top of the odometry: loop closure, saved maps, localization."""
