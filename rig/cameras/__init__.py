"""Depth cameras: one small interface, and the cameras behind it, found by name.

Importing this imports no camera's package.
"""

from rig.cameras.camera import CameraInfo, Capture, DepthCamera
from rig.cameras.checking import FrameLimits
from rig.cameras.finding import find, make, names

__all__ = ["CameraInfo", "Capture", "DepthCamera", "FrameLimits", "find", "make", "names"]
