"""Reads a session file and what it names."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.documents import parse_json
from depthba.errors import OptionError
from rig.session.marked import read_marked
from rig.session.options import Session

Array = NDArray[np.float64]


def read_session(path: str | Path) -> Session:
    """Return the session of a file, `hand_eye` as a 4x4; nothing is reached or opened.

    Raises:
        OptionError: ``FILE:LINE: KEY:``, what is wrong there, and what was expected.
        OSError: the file cannot be read.
    """
    path = Path(path)
    session: Session = read_marked(path, Session)
    if isinstance(session.hand_eye, Path):
        T = _transform(session.hand_eye, path)
        a, b, c, d = (row for row in map(tuple, T.tolist()))
        session = dataclasses.replace(session, hand_eye=(a, b, c, d))
    return session


def _transform(file: Path, session: Path) -> Array:
    """T_flange_camera (4, 4) of a file that holds it alone, or under that name."""
    who = f"{session}: hand_eye: {file}"
    try:
        raw = parse_json(file.read_text(encoding="utf-8"))
        T = np.array(raw["T_flange_camera"] if isinstance(raw, dict) else raw, dtype=float)
    except OSError as error:
        raise OptionError(f"{who}: {error.strerror}, expected JSON with T_flange_camera") from None
    except (ValueError, TypeError, KeyError, OverflowError):
        raise OptionError(f"{who}: no T_flange_camera in it, expected JSON with that 4x4") from None
    if T.shape != (4, 4) or not se3.is_rigid(T):
        raise OptionError(f"{who}: T_flange_camera is not rigid, expected a 4x4 in metres")
    return T


def read_taught(file: Path, joints: int, degrees: bool) -> Array:
    """The poses (N, joints) of a text file, rad or m; OptionError names the file and the line."""
    rows: list[list[float]] = []
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise OptionError(f"{file}: {error.strerror}, expected a file of poses") from None
    except UnicodeDecodeError:
        raise OptionError(f"{file}: is no text, expected a line of numbers a pose") from None
    for number, line in enumerate(lines, start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != joints or not np.isfinite(row).all():
            raise OptionError(f"{file}:{number}: {line.strip()[:60]!r}, expected {joints} numbers")
        rows.append(row)
    if not rows:
        raise OptionError(f"{file}: no pose in it, expected one a line")
    return np.radians(rows) if degrees else np.array(rows)
