"""The real capture rig: arm, axes, cameras and hand-eye calibration."""
