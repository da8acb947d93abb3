"""Two calibrations of one camera made into one, each weighed by what it knows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from depthba import se3
from depthba.errors import OptionError
from rig.hand_eye.record import OPEN_R, OPEN_T, HandEyeRecord, body

Array = NDArray[np.float64]

ITERATIONS = 20
# Two that agree so badly by chance are one in a million: they are not of one mounting.
UNLIKELY = 1e-6
# By how many of its standard deviations a direction that was held at a start is let go.
LET_GO = 1e3


@dataclass(frozen=True, eq=False)
class Combined:
    """The transform that both support."""

    T: Array
    """(4, 4)."""
    covariance: Array
    """(6, 6), left perturbation about the camera centre, m^2 and rad^2."""
    distance: float
    """Squared normalised difference of the two; chi-squared with 6 degrees of freedom."""


def known(record: HandEyeRecord) -> tuple[Array, Array]:
    """Return T (4, 4) and its covariance (6, 6), without what was only believed beforehand.

    Raises:
        OptionError: the record holds nothing that may be relied on.
    """
    if record.T is None or record.covariance is None:
        raise OptionError(
            f"a calibration of method {record.method!r} has no transform: {record.reason}"
        )
    if not record.trusted and record.verdict != "weak":
        raise OptionError(
            f"a calibration of method {record.method!r} is {record.verdict}, expected one to be"
            f" trusted: {record.reason}"
        )
    covariance = record.covariance.copy()
    for direction in record.open:
        d = LET_GO * direction.direction
        covariance += np.outer(d, d)
    return record.T, covariance


def combine(one: HandEyeRecord, other: HandEyeRecord) -> Combined:
    """Find the pose of least squared distance to both, each measured by its covariance.

    Gauss-Newton over SE(3), errors as `se3.difference` has them.

    Raises:
        OptionError: they disagree far beyond their sigmas, or are of different kinds.
    """
    if one.mount != other.mount:
        raise OptionError(f"calibrations {one.mount} and {other.mount}: expected two of one kind")
    (T_a, C_a), (T_b, C_b) = known(one), known(other)
    apart = se3.difference(T_a, T_b)
    scale = np.sqrt(np.diag(C_a) + np.diag(C_b))
    both = (C_a + C_b) / np.outer(scale, scale)
    distance = float((apart / scale) @ np.linalg.solve(both, apart / scale))
    if distance > chi2.isf(UNLIKELY, 6):
        raise OptionError(
            f"the calibrations {one.method} and {other.method} disagree by"
            f" {1e3 * np.linalg.norm(apart[:3]):.2f} mm and"
            f" {np.degrees(np.linalg.norm(apart[3:])):.3f} degrees,"
            f" {np.sqrt(distance / 6):.1f} times what their sigmas allow:"
            " expected two of one mounting"
        )
    I_a, I_b = _information(C_a), _information(C_b)
    T = T_a if np.trace(C_a) <= np.trace(C_b) else T_b
    for _ in range(ITERATIONS):
        g = I_a @ se3.difference(T_a, T) + I_b @ se3.difference(T_b, T)
        step = np.linalg.solve(I_a + I_b, g)
        T = se3.retract(T, step)
        if np.abs(step).max() < 1e-12:
            break
    return Combined(T, np.asarray(np.linalg.inv(I_a + I_b), np.float64), distance)


def combined_record(own: HandEyeRecord, other: HandEyeRecord, combined: Combined) -> HandEyeRecord:
    """Return what is thought of both together: weak where both leave the same direction open."""
    sigma = np.sqrt(np.diag(combined.covariance))
    weak = bool(sigma[:3].max() > OPEN_T or sigma[3:].max() > OPEN_R)
    reason = "agree, and together "
    reason += "still leave the transform open" if weak else "fix the transform"
    return HandEyeRecord(
        method=f"{own.method}+{other.method}",
        mount=own.mount,
        verdict="weak" if weak else "converged",
        trusted=not weak,
        reason=f"{own.method} and {other.method} {reason}",
        T=combined.T,
        covariance=combined.covariance,
    )


def combined_content(
    own: dict[str, Any], record: HandEyeRecord, combined: Combined, path: Path
) -> dict[str, Any]:
    """Return hand_eye.json of both; what the one road found of it stands under ``alone``."""
    shared = body(record)
    return {
        **own,
        **shared,
        "combined_with": str(path.resolve()),
        "disagreement": float(np.sqrt(combined.distance / 6)),
        "alone": {key: own[key] for key in shared},
    }


def combined_line(record: HandEyeRecord, combined: Combined) -> str:
    """Return the line for people."""
    t, sigma = 1e3 * combined.T[:3, 3], np.sqrt(np.diag(combined.covariance))
    r = np.degrees(se3.log_so3(combined.T[:3, :3]))
    mm, degrees = (" ".join(f"{v:.{n}f}" for v in x) for x, n in ((t, 3), (r, 4)))
    return (
        f"  together      {record.reason}: {mm} mm, {degrees} degrees, sigma"
        f" {1e3 * np.linalg.norm(sigma[:3]):.3f} mm,"
        f" {np.degrees(np.linalg.norm(sigma[3:])):.4f} degrees; they differ by"
        f" {np.sqrt(combined.distance / 6):.1f} times what is to be expected"
    )


def _information(covariance: Array) -> Array:
    scale = np.sqrt(np.diag(covariance))
    inverse = np.linalg.inv(covariance / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray((inverse + inverse.T) / 2)
