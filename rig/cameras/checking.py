"""Whether a captured frame is fit to be kept; each check is pure and gives a reason in one line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rig.cameras.camera import CameraInfo, Capture

_LARGEST = 65535
"""Of the counts that a stored depth image holds."""


@dataclass(frozen=True)
class FrameLimits:
    """What a frame may be like."""

    holes: float = 0.6
    """Largest share of pixels without a measurement."""
    at_limits: float = 0.2
    """Largest share of the measured pixels at or beyond the ends of the camera's range."""
    early: float = 0.0
    """By how much a stamp may lie before the moment from which a frame counts, s."""
    late: float = 0.5
    """By how much a stamp may lie in the future: two clocks of one host, s."""
    frozen: bool = True
    """Refuse a frame equal to the one before. Off: a simulated camera without noise may repeat."""


def shape(capture: Capture, info: CameraInfo) -> str | None:
    """Whether size and types are what the camera promised."""
    expected = (info.camera.height, info.camera.width)
    if capture.depth.shape != expected or capture.depth.dtype != np.float32:
        return (
            f"depth of shape {capture.depth.shape} {capture.depth.dtype},"
            f" expected {expected} float32"
        )
    rgb = capture.rgb
    if rgb is not None and (rgb.shape != (*expected, 3) or rgb.dtype != np.uint8):
        return f"colour of shape {rgb.shape} {rgb.dtype}, expected {(*expected, 3)} uint8"
    return None


def values(capture: Capture, info: CameraInfo) -> str | None:
    """Whether every depth is NaN or one that a depth image can store."""
    depth = capture.depth
    lowest, highest = 0.5 * info.depth_scale, (_LARGEST + 0.5) * info.depth_scale
    with np.errstate(invalid="ignore"):
        wrong = ~np.isnan(depth) & ~((depth > lowest) & (depth < highest))
    if not wrong.any():
        return None
    row, column = (int(i) for i in np.argwhere(wrong)[0])
    return (
        f"depth {depth[row, column]:g} m at pixel (u {column}, v {row})"
        f" and {int(wrong.sum()) - 1} more, expected NaN or"
        f" {info.depth_scale:g} m to {_LARGEST * info.depth_scale:g} m"
    )


def holes(capture: Capture, limits: FrameLimits) -> str | None:
    """Whether enough was measured."""
    share = float(np.isnan(capture.depth).mean()) if capture.depth.size else 1.0
    if share <= limits.holes:
        return None
    return f"{share:.1%} of the pixels have no depth, expected at most {limits.holes:.1%}"


def saturation(capture: Capture, info: CameraInfo, limits: FrameLimits) -> str | None:
    """Whether the scene lies within the camera's range, and not at an end of it."""
    depth = capture.depth[~np.isnan(capture.depth)]
    if depth.size == 0:
        return None
    for end, name, beyond in (
        (info.depth_min, "nearest", lambda z, e: z <= e + info.depth_scale),
        (info.depth_max, "farthest", lambda z, e: z >= e - info.depth_scale),
    ):
        share = 0.0 if end is None else float(beyond(depth, end).mean())
        if share > limits.at_limits:
            return (
                f"{share:.1%} of the depths are at the {name} end of the range, {end:g} m,"
                f" expected at most {limits.at_limits:.1%}"
            )
    return None


def staleness(capture: Capture, since: float, now: float, limits: FrameLimits) -> str | None:
    """Whether the frame was exposed when it should.

    Args:
        capture: the frame.
        since: host clock, s, from which a frame counts: when the rig stood still.
        now: host clock, s, at which the frame had come.
        limits: what is allowed.
    """
    if not np.isfinite(capture.stamp):
        return f"its stamp is {capture.stamp:g}, expected seconds of the host's clock"
    if capture.stamp < since - limits.early:
        return (
            f"it was taken {since - capture.stamp:.3f} s before the rig stood still,"
            " expected a frame of after"
        )
    if capture.stamp > now + limits.late:
        return (
            f"its stamp lies {capture.stamp - now:.3f} s in the future,"
            f" expected at most {limits.late:g} s: the camera's clock is not the host's"
        )
    return None


def frozen(capture: Capture, before: Capture | None, limits: FrameLimits) -> str | None:
    """Whether it is another frame than the one before: noise never repeats itself."""
    if before is None or not limits.frozen:
        return None
    if capture.stamp == before.stamp:
        return f"its stamp {capture.stamp:.6f} is that of the frame before: no new frame came"
    if capture.depth.shape == before.depth.shape and np.array_equal(
        capture.depth, before.depth, equal_nan=True
    ):
        return "its depth equals that of the frame before in every pixel: the camera is stuck"
    return None


def check(
    capture: Capture,
    info: CameraInfo,
    limits: FrameLimits,
    *,
    since: float,
    now: float,
    before: Capture | None = None,
) -> str | None:
    """Return why a frame is not fit to be kept, in one line; None: it is.

    Args:
        capture: the frame.
        info: of the camera that took it.
        limits: what is allowed.
        since: host clock, s, from which a frame counts.
        now: host clock, s, at which it had come.
        before: the frame before it, None for the first.
    """
    return (
        shape(capture, info)
        or values(capture, info)
        or staleness(capture, since, now, limits)
        or frozen(capture, before, limits)
        or holes(capture, limits)
        or saturation(capture, info, limits)
    )
