# Puts l2lidar and the nodes, which colcon installs where `ros2 run` looks for them, on PATH.
_colcon_prepend_unique_value PATH "$COLCON_CURRENT_PREFIX/lib/l2lidar_node"
