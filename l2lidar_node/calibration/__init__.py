"""Self-calibration of a unit: beam angles, range, IMU, calibration file."""
