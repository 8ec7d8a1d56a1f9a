"""The virtual unit: electronics, scanner and IMU."""
