"""A scan as ScanNet's file holds it, field by field after sensorData.h of its SensReader."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.depthba.convert.small_scene import LENS, millimetres, poses

RAW, ZLIB, JPEG = 0, 1, 2


def write(
    path: Path,
    packing: int,
    lost: tuple[int, ...] = (),
    extra: NDArray[np.float64] | None = None,
) -> None:
    """Write the six frames of the small scene: depth in mm, colour as JPEG, stamps in µs."""
    K = np.eye(4)
    K[[0, 1, 0, 1], [0, 1, 2, 2]] = LENS
    name = b"StructureSensor"
    out = [struct.pack("<IQ", 4, len(name)), name]
    for matrix in (K, np.eye(4), K, np.eye(4) if extra is None else extra):
        out.append(matrix.astype("<f4").tobytes())
    out.append(struct.pack("<iiIIIIfQ", JPEG, packing, 80, 60, 80, 60, 1000.0, len(poses())))
    for k, T in enumerate(poses()):
        pose = np.full((4, 4), -np.inf) if k in lost else T
        depth = millimetres(T).astype("<u2").tobytes()
        depth = zlib.compress(depth) if packing == ZLIB else depth
        done, rgb = cv2.imencode(".jpg", np.full((60, 80, 3), 40 * k, np.uint8))
        assert done
        at = 5_000_000 + 33_000 * k
        out.append(pose.astype("<f4").tobytes())
        out.append(struct.pack("<QQQQ", at, at, rgb.size, len(depth)))
        out += [rgb.tobytes(), depth]
    out.append(struct.pack("<Q", 0))  # of the inertial unit there is nothing
    path.write_bytes(b"".join(out))
