"""How the verbs speak: one JSON object for programs, short text with units for people."""

from __future__ import annotations

import json
import math
import sys
from typing import Any


def print_json(value: dict[str, Any]) -> None:
    """Print exactly one JSON object on stdout; numbers that are not finite become null."""
    print(json.dumps(_finite(value), indent=1, allow_nan=False), flush=True)


def note(text: str) -> None:
    """Tell people something on stderr, out of the way of what programs read."""
    print(text, file=sys.stderr, flush=True)


def length(metres: float) -> str:
    """Return a length with three figures in the unit that suits it."""
    size = abs(metres)
    if not math.isfinite(metres):
        return "unknown"
    if size >= 1.0:
        return f"{metres:.3g} m"
    if size >= 1e-4 or size == 0.0:
        return f"{metres * 1e3:.3g} mm"
    return f"{metres * 1e6:.3g} µm"


def angle(radians: float) -> str:
    """Return an angle with three figures, in mrad below 0.1 rad and in degrees above."""
    if not math.isfinite(radians):
        return "unknown"
    if abs(radians) < 0.1:
        return f"{radians * 1e3:.3g} mrad"
    return f"{math.degrees(radians):.3g}°"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value
