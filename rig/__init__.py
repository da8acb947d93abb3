"""The real capture rig: arm, axes, cameras and capture sessions. Nothing of it is written yet."""
