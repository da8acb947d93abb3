"""Hand-eye calibration without a board: from the depth frames of any scene."""
