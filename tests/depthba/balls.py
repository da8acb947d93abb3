"""Half balls that stand close together, seen from above by a few frames."""

from __future__ import annotations

import numpy as np

from depthba import se3
from depthba.optimiser.laying import Cloud
from depthba.optimiser.prior import move

N = 4


def poses(rng, t=0.0, r=0.0):
    """Sensors about 1 m above the scene, off by Gaussian errors; frame 0 is exact."""
    T = se3.make(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 1.0])[None].repeat(N, axis=0)
    T[:, :2, 3] = [[-0.1, -0.1], [0.1, -0.1], [-0.1, 0.1], [0.1, 0.1]]
    error = np.concatenate([rng.normal(0, t, (N, 3)), rng.normal(0, r, (N, 3))], axis=1)
    error[0] = 0.0
    return move(T, T[:, :3, 3], error)


def balls(rng, T, sigma, points=2500, flat=0.0):
    """Noisy points on half balls that stand close together, as each frame sees them.

    The larger `flat`, the less of a ball.
    """
    centres = np.stack([*np.meshgrid([-0.12, 0.0, 0.12], [-0.12, 0.0, 0.12]), np.zeros((3, 3))], -1)
    clouds = []
    for pose in T:
        k = rng.integers(0, 9, points)
        d = rng.normal(size=(points, 3))
        d[:, 2] = np.abs(d[:, 2]) + flat
        x = centres.reshape(-1, 3)[k] + 0.05 * d / np.linalg.norm(d, axis=1)[:, None]
        p = (x - pose[:3, 3]) @ pose[:3, :3]
        way = np.linalg.norm(p, axis=1)
        clouds.append(p * (1 + sigma * rng.normal(size=points) / way)[:, None])
    frame, source = np.indices((N, points), np.int32).reshape(2, -1)
    return Cloud(
        np.concatenate(clouds, dtype=np.float32), np.ones(N * points), frame, source, True, False
    )
