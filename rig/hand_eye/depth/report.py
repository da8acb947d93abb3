"""What a calibration leaves behind, and how it reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.dataset import Dataset
from depthba.verbs.output import length
from rig.hand_eye.depth.calibration import HandEye
from rig.hand_eye.record import FILE, HandEyeRecord, head


def record_of(result: HandEye) -> HandEyeRecord:
    """Return what both roads have in common."""
    return HandEyeRecord(
        method="from-depth",
        mount="eye-in-hand",
        verdict=result.status,
        trusted=result.trusted,
        reason=result.reason,
        T=result.T_flange_camera,
        covariance=result.covariance,
        open=result.open,
    )


def content(result: HandEye, dataset: Dataset) -> dict[str, Any]:
    """Return what hand_eye.json holds: m and rad but for what is named otherwise."""
    moved = se3.difference(result.T_flange_camera, result.T_flange_camera_start)
    seen = result.registration
    return {
        **head(record_of(result), dataset),
        "T_flange_camera_start": result.T_flange_camera_start.tolist(),
        "moved_mm": float(1e3 * np.linalg.norm(moved[:3])),
        "moved_deg": float(np.degrees(np.linalg.norm(moved[3:]))),
        "turned_deg": np.degrees(result.turned).tolist(),
        "robot": {
            "sigma_mm": 1e3 * result.beliefs.robot_t,
            "sigma_deg": float(np.degrees(result.beliefs.robot_r)),
            "joint_zeros_deg": np.degrees(result.zeros).tolist(),
        },
        "registration": {"status": seen.status, "reason": seen.reason},
        "pattern_mm": 1e3 * seen.fixed_pattern,
        "inflation": seen.inflation,
        "sigma_m": seen.sigma,
        "spacing_m": seen.depth_map.spacing,
        "frames": [
            {
                "frame": frame.id,
                "inliers": report.inliers,
                "flange_mm": (1e3 * missed[:3]).tolist(),
                "flange_deg": np.degrees(missed[3:]).tolist(),
            }
            for frame, report, missed in zip(dataset, seen.frames, result.missed, strict=True)
        ],
        "iterations": len(seen.history),
        "seconds": result.seconds,
    }


def text(result: HandEye, dataset: Dataset, run: Path) -> list[str]:
    """Return the lines for people, the verdict first."""
    X = result.T_flange_camera
    t, r = 1e3 * X[:3, 3], np.degrees(se3.log_so3(X[:3, :3]))
    sigma = np.sqrt(np.diag(result.covariance))
    moved, seen = se3.difference(X, result.T_flange_camera_start), result.registration
    worst = int(np.argmax(np.linalg.norm(result.missed[:, :3], axis=1)))
    lines = [
        f"{dataset.name}: {result.status.replace('_', ' ')}. {result.reason}",
        f"  frames        {len(dataset)}, the flange turned by {_three(np.degrees(result.turned))} "
        "degrees (rms between frames, about three axes)",
        f"  translation   {_three(t, 3)} mm, sigma {_three(1e3 * sigma[:3], 3)}",
        f"  rotation      {_three(r, 4)} degrees (rotation vector), "
        f"sigma {_three(np.degrees(sigma[3:]), 4)}",
        f"  from start    {1e3 * np.linalg.norm(moved[:3]):.3f} mm, "
        f"{np.degrees(np.linalg.norm(moved[3:])):.4f} degrees",
        f"  robot         repeats to {1e3 * result.beliefs.robot_t:.3f} mm, "
        f"{np.degrees(result.beliefs.robot_r):.4f} degrees; frame {dataset[worst].id} is off most, "
        f"{length(float(np.linalg.norm(result.missed[worst, :3])))}",
    ]
    if len(result.zeros):
        shown = " ".join(f"{v:.3f}" for v in np.degrees(result.zeros))
        lines.append(f"  joint zeros   {shown} degrees off")
    lines += [
        f"  depth         sigma {length(seen.sigma)} of the residuals, fixed pattern "
        f"{length(seen.fixed_pattern)}",
        f"  time          {len(seen.history)} iterations, {result.seconds:.1f} s",
        f"  result        {run / FILE}",
    ]
    return lines


def _three(values: NDArray[np.float64], digits: int = 1) -> str:
    return " ".join(f"{v:.{digits}f}" for v in values)
