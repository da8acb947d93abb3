"""Files of points: PLY, PCD, XYZ, LAS, LAZ, E57."""
