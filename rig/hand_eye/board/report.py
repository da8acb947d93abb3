"""What a calibration with a board leaves behind, and how it reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import durable, se3
from depthba.boards import Board
from depthba.dataset import Dataset
from rig.hand_eye.board import pictures
from rig.hand_eye.board.calibration import BoardHandEye, camera_found
from rig.hand_eye.board.recording import record
from rig.hand_eye.record import FILE, HandEyeRecord, head

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

REPORT, RECORDING = "report.md", "run.rrd"
IMAGES, RESIDUALS, COVERAGE = "reprojections.png", "residuals.png", "coverage.png"


def record_of(result: BoardHandEye) -> HandEyeRecord:
    """Return what both roads have in common."""
    return HandEyeRecord(
        method="board",
        mount=result.mount,
        verdict=result.status,
        trusted=result.trusted,
        reason=result.reason,
        T=result.T,
        covariance=result.covariance,
        open=result.open,
    )


def content(
    result: BoardHandEye, dataset: Dataset, board: Board, without: Sequence[int]
) -> dict[str, Any]:
    """Return what hand_eye.json holds: m and rad but for what is named otherwise."""
    found: dict[str, Any] = {
        **head(record_of(result), dataset),
        "turned_deg": np.degrees(result.turned).tolist(),
        "board": board.json(),
        "frames_without_board": list(without),
        "notes": list(result.notes),
    }
    if result.T is not None and result.estimate is not None and result.verdict is not None:
        found |= _numbers(result)
    return {**found, "seconds": result.seconds}


def _numbers(result: BoardHandEye) -> dict[str, Any]:
    assert result.estimate is not None and result.verdict is not None and result.T is not None
    estimate, solution = result.estimate, result.estimate.solution
    chain, noise = solution.chain, solution.problem.noise
    camera, observations = camera_found(result), result.observations
    off = chain.off(observations, solution.problem.velocity)
    size, clock, following = result.verdict.size, result.clock, result.next
    return {
        "T_base_board" if result.mount == "eye-in-hand" else "T_flange_board": chain.Y.tolist(),
        "robot": {
            "sigma_mm": 1e3 * noise.robot_t,
            "sigma_deg": float(np.degrees(noise.robot_r)),
            "joint_zeros_deg": np.degrees(chain.zeros).tolist(),
        },
        "corner_sigma_px": noise.corner,
        "camera": {
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "distortion": list(camera.distortion),
        },
        "conditioning": result.verdict.conditioning,
        "board_size": None if size is None else {"log": size.value, "sigma": size.sigma},
        "clock_s": None if clock is None else {"late": clock.value, "sigma": clock.sigma},
        "methods": {name: X.tolist() for name, X in result.methods.items() if np.isfinite(X).all()},
        "drop": [observations.ids[k] for k in np.flatnonzero(estimate.dropped | estimate.spoilt)],
        "add": None
        if following is None
        else {
            "T_base_flange": following.T_base_flange.tolist(),
            "T_camera_board": following.T_camera_board.tolist(),
            "tilt_deg": float(np.degrees(following.tilt)),
            "distance_m": following.distance,
            "error_mm": [1e3 * following.before, 1e3 * following.after],
        },
        "frames": [
            {
                "frame": observations.ids[k],
                "corners_px": float(estimate.corners[k]),
                "flange_mm": (1e3 * off[k, :3]).tolist(),
                "flange_deg": np.degrees(off[k, 3:]).tolist(),
                "distance": float(np.sqrt(estimate.distance[k])),
                "dropped": bool(estimate.dropped[k]),
            }
            for k in range(len(observations))
        ],
    }


def text(result: BoardHandEye, dataset: Dataset, run: Path, without: Sequence[int]) -> list[str]:
    """Return the lines for people, the verdict first."""
    lines = [f"{dataset.name}: {result.status.replace('_', ' ')}. {result.reason}"]
    count = len(result.observations)
    lines.append(
        f"  frames        {count} of {len(dataset)} show the board, the flange turned by"
        f" {_three(np.degrees(result.turned), 1)} degrees (rms between frames, about three axes)"
    )
    if without:
        lines.append(f"  no board in   frames {', '.join(map(str, without))}")
    lines += [f"  note          {note}" for note in result.notes]
    if result.T is not None and result.covariance is not None:
        lines += _number_lines(result)
    lines.append(f"  result        {run / FILE}, {REPORT}")
    return lines


def _number_lines(result: BoardHandEye) -> list[str]:
    assert result.estimate is not None and result.verdict is not None
    assert result.T is not None and result.covariance is not None
    noise = result.estimate.solution.problem.noise
    camera, given = camera_found(result), result.observations.camera
    sigma = np.sqrt(np.diag(result.covariance))
    key = "T_base_camera" if result.mount == "eye-to-hand" else "T_flange_camera"
    lines = [
        f"  transform     {key}",
        f"  translation   {_three(1e3 * result.T[:3, 3], 3)} mm,"
        f" sigma {_three(1e3 * sigma[:3], 3)}",
        f"  rotation      {_three(np.degrees(se3.log_so3(result.T[:3, :3])), 4)} degrees (rotation"
        f" vector), sigma {_three(np.degrees(sigma[3:]), 4)}",
        f"  corners       sigma {noise.corner:.3f} px",
        f"  robot         repeats to {1e3 * noise.robot_t:.3f} mm,"
        f" {np.degrees(noise.robot_r):.4f} degrees",
        f"  camera        focal length {camera.fx - given.fx:+.2f} px, centre"
        f" {camera.cx - given.cx:+.2f} {camera.cy - given.cy:+.2f} px against the given",
        f"  conditioning  {result.verdict.conditioning:.1f} between the best and the worst known"
        " direction",
    ]
    if result.next is not None:
        t = 1e3 * result.next.T_base_flange[:3, 3]
        lines.append(
            f"  add next      a view from {np.degrees(result.next.tilt):.0f} degrees off the"
            f" board's normal, {1e3 * result.next.distance:.0f} mm away, flange at {_three(t, 0)}"
            f" mm: the error at the board falls from {1e3 * result.next.before:.3f} to"
            f" {1e3 * result.next.after:.3f} mm"
        )
    return lines


def write(
    result: BoardHandEye,
    dataset: Dataset,
    lines: Sequence[str],
    run: Path,
) -> Path | None:
    """Write report.md with its pictures, and the recording; return where the latter is.

    Args:
        result: the calibration.
        dataset: where the images are.
        lines: what was told people.
        run: the folder.
    """
    ids = {frame.id: frame for frame in dataset}

    def image_of(row: int) -> Image | None:
        return ids[result.observations.ids[row]].rgb()

    parts = [f"# Hand-eye calibration of {dataset.name}", "", f"**{result.status}**: "
             f"{result.reason}", "", "```", *lines, "```", ""]  # fmt: skip
    pictures.coverage_picture(result, run / COVERAGE)
    recording = None
    if result.estimate is not None:
        pictures.images_picture(result, image_of, run / IMAGES)
        pictures.residuals_picture(result, run / RESIDUALS)
        parts += [f"![reprojections]({IMAGES})", "", f"![residuals]({RESIDUALS})", ""]
        recording = record(result, image_of, run / RECORDING)
    parts += [f"![coverage]({COVERAGE})", ""]
    if result.estimate is not None and result.T is not None:
        parts += _table(result)
    durable.write_text(run / REPORT, "\n".join(parts))
    return recording


def _table(result: BoardHandEye) -> list[str]:
    assert result.estimate is not None
    estimate, solution = result.estimate, result.estimate.solution
    off = solution.chain.off(result.observations, solution.problem.velocity)
    lines = ["| frame | corners px | flange off mm | degrees | standard deviations | |",
             "|---|---|---|---|---|---|"]  # fmt: skip
    for k, name in enumerate(result.observations.ids):
        lines.append(
            f"| {name} | {estimate.corners[k]:.3f} | {1e3 * np.linalg.norm(off[k, :3]):.3f} |"
            f" {np.degrees(np.linalg.norm(off[k, 3:])):.4f} | {np.sqrt(estimate.distance[k]):.1f} |"
            f" {'left out' if estimate.dropped[k] else ''} |"
        )
    return [*lines, ""]


def _three(values: Array, digits: int) -> str:
    return " ".join(f"{v:.{digits}f}" for v in values)
