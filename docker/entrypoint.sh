#!/usr/bin/env bash
# Runs a command with ROS 2 and this workspace sourced.
source /opt/ros/jazzy/setup.bash
source /ws/install/setup.bash
exec "$@"
