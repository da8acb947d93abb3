"""Hand-eye calibration with a board: from colour images of it and the flange poses."""
