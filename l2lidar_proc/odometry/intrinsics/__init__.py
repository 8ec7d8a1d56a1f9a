"""Online calibration of a unit: errors of its beam angles and ranges."""
