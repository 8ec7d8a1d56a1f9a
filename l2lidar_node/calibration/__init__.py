"""Self-calibration of a unit: beam angles, range, IMU, and the file that keeps them."""
