"""How a source is to be read: what its files do not say, and what is to be taken otherwise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Axes = Literal["opencv", "opengl"]
Direction = Literal["camera-to-world", "world-to-camera"]
Quaternions = Literal["xyzw", "wxyz"]


@dataclass(frozen=True)
class Reading:
    """How to read a source that is no dataset of depthba. None: as its format has it."""

    kind: str | None = None
    """Format of the source, such as tum-rgbd or nerfstudio. None: recognised by its content."""
    intrinsics: tuple[float, float, float, float] | None = None
    """fx fy cx cy of the depth images, pixels; pixel centres at integer coordinates."""
    distortion: tuple[float, float, float, float, float] | None = None
    """k1 k2 p1 p2 k3 of the depth images, as in OpenCV."""
    depth_scale: float | None = None
    """Metres per step of the depth images, such as 0.001 where they are in mm."""
    poses: str | None = None
    """File of poses (TUM, KITTI, or 4x4 matrices); or identity, for clouds that lie in one frame
    already; or viewpoint, for PCD clouds that carry their pose. Of a dataset: measured or true."""
    axes: Axes | None = None
    """Axes of the camera. opencv: x right, y down, z forward. opengl: x right, y up, z back."""
    direction: Direction | None = None
    """Which way the poses map."""
    quaternions: Quaternions | None = None
    """Order of the quaternions in a file of poses. None: xyzw, as TUM has it."""
    pose_scale: float | None = None
    """Metres per unit of the poses' translations, such as 0.001 where they are in mm."""
    cloud_scale: float | None = None
    """Metres per unit of the clouds' coordinates."""
    max_gap: float = 0.1
    """Poses are interpolated to the stamps of the frames over no longer a gap, s."""
    map_frame: Literal["auto", "world"] = "auto"
    """world: the world's x-y plane is the plane of the map. auto: seen from the cameras."""
    depth_topic: str | None = None
    """Topic of the depth images in a bag. None: the only one there is."""
    fixed_frame: str | None = None
    """Frame of a bag's tf tree that is the world. None: the root above the camera."""
    outside: bool = False
    """Follow names and links in the source that lead out of it."""
    unchecked: bool = False
    """Take the conventions as they are, whether the frames overlap under them or not."""
