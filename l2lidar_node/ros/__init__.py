"""ROS 2 rim of the driver: the only modules that import rclpy and messages."""
