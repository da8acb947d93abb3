"""hand_eye.json: what a calibration leaves for others, the same from both roads.

Lengths in m and rotations in rad but for what is named otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import durable, se3
from depthba.dataset import Dataset
from depthba.documents import parse_json
from depthba.errors import OptionError

Array = NDArray[np.float64]

FILE = "hand_eye.json"
FORMAT, VERSION = "depthba-hand-eye", 1

# Standard deviations of X, m and rad, beyond which it is of no use.
OPEN_T, OPEN_R = 0.003, float(np.radians(0.5))


@dataclass(frozen=True)
class Open:
    """A direction of X that the data leave open."""

    name: str
    """For people: such as ``z`` or ``turn about x``, in the flange's axes."""
    direction: Array
    """(6,) one standard deviation of the start, m and rad; of X itself where there was no start."""
    share: float
    """Share of the start in what is known about it, 0 to 1."""


@dataclass(frozen=True, eq=False)
class HandEyeRecord:
    """What everybody wants of a calibration."""

    method: str
    """``board``, ``from-depth``, or both with a plus."""
    mount: str
    """``eye-in-hand`` or ``eye-to-hand``."""
    verdict: str
    trusted: bool
    reason: str
    """One sentence for people."""
    T: Array | None = field(repr=False)
    """(4, 4), T_flange_camera; eye-to-hand: T_base_camera. None: the data were refused."""
    covariance: Array | None = field(repr=False)
    """(6, 6), translation along the axes of the frame that T maps into, then rotation about them,
    m^2 and rad^2, left perturbation about the camera centre."""
    open: tuple[Open, ...] = ()

    @property
    def key(self) -> str:
        """The transform's name in the file."""
        return key_of(self.mount)


def key_of(mount: str) -> str:
    """Return the name of the transform that is found."""
    return "T_base_camera" if mount == "eye-to-hand" else "T_flange_camera"


def head(record: HandEyeRecord, dataset: Dataset) -> dict[str, Any]:
    """Return the part of hand_eye.json that both roads share."""
    file = {"format": FORMAT, "version": VERSION, "dataset": str(dataset.path.resolve())}
    return {**file, **body(record)}


def body(record: HandEyeRecord) -> dict[str, Any]:
    """Return what hand_eye.json says of the transform itself."""
    content: dict[str, Any] = {
        "method": record.method,
        "mount": record.mount,
        "verdict": record.verdict,
        "trusted": record.trusted,
        "reason": record.reason,
        "open": [
            {"name": o.name, "direction": o.direction.tolist(), "share": o.share}
            for o in record.open
        ],
        "T_flange_camera": None,
        record.key: None,
        "sigma_mm": None,
        "sigma_deg": None,
        "covariance": None,
    }
    if record.T is not None and record.covariance is not None:
        sigma = np.sqrt(np.diag(record.covariance))
        content[record.key] = record.T.tolist()
        content["sigma_mm"] = (1e3 * sigma[:3]).tolist()
        content["sigma_deg"] = np.degrees(sigma[3:]).tolist()
        content["covariance"] = record.covariance.tolist()
    return content


def write_content(content: dict[str, Any], run: Path) -> None:
    """Write hand_eye.json into a run folder, whole or not at all."""
    durable.write_json(run / FILE, content)


def read_record(path: Path, option: str) -> HandEyeRecord:
    """Read hand_eye.json.

    Args:
        path: the file.
        option: that named it, for the error.

    Raises:
        OptionError: it is no such file.
    """
    raw = _read(path, option)
    try:
        if not isinstance(raw, dict) or raw["format"] != FORMAT:
            raise KeyError("format")
        mount = str(raw.get("mount", "eye-in-hand"))
        T, covariance = raw[key_of(mount)], raw["covariance"]
        record = HandEyeRecord(
            method=str(raw["method"]),
            mount=mount,
            verdict=str(raw["verdict"]),
            trusted=bool(raw["trusted"]),
            reason=str(raw["reason"]),
            T=None if T is None else np.array(T, float),
            covariance=None if covariance is None else np.array(covariance, float),
            open=tuple(
                Open(str(o["name"]), np.array(o["direction"], float), float(o["share"]))
                for o in raw["open"]
            ),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise OptionError(
            f"{option} {path}: {error}: expected a {FILE} that calibrate wrote"
        ) from error
    T, covariance = record.T, record.covariance
    if (T is not None and not se3.is_rigid(T)) or (
        covariance is not None and (covariance.shape != (6, 6) or not np.isfinite(covariance).all())
    ):
        raise OptionError(f"{option} {path}: no rigid 4x4 in metres with a 6x6 covariance in it")
    return record


def read_transform(path: Path) -> NDArray[np.float64]:
    """Read T_flange_camera (4, 4) from JSON.

    The file holds the 4x4 itself, or an object with it under that name, as hand_eye.json and
    dataset.json do.

    Raises:
        OptionError: there is none, or it is not rigid.
    """
    raw = _read(path, "--start")
    try:
        if isinstance(raw, dict):
            raw = raw["T_flange_camera"]
        T = np.array(raw, dtype=float)
    except (ValueError, TypeError, KeyError) as error:
        raise OptionError(
            f"--start {path}: no T_flange_camera in it, expected JSON with a 4x4 of that name"
        ) from error
    if not se3.is_rigid(T):
        raise OptionError(f"--start {path}: T_flange_camera is not rigid, expected a 4x4 in metres")
    return T


def _read(path: Path, option: str) -> Any:  # JSON is untyped until it is checked
    try:
        return parse_json(path.read_text(encoding="utf-8"))
    except (ValueError, UnicodeDecodeError) as error:
        raise OptionError(
            f"{option} {path}: no T_flange_camera in it, expected JSON: {error}"
        ) from error
