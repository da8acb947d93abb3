"""What is registered: the points of every frame, and the map frame and extent they call for."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.camera import RangeNoise
from depthba.dataset import Dataset, Frame, Sensor
from depthba.errors import DatasetError, OptionError
from depthba.optimiser.asking import look
from depthba.optimiser.waves import Waves, waves_of

Roi = tuple[float, float, float, float, float, float]
_CUT = (
    " that its crop and its mask leave: expected --depth-range in metres, and a mask that is not 0"
)

# Blocks of the image (columns, rows) over which residuals are taken to be correlated.
BLOCKS = (8, 6)
# Points are taken to be no more than so many times noisier, or better, than the typical one.
UNLIKE = 1e3


@dataclass(frozen=True)
class FramePoints:
    """The points of one frame, in the sensor frame."""

    points: NDArray[np.float32]
    """(n, 3), m."""
    inverse_noise: NDArray[np.float32]
    """(n,), the inverse of each point's noise relative to the typical one."""
    share: NDArray[np.float32]
    """(n,), how much of each point's cost counts."""
    blocks: NDArray[np.uint8]
    """(n,), the block of the image that each point lies in."""
    centroid: NDArray[np.float64]
    """(3,), about which the frame is perturbed: its translation and rotation are then told
    apart."""
    hull: NDArray[np.float64]
    """(k, 3), extreme points: enough for the frame's bounds under any pose."""
    extent: float
    """Root mean square distance of the points from the centroid, m: the lever that compares
    rotation with shift."""
    refused: str = ""
    """Why its points were left out, all of them; empty where they were not."""

    def __len__(self) -> int:
        return len(self.points)

    def thinned(self, stride: int) -> FramePoints:
        """Return every ``stride``-th point."""
        if stride <= 1:
            return self
        return replace(
            self,
            points=np.ascontiguousarray(self.points[::stride]),
            inverse_noise=np.ascontiguousarray(self.inverse_noise[::stride]),
            share=np.ascontiguousarray(self.share[::stride]),
            blocks=np.ascontiguousarray(self.blocks[::stride]),
        )


