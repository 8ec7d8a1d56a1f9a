"""The `l2lidar` command: everything that is done with an L2 by hand, without ROS."""
