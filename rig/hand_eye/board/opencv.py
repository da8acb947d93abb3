"""OpenCV's five closed-form methods, for comparison."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from depthba import se3

Array = NDArray[np.float64]

METHODS = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")


def solve(G: Array, P: Array, method: str) -> Array:
    """Return X (4, 4) by `cv2.calibrateHandEye`; NaN where it fails.

    Args:
        G: (N, 4, 4), `Observations.carrier`.
        P: (N, 4, 4), T_camera_board.
        method: one of `METHODS`.
    """
    import cv2  # slow to import, so only where it is used

    T = se3.inverse(G)
    log = cv2.utils.logging
    level = log.getLogLevel()
    log.setLogLevel(log.LOG_LEVEL_SILENT)  # it would complain on stderr, beside what we say
    try:
        R, t = cv2.calibrateHandEye(
            list(T[:, :3, :3]),
            list(T[:, :3, 3]),
            list(P[:, :3, :3]),
            list(P[:, :3, 3]),
            method=getattr(cv2, f"CALIB_HAND_EYE_{method}"),
        )
    except cv2.error:
        return np.full((4, 4), np.nan)
    finally:
        log.setLogLevel(level)
    return se3.make(R, np.ravel(t))
