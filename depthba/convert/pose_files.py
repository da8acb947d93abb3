"""Files of poses: TUM, KITTI, and 4x4 matrices as in Redwood's logs. Poses are not judged here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import durable, se3
from depthba.convert import files
from depthba.errors import DatasetError

Array = NDArray[np.float64]

_FIELDS = "stamp tx ty tz qx qy qz qw"
_SAME = 1e-6
"""Stamps that differ by no more are the same, s."""


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a file, in its order."""

    path: Path
    poses: Array
    """(N, 4, 4)."""
    stamps: Array | None
    """(N,), s; None: they belong to the frames in their order."""

    def at(self, stamp: float, max_gap: float) -> Array | None:
        """Return the pose (4, 4) at a stamp, s, interpolated; None where none is near enough.

        Translations are interpolated linearly, rotations along the shortest way.
        """
        assert self.stamps is not None
        order = np.argsort(self.stamps, kind="stable")
        stamps = self.stamps[order]
        after = int(np.searchsorted(stamps, stamp))
        near = [k for k in (after - 1, after) if 0 <= k < len(stamps)]
        for k in near:
            if abs(stamps[k] - stamp) <= _SAME:
                return np.asarray(self.poses[order[k]])
        if len(near) < 2 or stamps[after] - stamps[after - 1] > max_gap:
            return None
        share = (stamp - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        return between(self.poses[order[after - 1]], self.poses[order[after]], float(share))


def between(T_a: Array, T_b: Array, share: float) -> Array:
    """Return the pose (4, 4) at a share of the way from one to another."""
    return se3.retract(T_a, share * se3.difference(T_b, T_a))


def read(path: Path) -> Poses:
    """Read a file of poses, whose layout is told by the numbers on its lines.

    8 a line: TUM. 12: KITTI. 3 and four times 4: a log of Open3D's. Four times 4: matrices.

    Raises:
        DatasetError: it is none of these; names the line.

    """
    rows = _rows(path)
    if not rows:
        raise DatasetError(f"{path}: no poses in it, expected lines '{_FIELDS}'")
    widths = {len(row) for _, row in rows}
    if widths == {8}:
        return _tum(path, rows)
    if widths == {12}:
        T = np.tile(np.eye(4), (len(rows), 1, 1))
        T[:, :3] = np.array([row for _, row in rows]).reshape(-1, 3, 4)
        return Poses(path, T, None)
    if widths <= {3, 4}:
        return Poses(path, _matrices(path, rows), None)
    usual = len(rows[0][1])
    at, row = next((at, row) for at, row in rows if len(row) not in (8, 12) or len(row) != usual)
    raise DatasetError(
        f"{path}: line {at}: {len(row)} numbers{_guess(path, at, len(row))}, expected 8 (TUM: "
        "stamp tx ty tz qx qy qz qw), 12 (KITTI) or 4x4 matrices"
    )


def _guess(path: Path, at: int, count: int) -> str:
    """Return what may be wrong with a line of so many numbers."""
    line = files.text(path).splitlines()[at - 1]
    if "," in line and "." not in line:
        return " between commas (decimal commas? write points)"
    return {6: " (angles?)", 7: " (without a stamp? with angles?)"}.get(count, "")


def looks_like_tum(path: Path) -> bool:
    """Tell whether a text file begins as a TUM file does: 8 numbers, four of unit length."""
    try:
        rows = _rows(path, limit=1)
    except DatasetError:
        return False
    if len(rows) != 1 or len(rows[0][1]) != 8:
        return False
    return bool(abs(np.linalg.norm(rows[0][1][4:]) - 1) < 0.1)


def write_kitti(path: Path, T: Array) -> None:
    """Write poses (N, 4, 4) as KITTI has them: 12 numbers a line, row by row."""
    lines = [" ".join(f"{v:.17g}" for v in pose[:3].ravel()) for pose in T]
    durable.write_text(path, "\n".join(lines) + "\n")


def write_log(path: Path, T: Array) -> None:
    """Write poses (N, 4, 4) as Open3D's trajectory log: three integers and a matrix each."""
    durable.write_text(path, "".join(f"{k} {k} {k + 1}\n{rows(pose)}" for k, pose in enumerate(T)))


def rows(M: Array) -> str:
    """Return a matrix as lines of numbers in full precision."""
    return "".join(" ".join(f"{v:.17g}" for v in row) + "\n" for row in M)


def _rows(path: Path, limit: int | None = None) -> list[tuple[int, list[float]]]:
    """Return line numbers with the numbers of each line that has any."""
    out: list[tuple[int, list[float]]] = []
    for at, line in enumerate(files.text(path).splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            out.append((at, [float(word) for word in words]))
        except ValueError:
            if not out and at == 1:  # a head over the columns
                continue
            raise DatasetError(
                f"{path}: line {at}: {line[:60]!r}, expected numbers of poses with decimal points, "
                "such as stamp tx ty tz qx qy qz qw (TUM)"
            ) from None
        if len(out) == limit:
            break
    return out


def _tum(path: Path, rows: list[tuple[int, list[float]]]) -> Poses:
    values = np.array([row for _, row in rows])
    for at, row in rows:
        for name, value in zip(
            ("stamp", *["tx", "ty", "tz", "qx", "qy", "qz", "qw"]), row, strict=True
        ):
            if not np.isfinite(value):
                raise DatasetError(
                    f"{path}: line {at}: {name} is {value}, expected a finite number, or no line "
                    "for a frame without a pose"
                )
    lengths = np.linalg.norm(values[:, 4:], axis=1)
    if (off := np.abs(lengths - 1)).max() > 1e-2:
        k = int(np.argmax(off))
        raise DatasetError(
            f"{path}: line {rows[k][0]}: quaternion of length {lengths[k]:.6g}, expected 1 in "
            f"{_FIELDS}"
        )
    return Poses(path, se3.from_quaternion(values[:, 1:4], values[:, 4:]), values[:, 0])


def _matrices(path: Path, rows: list[tuple[int, list[float]]]) -> Array:
    """Return matrices (N, 4, 4); a line of three integers before each is let pass."""
    out: list[list[list[float]]] = [[]]
    for at, row in rows:
        if len(row) == 3 and not out[-1]:
            continue
        if len(row) != 4:
            raise DatasetError(f"{path}: line {at}: {len(row)} numbers, expected 4 of a matrix")
        out[-1].append(row)
        if len(out[-1]) == 4:
            out.append([])
    if out[-1]:
        raise DatasetError(f"{path}: line {rows[-1][0]}: the last matrix has {len(out[-1])} rows")
    return np.array(out[:-1], dtype=np.float64)
