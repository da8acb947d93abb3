"""Trajectories as TUM text files: ``stamp tx ty tz qx qy qz qw`` a line, seconds and metres.

A ``#`` starts a comment.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba import durable, se3
from depthba.errors import DatasetError

Array = NDArray[np.float64]

UNIT_TOLERANCE = 1e-6
"""How far from 1 a quaternion's length may be."""
_FIELDS = "stamp tx ty tz qx qy qz qw"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses with their stamps, and the text they came from."""

    stamps: Array
    """(N,), seconds."""
    T_world_camera: Array
    """(N, 4, 4)."""
    lines: tuple[str, ...]
    """All lines that count, comments too, without their newlines."""
    rows: tuple[int, ...]
    """(N,), the index in ``lines`` of each pose."""
    warnings: tuple[str, ...]
    """Such as a truncated last line that was dropped."""


def parse_tum(text: str, report: Callable[[int, str], None]) -> Trajectory:
    """Read a TUM text; ``report`` gets the line number and text of each fault, and may raise.

    An unterminated last line that is no whole pose was cut off by a crash: it is dropped with a
    warning.
    """
    lines = text.split("\n")
    unterminated = lines.pop() if lines else ""
    stamps: list[float] = []
    poses: list[list[float]] = []
    rows: list[int] = []
    warnings: list[str] = []
    kept: list[str] = []
    for index, line in enumerate([*lines, unterminated] if unterminated else lines):
        if not line.partition("#")[0].split():
            kept.append(line)
            continue
        numbers, fault, cut = _parse_line(line)
        if fault and cut and index == len(lines):
            warnings.append(f"line {index + 1}: dropped the truncated last line {line[:60]!r}")
            continue
        kept.append(line)
        if fault:
            report(index + 1, fault)
            continue
        stamps.append(numbers[0])
        poses.append(numbers[1:])
        rows.append(len(kept) - 1)
    p = np.array(poses, dtype=np.float64).reshape(-1, 7)
    return Trajectory(
        stamps=np.array(stamps, dtype=np.float64),
        T_world_camera=se3.from_quaternion(p[:, :3], p[:, 3:]),
        lines=tuple(kept),
        rows=tuple(rows),
        warnings=tuple(warnings),
    )


def read_text(path: str | Path) -> str:
    """Read a UTF-8 text file. Raises `DatasetError` that names the file."""
    try:
        return Path(path).read_bytes().decode()
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file") from None
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror}, expected a readable file") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path}: byte {error.start} is not UTF-8, expected text") from error


def read_tum(path: str | Path) -> tuple[Array, Array]:
    """Read a TUM file: stamps (N,), seconds, and poses (N, 4, 4), metres.

    Raises `DatasetError` that names the file, line and value. A truncated last line is dropped
    and logged.
    """

    def refuse(line: int, text: str) -> None:
        raise DatasetError(f"{path}: line {line}: {text}")

    trajectory = parse_tum(read_text(path), refuse)
    for warning in trajectory.warnings:
        logging.getLogger(__name__).warning("%s: %s", path, warning)
    return trajectory.stamps, trajectory.T_world_camera


def tum_line(stamp: float, T_world_camera: ArrayLike) -> str:
    """Return the line of one pose (4, 4), no newline: stamp with 9 decimals, the rest with 15."""
    T = np.asarray(T_world_camera, dtype=np.float64)
    values = [*T[:3, 3], *se3.quaternion(T)]
    if not (math.isfinite(stamp) and np.isfinite(values).all()):
        raise ValueError(f"pose at stamp {stamp} is not finite")
    return " ".join([f"{stamp:z.9f}", *(f"{value:z.15f}" for value in values)])


def write_tum(
    path: str | Path, stamps: Sequence[float] | Array, T: ArrayLike, comment: str = ""
) -> None:
    """Write poses (N, 4, 4) with stamps (N,), seconds, as a TUM file, whole or not at all."""
    T = np.asarray(T, dtype=np.float64)
    if len(stamps) != len(T):
        raise ValueError(f"{len(stamps)} stamps for {len(T)} poses")
    lines = [f"# {text}" for text in [_FIELDS, *comment.splitlines()]]
    lines += [tum_line(float(stamp), pose) for stamp, pose in zip(stamps, T, strict=True)]
    durable.write_text(path, "\n".join(lines) + "\n")


def _parse_line(line: str) -> tuple[list[float], str, bool]:
    """Return the numbers, the fault or "", and whether cutting the line off explains it."""
    words = line.partition("#")[0].split()
    if len(words) != 8:
        return [], f"{len(words)} values in {line[:80]!r}, expected 8: {_FIELDS}", len(words) < 8
    numbers: list[float] = []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError:
            return [], f"{word!r} is not a number, expected {_FIELDS}", word is words[-1]
    for field, number in zip(_FIELDS.split(), numbers, strict=True):
        if not math.isfinite(number):
            return [], f"{field} is {number}, expected a finite number", False
    length = math.hypot(*numbers[4:])
    if abs(length - 1) > UNIT_TOLERANCE * (1 + 1e-6):  # 1 + 1e-6 is not exact in binary
        return [], f"quaternion of length {length:.9g}, expected 1 to {UNIT_TOLERANCE:g}", True
    return numbers, "", False
