"""Calibrated kinematics of a Universal Robots arm, from the corrections that its controller keeps.

On the controller they stand in ``calibration.conf`` beneath the folder ``.urcontrol``: for each
joint what is to be added to the published Denavit-Hartenberg parameters, m and rad, in lines such
as ``delta_a = [ 3.1e-05, ... ]``. A YAML mapping with the same four names is read too.
"""

from __future__ import annotations

import configparser
from pathlib import Path

import numpy as np
import yaml

from depthba.documents import parse_yaml
from depthba.errors import OptionError
from depthba.kinematics import UR16E, DhArm

NAMES = ("delta_theta", "delta_a", "delta_d", "delta_alpha")


def read_calibration(path: str | Path, arm: DhArm = UR16E) -> DhArm:
    """The arm with the corrections of a file; OptionError names what is wrong with it."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "is no text"
        raise OptionError(f"calibration {path}: {reason}; expected a calibration.conf") from None
    entries = _of_yaml(text, path) if path.suffix in (".yaml", ".yml") else _of_conf(text, path)
    missing = [name for name in NAMES if name not in entries]
    if missing:
        raise OptionError(f"calibration {path}: has no {missing[0]}, expected {', '.join(NAMES)}")
    deltas = {name: _numbers(entries[name], name, path, len(arm.joints)) for name in NAMES}
    return arm.calibrated(**{name.removeprefix("delta_"): deltas[name] for name in NAMES})


def _of_conf(text: str, path: Path) -> dict[str, object]:
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    try:
        parser.read_string(text)
        return {
            name: parse_yaml(value)
            for section in parser.sections()
            for name, value in parser.items(section)
            if name in NAMES
        }
    except (configparser.Error, yaml.YAMLError) as error:
        raise OptionError(f"calibration {path}: {' '.join(str(error).split())}") from None


def _of_yaml(text: str, path: Path) -> dict[str, object]:
    try:
        entries = parse_yaml(text)
    except yaml.YAMLError as error:
        raise OptionError(f"calibration {path}: {' '.join(str(error).split())}") from None
    if not isinstance(entries, dict):
        raise OptionError(f"calibration {path}: expected a mapping with {', '.join(NAMES)}")
    return entries


def _numbers(value: object, name: str, path: Path, count: int) -> list[float]:
    try:
        # YAML 1.1 takes 3e-05 for a word.
        numbers = [float(one) for one in value] if isinstance(value, list) else []
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise OptionError(f"calibration {path}: {name} {value}: expected {count} numbers, m or rad")
    return numbers