@dataclass(frozen=True)
class Problem:
    """Frames in one map frame. Poses here are ``T_map_camera``; frame 0 does not move."""

    frames: tuple[FramePoints, ...]
    T_map_camera: NDArray[np.float64]
    """(N, 4, 4), the start."""
    T_map_world: NDArray[np.float64]
    lower: NDArray[np.float64]
    """(2,), lower x, y bounds of the points at the start poses, m."""
    upper: NDArray[np.float64]
    origin: bool
    """Whether rays start at the origin of the sensor frame."""
    spacing: float
    """Typical distance of neighbouring points on the surface, m."""
    noise: float | None
    """Standard deviation of the range at a point of weight 1, m, where the dataset states it."""
    waves: Waves | None = None
    """What a fixed pattern of the range can be made of; None: there is none."""
    step: float = 0.0
    """Step in which the sensor tells a depth, m; 0: it has none."""

    def thinned(self, stride: int) -> Problem:
        """Return the problem with every ``stride``-th point of each frame."""
        return replace(self, frames=tuple(f.thinned(stride) for f in self.frames))

    def at_most(self, points: int) -> Problem:
        """Return the problem with no more points than so many, evenly thinned."""
        stride = -(-sum(map(len, self.frames)) // points)
        if stride <= 1:
            return self
        return replace(self.thinned(stride), spacing=self.spacing * float(np.sqrt(stride)))

    @property
    def ranges(self) -> float:
        """Typical distance from the sensor to the scene, m."""
        return float(np.median([np.linalg.norm(f.centroid) for f in self.frames if len(f)]))

    @property
    def rounding(self) -> float:
        """Standard deviation of a point by its last digit alone, m: none is known better."""
        single = float(np.finfo(np.float32).eps) * self.ranges
        return max(single, self.step) / float(np.sqrt(12))


def prepare(dataset: Dataset, T_world_camera: NDArray[np.float64], roi: Roi | None) -> Problem:
    """Read all points, choose the map frame, crop to the region of interest at the start poses.

    Raises:
        DatasetError: a file is damaged, or fewer than two frames have points.
        OptionError: the region of interest holds no points.
    """
    if len(dataset) < 2:
        raise DatasetError(
            f"{dataset.path}: {len(dataset)} frame, but registration needs at least 2"
        )
    clouds = [points_of(frame) for frame in dataset]
    if not any(len(p) for p in clouds):
        raise DatasetError(
            f"{dataset.path}: no frame has a single valid depth"
            f"{_CUT if any(frame.cuts for frame in dataset) else ''}"
        )
    clouds, refused = without_repeats(clouds, dataset.ids)
    T_map_world = choose_map_frame(dataset.map_frame, clouds, T_world_camera)
    T_map_camera = T_map_world @ T_world_camera
    if roi is not None:
        check_roi(roi)
        whole, clouds = clouds, [crop(p, T, roi) for p, T in zip(clouds, T_map_camera, strict=True)]
        if not any(len(p) for p in clouds):
            raise OptionError(
                f"--roi {' '.join(f'{v:g}' for v in roi)}: no point lies inside it, expected xmin "
                "xmax ymin ymax zmin zmax of the map frame, m: "
                f"the points lie in {_extent(whole, T_map_camera)}"
            )
    if sum(len(p) > 0 for p in clouds) < 2:
        seen = [f.id for f, p in zip(dataset, clouds, strict=True) if len(p)]
        why = f" ({next(filter(None, refused))})" if any(refused) else ""
        raise DatasetError(
            f"{dataset.path}: only frame {seen[0]} has valid depth{why}, but registration "
            "needs 2 or more"
        )
    typical = typical_noise(dataset.sensor, clouds)
    frames = tuple(
        replace(frame_points(p, dataset.sensor, typical), refused=why)
        for p, why in zip(clouds, refused, strict=True)
    )
    lower, upper = bounds(clouds, T_map_camera)
    return Problem(
        frames=frames,
        T_map_camera=T_map_camera,
        T_map_world=T_map_world,
        lower=lower,
        upper=upper,
        origin=dataset.sensor.origin,
        spacing=point_spacing(dataset.sensor, clouds),
        noise=typical if dataset.sensor.noise is not None else None,
        waves=waves_of(dataset.sensor, typical),
        step=dataset.sensor.depth_scale or 0.0,
    )


def points_of(frame: Frame) -> NDArray[np.float32]:
    """Return the points of a frame (n, 3), m, in the sensor frame.

    Raises:
        DatasetError: a file is damaged, or the camera's intrinsics send points to infinity.
    """
    look()
    with np.errstate(over="ignore"):
        points = frame.points()
    if not np.isfinite(points).all():
        lens = frame.sensor.camera
        shown = f" with fx {lens.fx:g}, fy {lens.fy:g}" if lens else ""
        raise DatasetError(
            f"{frame.root}: frame {frame.id}: its points are not finite{shown}, expected metres"
        )
    return points


def without_repeats(
    clouds: list[NDArray[np.float32]], ids: Sequence[int]
) -> tuple[list[NDArray[np.float32]], list[str]]:
    """Return the clouds less those that repeat an earlier one, and why each was left out.

    Noise never repeats itself: such a frame comes of a camera that hangs, or was copied, and where
    it was measured has nothing to do with what it shows.
    """
    first: dict[bytes, int] = {}
    kept, refused = [], []
    for points, frame in zip(clouds, ids, strict=True):
        earlier = first.setdefault(hashlib.sha256(points.tobytes()).digest(), frame)
        again = len(points) > 0 and earlier != frame
        refused.append(repeat_reason(earlier) if again else "")
        kept.append(points[:0] if again else points)
    return kept, refused


def repeat_reason(earlier: int) -> str:
    """Say why a frame is left out that repeats an earlier one."""
    return f"its points are those of frame {earlier} to the last digit: left out"


def choose_map_frame(
    map_frame: str, clouds: list[NDArray[np.float32]], T_world_camera: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return T_map_world: the world itself where the dataset says so.

    Else a plane facing the sensors.

    The z axis is the mean viewing direction reversed; where the sensors look in no common
    direction, the normal of the plane fitted to all points, on the side of the sensors. The origin
    is the first frame's sensor, the x axis as close to that sensor's as it can be: another world
    frame changes nothing.
    """
    if map_frame == "world":
        return np.eye(4)
    z = -T_world_camera[:, :3, 2].mean(axis=0)
    if np.linalg.norm(z) < 0.5:
        world = np.concatenate(
            [
                p[:: max(1, len(p) // 2000)] @ T[:3, :3].T + T[:3, 3]
                for p, T in zip(clouds, T_world_camera, strict=True)
            ]
        )  # fmt: skip
        centred = world - world.mean(axis=0)
        z = np.linalg.eigh(centred.T @ centred)[1][:, 0]
        if z @ (T_world_camera[:, :3, 3].mean(axis=0) - world.mean(axis=0)) < 0:
            z = -z
    z = z / np.linalg.norm(z)
    first = T_world_camera[0]
    x = first[:3, 0] if abs(first[:3, 0] @ z) < 0.9 else first[:3, 1]
    x = x - z * (z @ x)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return se3.make(R, -R @ first[:3, 3])


def point_spacing(sensor: Sensor, clouds: list[NDArray[np.float32]]) -> float:
    """Typical distance of neighbouring points on a surface that faces the sensor, m."""
    if sensor.camera is not None:
        depth = float(np.median([np.median(p[:, 2]) for p in clouds if len(p)]))
        return depth / float(np.sqrt(sensor.camera.fx * sensor.camera.fy))
    from scipy.spatial import cKDTree

    found = []
    for p in clouds:
        if len(p) > 1:
            some = p[:: max(1, len(p) // 2000)]
            found.append(np.median(cKDTree(p).query(some, k=2)[0][:, 1]))
    return float(np.median(found))


def check_roi(roi: Roi) -> None:
    """Refuse a region of interest whose lower bounds are not below its upper ones."""
    for axis, low, high in zip("xyz", roi[0::2], roi[1::2], strict=True):
        if not low < high:
            raise OptionError(
                f"--roi: {axis}min {low:g} is not below {axis}max {high:g} "
                "(expected xmin xmax ymin ymax zmin zmax)"
            )


def _extent(clouds: Sequence[NDArray[np.float32]], T_map_camera: NDArray[np.float64]) -> str:
    """Return the bounds of all points in the map frame, as a region of interest has them."""
    points = np.concatenate(
        [p @ T[:3, :3].T + T[:3, 3] for p, T in zip(clouds, T_map_camera, strict=True)]
    )
    bounds = np.stack([points.min(axis=0), points.max(axis=0)], axis=1).ravel()
    return " ".join(f"{v:.3g}" for v in bounds)


def crop(points: NDArray[np.float32], T: NDArray[np.float64], roi: Roi) -> NDArray[np.float32]:
    """Return the points that lie inside the region of interest under a pose ``T_map_camera``."""
    q = points @ T[:3, :3].T + T[:3, 3]
    inside = ((q >= np.array(roi[0::2])) & (q <= np.array(roi[1::2]))).all(axis=1)
    return np.ascontiguousarray(points[inside])


def typical_noise(sensor: Sensor, clouds: list[NDArray[np.float32]]) -> float:
    """Return the median standard deviation of the points' range, m; 1 where none is stated."""
    if sensor.noise is None:
        return 1.0
    sigmas = [_sigmas(sensor.noise, p[:: max(1, len(p) // 2000)]) for p in clouds]
    return float(np.median(np.concatenate(sigmas)))


def _sigmas(noise: RangeNoise, points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the stated deviation of each point's range (n,), m, no less than its rounding.

    Raises:
        DatasetError: it is no number at some point.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        sigmas = noise.of_points(points)
    wrong = ~np.isfinite(sigmas)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DatasetError(
            f"sensor.noise with sigma_m {noise.sigma_m:g}, at_m {noise.at_m:g}, power "
            f"{noise.power:g} is {sigmas[k]:g} m at a depth of {points[k, 2]:g} m, expected a "
            "finite standard deviation"
        )
    least = np.finfo(np.float32).eps * np.linalg.norm(points.astype(float), axis=1)
    return np.asarray(np.maximum(sigmas, least))


def frame_points(points: NDArray[np.float32], sensor: Sensor, typical: float) -> FramePoints:
    """Wrap a cloud (n, 3) in the sensor frame; ``typical`` noise, m, gets the weight 1."""
    look()
    n = len(points)
    if n == 0:
        none = np.zeros(0, np.float32)
        return FramePoints(
            points, none, none, np.zeros(0, np.uint8), np.zeros(3), np.zeros((1, 3)), 0.0
        )
    inverse_noise = share = np.ones(n, np.float32)
    if sensor.noise is not None:
        known = np.clip(typical / _sigmas(sensor.noise, points), 1 / UNLIKE, UNLIKE)
        inverse_noise = known.astype(np.float32)
    centroid = points.mean(axis=0, dtype=float)
    extent = float(np.sqrt(((points - centroid) ** 2).sum(axis=1).mean()))
    blocks = _blocks(points, sensor)
    return FramePoints(points, inverse_noise, share, blocks, centroid, extremes(points), extent)


def _blocks(points: NDArray[np.float32], sensor: Sensor) -> NDArray[np.uint8]:
    """Return the image block of each point.

    Over the sensor's image, or over the directions that a cloud spans.
    """
    if sensor.camera is not None:
        camera = sensor.camera
        across = (points[:, 0] / points[:, 2] * camera.fx + camera.cx + 0.5) / camera.width
        down = (points[:, 1] / points[:, 2] * camera.fy + camera.cy + 0.5) / camera.height
    else:
        spread = points[:, :2] - points[:, :2].min(axis=0)
        across, down = (spread / np.maximum(spread.max(axis=0), 1e-9)).T
    columns = np.clip((across * BLOCKS[0]).astype(int), 0, BLOCKS[0] - 1)
    rows = np.clip((down * BLOCKS[1]).astype(int), 0, BLOCKS[1] - 1)
    return np.asarray(rows * BLOCKS[0] + columns, np.uint8)


def extremes(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the extreme points along directions spread over the sphere (Fibonacci lattice)."""
    n = 128
    k = np.arange(n) + 0.5
    height = 1 - 2 * k / n
    angle = np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - height**2)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    some = points[:: max(1, len(points) // 20000)].astype(float)
    return np.asarray(some[np.unique(np.argmax(some @ directions.T, axis=0))])


def bounds(
    clouds: list[NDArray[np.float32]], T_map_camera: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bounds of the points in x and y, less a handful of strays that would blow up the map."""
    xy = np.concatenate(
        [
            p[:: max(1, len(p) // 20000)] @ T[:2, :3].T + T[:2, 3]
            for p, T in zip(clouds, T_map_camera, strict=True)
        ]
    )  # fmt: skip
    low, high = np.quantile(xy, [0.001, 0.999], axis=0)
    reach = 0.1 * (high - low)
    return np.maximum(xy.min(axis=0), low - reach), np.minimum(xy.max(axis=0), high + reach)
