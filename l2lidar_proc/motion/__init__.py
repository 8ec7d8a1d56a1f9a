"""The motion core: IMU buffer, preintegration, filter, static detection."""
