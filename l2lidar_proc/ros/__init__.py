"""ROS 2 rim of the companion: thin nodes that convert, call and publish."""
