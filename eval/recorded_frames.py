"""Frames as a recording shows them: their points, view frustums, poses and centres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from depthba.camera import Camera
from depthba.clouds import FrameCloud, inside, point_spacing, transform
from depthba.dataset import Dataset

Floats = NDArray[np.float64]
Colour = Sequence[int] | NDArray[np.uint8]

CLOUD_POINTS = 160_000
"""Points of all frames together, 12 bytes each."""
COVER = 0.7
"""Radius of a point by the distance to the next: they must cover what is seen at a slant."""
FRUSTUM = 0.12
"""Length of a frustum, as a share of the distance that the frame sees."""


@dataclass(frozen=True, eq=False)
class ShownCloud:
    """What is shown of a frame's points."""

    points: Floats
    """(n, 3), sensor frame, m, in random order: any first part of them is spread evenly."""
    radius: float
    """m, such that the points just cover what they show."""

    def first(self, count: int) -> ShownCloud:
        """Return no more than ``count`` of the points, larger so that they cover as much."""
        wider = np.sqrt(max(1.0, len(self.points) / max(count, 1)))
        return ShownCloud(self.points[:count], float(self.radius * wider))


def shown_clouds(
    dataset: Dataset,
    clouds: Sequence[FrameCloud],
    T_map_camera: Floats,
    roi: Sequence[float] | None,
    total: int = CLOUD_POINTS,
) -> tuple[ShownCloud, ...]:
    """Choose points of all frames.

    Args:
        dataset: whose frames.
        clouds: the points of all frames.
        T_map_camera: (N, 4, 4), where the region of interest is applied.
        roi: xmin xmax ymin ymax zmin zmax in the map frame, m; None: everywhere.
        total: so many at most, all frames together.

    """
    share = total // max(len(clouds), 1)
    rng = np.random.default_rng(0)
    spacing = point_spacing(dataset, [c.points for c in clouds])
    shown = []
    for cloud, T in zip(clouds, T_map_camera, strict=True):
        p = cloud.points[inside(transform(T, cloud.points), roi)]
        shown.append(ShownCloud(rng.permutation(p), COVER * spacing).first(share))
    return tuple(shown)


def log_cloud(
    rec: rr.RecordingStream, path: str, cloud: ShownCloud, colour: Colour, *, static: bool = True
) -> None:
    """Record points in one colour or one each, once and for all or at the present time."""
    shown = rr.Points3D(cloud.points.astype(np.float32), colors=colour, radii=cloud.radius)
    rec.log(path, shown, static=static)


def log_frustum(
    rec: rr.RecordingStream,
    path: str,
    camera: Camera | None,
    points: Floats,
    colour: Colour,
    *,
    static: bool = True,
) -> None:
    """Record what a camera sees as a small frustum; nothing without a camera."""
    if camera is None:
        return
    pinhole = rr.Pinhole(
        image_from_camera=camera.matrix,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=FRUSTUM * (float(np.median(points[:, 2])) if len(points) else 1.0),
        color=colour,
    )
    rec.log(path, pinhole, static=static)


def log_pose(rec: rr.RecordingStream, path: str, T: Floats, *, static: bool = False) -> None:
    """Record a pose (4, 4), at the stream's present time or once and for all."""
    rec.log(path, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=static)


def log_centres(
    rec: rr.RecordingStream, path: str, centres: Floats, colour: Colour, label: str
) -> None:
    """Record camera centres (N, 3) as dots of a fixed size on the screen."""
    dots = rr.Points3D(
        centres, colors=colour, radii=-4.0, labels=[label] * len(centres), show_labels=False
    )
    rec.log(path, dots, static=True)
