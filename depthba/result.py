"""What a registration returns, and what it tells while it runs. Plain frozen data."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from depthba.depth_map import DepthMap

Status = Literal["converged", "not_converged", "weak", "no_better"]
"""``converged``: done, to be trusted. ``not_converged``: stopped at a limit. ``weak``: done, but
the data leave a direction of motion or a frame open, which was held at its measured pose; or a
frame does not fit the map, or lies where its measured pose cannot be meant. ``no_better``: nothing
better than the start was found, and the start poses are returned."""


@dataclass(frozen=True)
class Iteration:
    """One step of the solver, as the callback gets it."""

    index: int
    """Counts all iterations of the registration, from 0."""
    level: int
    """Resolution level, 0 = coarsest."""
    levels: int
    """Number of levels."""
    spacing: float
    """Map spacing of the level, m."""
    phase: Literal["quadratic", "robust"]
    """Whether the robust loss is on."""
    cost: float
    """Total cost before the step, priors and smoothing included, m^2."""
    step_t: float
    """Largest translation of a frame in this step, m."""
    step_r: float
    """Largest rotation of a frame in this step, rad."""
    damping: float
    """Levenberg-Marquardt damping, relative to the diagonal."""
    accepted: bool
    """Whether the step was taken."""
    inliers: float
    """Share of the points that the robust loss keeps (weight over one half)."""
    sigma: float
    """Robust standard deviation of the residuals, m."""
    cells: int
    """Cells of the map in the state."""
    seconds: float
    """Since the registration began."""
    T_world_camera: NDArray[np.float64] = field(repr=False)
    """(N, 4, 4), after the step."""
    depth_map: DepthMap = field(repr=False)
    """After the step. Its sigma is NaN: it is known only at the end."""


@dataclass(frozen=True)
class WeakDirection:
    """A direction in which the data hold a frame less than its measured pose does."""

    frame: int
    """Frame id."""
    name: str
    """For people: such as ``x``, ``yaw`` or ``0.8 x + 0.6 yaw``, in the map frame."""
    direction: NDArray[np.float64]
    """(6,) unit vector, translation then rotation times ``lever``, map axes."""
    lever: float
    """Metres by which a rotation in radians is multiplied to compare it with a translation: the
    frame's extent."""
    sigma: float
    """Standard deviation that the data alone leave along it, m."""
    prior_sigma: float
    """Standard deviation of the measured pose along it, m."""


@dataclass(frozen=True)
class FrameReport:
    """How one frame fared."""

    frame: int
    """Frame id."""
    points: int
    """Points used (after the region of interest)."""
    overlap: float
    """Share of its points in cells that another frame sees too."""
    inliers: float
    """Share of its points that the robust loss keeps."""
    move_t: float
    """Distance of the estimated camera centre from the start, m."""
    move_r: float
    """Angle of the estimated orientation from the start, rad."""
    held: str
    """Why the frame was held at its start pose; empty where it was free."""


@dataclass(frozen=True)
class Result:
    """A registration: poses, map, how certain they are, and how it went."""

    status: Status
    reason: str
    """One sentence for people."""
    frame_ids: tuple[int, ...]
    stamps: tuple[float, ...]
    T_world_camera: NDArray[np.float64]
    """(N, 4, 4), estimated."""
    T_world_camera_start: NDArray[np.float64]
    """(N, 4, 4), where the registration began."""
    depth_map: DepthMap
    depth_map_start: DepthMap
    """The map that the start poses give, on the same grid."""
    covariance: NDArray[np.float64]
    """(6N, 6N), translation then rotation per frame, world axes, left perturbation about the camera
    centre."""
    sigma: float
    """Robust standard deviation of the final residuals, m."""
    inflation: float
    """Factor by which the residuals' correlation over the image inflates the covariance (1:
    independent)."""
    history: tuple[Iteration, ...]
    weak: tuple[WeakDirection, ...]
    frames: tuple[FrameReport, ...]
    seconds: dict[str, float]
    """Per stage."""
    overlap: NDArray[np.float64]
    """(N, N), share of frame i's cells that frame j sees too."""
    fixed_pattern: float = 0.0
    """Error of the range that all frames share, m: root mean square over the image, at a point of
    typical noise. It was found along with the poses and taken off; 0: there is none."""
    refused_pattern: float = 0.0
    """The same of one that was left in: too large for the noise that the sensor states, and without
    it the residuals hung together no less. Wrong intrinsics mimic one. 0: there was none such."""

    @property
    def trusted(self) -> bool:
        """Whether the exit status is 0 (else 3: finished, but not to be trusted)."""
        return self.status == "converged"
