"""The `l2lidar` command: works with an L2 from the command line, without ROS."""
