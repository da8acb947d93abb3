"""Values out of JSON, each checked where it is read.

`MalformedError` names the key, the value and what was expected.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.dataset.faults import MalformedError

ROTATION_TOLERANCE = 1e-4
"""How far from orthonormal a rotation in JSON may be: people write matrices with few decimals."""

Record = Mapping[str, Any]


def parse(text: str) -> Any:  # JSON is untyped; the functions below give it types
    """Parse strict JSON: no NaN, no infinity, no key twice."""

    def refuse(name: str) -> float:
        raise MalformedError(f"{name} is in it, expected finite numbers")

    def finite(digits: str) -> float:
        value = float(digits)
        return value if math.isfinite(value) else refuse(digits)

    def distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        record = dict(pairs)
        if len(record) != len(pairs):
            keys = [key for key, _ in pairs]
            twice = sorted({key for key in keys if keys.count(key) > 1})
            raise MalformedError(f"key {twice[0]!r} is there twice")
        return record

    try:
        return json.loads(
            text, parse_constant=refuse, parse_float=finite, object_pairs_hook=distinct
        )
    except json.JSONDecodeError as error:
        raise MalformedError(
            f"not JSON: {error.msg} at line {error.lineno}, column {error.colno}"
        ) from error
    except (RecursionError, ValueError) as error:  # nested too deep, an integer too long
        raise MalformedError(f"not JSON that can be read: {error}") from error


def mapping(value: Any, name: str) -> dict[str, Any]:
    """Return a JSON object."""
    if not isinstance(value, dict):
        raise MalformedError(f"{name} is {shown(value)}, expected an object")
    return value


def required(record: Record, key: str) -> Any:
    """Return the value of a key that must be there."""
    if key not in record:
        raise MalformedError(f"key {key!r} is missing")
    return record[key]


def number(value: Any, name: str, *, above: float = -math.inf, least: float = -math.inf) -> float:
    """Return a finite number greater than ``above`` and not less than ``least``."""
    bound = f" above {above:g}" if above > -math.inf else ""
    bound += f" of at least {least:g}" if least > -math.inf else ""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise MalformedError(f"{name} is {shown(value)}, expected a number{bound}")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result) or result <= above or result < least:
        raise MalformedError(f"{name} is {shown(value)}, expected a finite number{bound}")
    return result


def integer(value: Any, name: str, *, least: int = 0) -> int:
    """Return an integer not less than ``least``."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise MalformedError(f"{name} is {shown(value)}, expected an integer of at least {least}")
    return value


def text(value: Any, name: str) -> str:
    """Return a string."""
    if not isinstance(value, str):
        raise MalformedError(f"{name} is {shown(value)}, expected a string")
    return value


def choice(value: Any, name: str, choices: tuple[str, ...]) -> str:
    """Return one of the strings in ``choices``."""
    if value not in choices or not isinstance(value, str):
        expected = " or ".join(repr(c) for c in choices)
        raise MalformedError(f"{name} is {shown(value)}, expected {expected}")
    return value


def numbers(
    value: Any, name: str, *, length: int | None = None, least: float = -math.inf
) -> tuple[float, ...]:
    """Return a list of finite numbers."""
    expected = "a list of numbers" if length is None else f"a list of {length} numbers"
    if not isinstance(value, list) or (length is not None and len(value) != length):
        raise MalformedError(f"{name} is {shown(value)}, expected {expected}")
    return tuple(number(v, f"{name}[{i}]", least=least) for i, v in enumerate(value))


def rigid(value: Any, name: str) -> NDArray[np.float64]:
    """Return a 4x4 rigid transform given as a list of rows; read-only."""
    if not isinstance(value, list) or len(value) != 4:
        raise MalformedError(f"{name} is {shown(value)}, expected 4 rows of 4 numbers")
    rows = [numbers(row, f"{name}[{i}]", length=4) for i, row in enumerate(value)]
    T = np.array(rows, dtype=np.float64)
    if not se3.is_rigid(T, ROTATION_TOLERANCE):
        raise MalformedError(
            f"{name} is {shown(value)},"
            f" expected a rigid transform (rotation to {ROTATION_TOLERANCE:g})"
        )
    T.setflags(write=False)
    return T


def shown(value: Any) -> str:
    """Return a value as JSON, short enough for one line."""
    as_json = json.dumps(value, default=repr)
    return as_json if len(as_json) <= 80 else as_json[:77] + "..."
