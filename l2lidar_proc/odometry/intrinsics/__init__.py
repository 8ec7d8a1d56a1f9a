"""What a unit's own calibration is wrong by: beam angles and ranges, learned on the way."""
