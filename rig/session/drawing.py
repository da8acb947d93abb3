"""Draws a plan into a recording."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rig.cameras.camera import CameraInfo
from rig.session.planning import Plan
from rig.session.workspace import Workspace

Array = NDArray[np.float64]

_FRUSTUM = 0.06
"""Depth of a drawn camera, m."""
_POSES, _WAY, _LIMITS = (80, 170, 255), (240, 240, 240), (255, 170, 60)


def draw_plan(plan: Plan, space: Workspace, info: CameraInfo, start: Array, path: Path) -> None:
    """Write the planned poses, the way between them and the limits as a Rerun recording.

    Raises ImportError where rerun-sdk is not installed.

    Args:
        plan: what is drawn.
        space: with the limits.
        info: of the camera, for the shape of its view.
        start: joints (n,) from which the way leads.
        path: the file; whole once this returns.
    """
    import rerun as rr

    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    recording = rr.RecordingStream("depthba")
    recording.save(part)
    recording.send_recording_name(f"plan of {len(plan.joints)} poses")
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    camera = info.camera
    for k, (T, label) in enumerate(zip(plan.T_world_camera, plan.labels, strict=True)):
        at = f"plan/{k}"
        pose = rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])
        view = rr.Pinhole(
            image_from_camera=camera.matrix,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_FRUSTUM,
            color=_POSES,
        )
        recording.log(at, pose, static=True)
        recording.log(f"{at}/view", view, static=True)
        marked = rr.Points3D([[0.0, 0.0, 0.0]], radii=0.003, colors=_POSES, labels=f"{k}: {label}")
        recording.log(f"{at}/name", marked, static=True)
    way = rr.LineStrips3D([_way(plan, space, start)], colors=_WAY, radii=-1.0)
    recording.log("way", way, static=True)
    for name, box in (("camera", space.limits.camera), ("flange", space.limits.flange)):
        if box is not None:
            low, high = np.array(box[::2]), np.array(box[1::2])
            shape = rr.Boxes3D(centers=[0.5 * (low + high)], sizes=[high - low], colors=_LIMITS)
            recording.log(f"limits/{name}", shape, static=True)
    recording.flush()
    recording.disconnect()
    part.replace(path)


def _way(plan: Plan, space: Workspace, start: Array) -> Array:
    """Where the camera comes along (m, 3): the ways in the joints, in steps."""
    here, places = start, [space.camera_at(start)[None, :3, 3]]
    for q in plan.joints:
        for leg in space.way(here, q)[0] or (q,):
            share = np.linspace(0.0, 1.0, 20)[1:, None]
            places.append(space.camera_at(here + share * (leg - here))[:, :3, 3])
            here = leg
    return np.concatenate(places)
