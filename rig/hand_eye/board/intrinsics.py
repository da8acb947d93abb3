"""The camera's numbers from the images of the board alone."""

from __future__ import annotations

import numpy as np

from depthba.camera import Camera
from depthba.errors import DatasetError
from rig.hand_eye.board.observations import FEWEST_CORNERS, Observations


def estimated(observations: Observations) -> Camera:
    """Calibrate the camera (Zhang 2000, as OpenCV has it): where the refinement then starts.

    Raises:
        DatasetError: the images do not fix it.
    """
    import cv2  # slow to import, so only where it is used

    rows = [k for k, seen in enumerate(observations.seen) if seen.sum() >= FEWEST_CORNERS]
    camera = observations.camera
    points = [observations.points[observations.seen[k]].astype(np.float32) for k in rows]
    pixels = [observations.pixels[k][observations.seen[k]].astype(np.float32) for k in rows]
    try:
        _, K, distortion, _, _ = cv2.calibrateCamera(
            points, pixels, (camera.width, camera.height), None, None, flags=cv2.CALIB_FIX_K3
        )
    except cv2.error as error:
        raise DatasetError(
            f"the camera cannot be calibrated from these {len(rows)} images: {error.err}"
        ) from error
    k1, k2, p1, p2, k3 = (float(k) for k in np.ravel(distortion)[:5])
    return Camera(
        camera.width, camera.height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]),
        float(K[1, 2]), (k1, k2, p1, p2, k3),
    )  # fmt: skip
