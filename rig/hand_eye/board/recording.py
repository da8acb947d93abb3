"""A Rerun recording of a calibration: the board, the cameras, the images and the next pose."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from rig.hand_eye.board.calibration import BoardHandEye, camera_found
from rig.hand_eye.board.pictures import residuals

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

KEPT, GONE, NEXT, AXES = (80, 180, 220), (230, 80, 70), (240, 160, 50), 0.05
# Widest that an image is recorded, px.
WIDE = 640


def record(
    result: BoardHandEye, image_of: Callable[[int], Image | None], path: str | Path
) -> Path | None:
    """Write run.rrd; None where rerun-sdk is not installed.

    Lengths in m; the frame is the board's. Along the timeline ``frame`` each pose shows its image
    with the corners found and where they should be.
    """
    try:
        import rerun as rr
    except ModuleNotFoundError:
        return None
    assert result.estimate is not None
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    stream = rr.RecordingStream("depthba-hand-eye")
    stream.save(part)
    stream.send_recording_name(path.resolve().parent.name)
    found, observations = result.estimate, result.observations
    solution, camera = found.solution, camera_found(result)
    P = solution.chain.T_camera_board(observations, solution.problem.velocity)
    stream.log("board", rr.Points3D(observations.points, radii=0.002), static=True)
    stream.log("board/axes", _axes(np.eye(4), 3 * AXES), static=True)
    away = residuals(result)
    for row in range(len(P)):
        T = se3.inverse(P[row])
        name = f"cameras/{observations.ids[row]}"
        colour = GONE if found.dropped[row] else KEPT
        stream.log(f"{name}/axes", _axes(T, AXES), static=True)
        stream.log(
            f"{name}/sight",
            rr.LineStrips3D([_frustum(T, camera.matrix, camera.width, camera.height)],
                            colors=[colour]),
            static=True,
        )  # fmt: skip
        stream.set_time("frame", sequence=int(observations.ids[row]))
        image = image_of(row)
        share = 1.0
        if image is not None:
            step = max(1, -(-image.shape[1] // WIDE))
            share = 1.0 / step
            stream.log("image", rr.Image(np.ascontiguousarray(image[::step, ::step])).compress())
        seen = np.isfinite(away[row]).all(axis=-1)
        pixels = observations.pixels[row][seen]
        stream.log("image/found", rr.Points2D(share * pixels, radii=1.5, colors=[KEPT]))
        predicted = pixels - away[row][seen]
        stream.log("image/predicted", rr.Points2D(share * predicted, radii=0.8, colors=[NEXT]))
        stream.log("curves/corners_px", rr.Scalars(found.corners[row]))
        stream.log("curves/robot_sigmas", rr.Scalars(float(np.sqrt(found.distance[row]))))
    if result.next is not None:
        T = se3.inverse(result.next.T_camera_board)
        stream.log("next/axes", _axes(T, AXES), static=True)
        strip = _frustum(T, camera.matrix, camera.width, camera.height)
        stream.log("next/sight", rr.LineStrips3D([strip], colors=[NEXT]), static=True)
    stream.log(
        "verdict", rr.TextDocument(f"# {result.status}\n\n{result.reason}",
                                   media_type="text/markdown"), static=True,
    )  # fmt: skip
    stream.flush()
    stream.disconnect()
    part.replace(path)
    return path


def _axes(T: Array, length: float) -> Any:
    import rerun as rr

    return rr.Arrows3D(
        origins=np.tile(T[:3, 3], (3, 1)),
        vectors=length * T[:3, :3].T,
        colors=[(220, 60, 60), (60, 190, 60), (70, 110, 240)],
    )


def _frustum(T: Array, K: Array, width: int, height: int) -> Array:
    """(10, 3), one line round a camera's view, m."""
    ring = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]], float)
    rays = AXES * np.linalg.solve(K, np.c_[ring, np.ones(5)].T).T
    eye = np.zeros(3)
    line = [*rays, eye, rays[1], rays[2], eye, rays[3]]
    return np.asarray(np.array(line) @ T[:3, :3].T + T[:3, 3])
