"""Hand-eye calibration: where the camera sits on the flange."""
