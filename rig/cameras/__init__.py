"""Depth cameras: one small interface, and the cameras behind it."""

from rig.cameras.camera import CameraInfo, Capture, DepthCamera

__all__ = ["CameraInfo", "Capture", "DepthCamera"]
