"""Options dataclasses from plain values, as a session file has them."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from depthba.errors import OptionError


def from_plain(kind: Any, values: Mapping[str, Any], who: str) -> Any:
    """Return an instance of the dataclass `kind` from plain values; OptionError begins with `who`.

    A list becomes a tuple, a whole number a float, a text a Path, and a mapping a dataclass, where
    the field is one.

    Args:
        kind: a dataclass.
        values: values of its fields by their names.
        who: whose options they are.
    """
    hints = typing.get_type_hints(kind)
    fields = {field.name: field for field in dataclasses.fields(kind) if field.init}
    unknown = [key for key in values if key not in fields]
    if unknown:
        choices = ", ".join(sorted(fields)) or "none"
        raise OptionError(f"{who}: unknown option {unknown[0]!r}; choose from: {choices}")
    missing = [
        name
        for name, field in fields.items()
        if name not in values
        and field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise OptionError(f"{who}: option {missing[0]!r} is missing")
    converted = {}
    for name, value in values.items():
        try:
            converted[name] = _converted(value, hints[name], f"{who}: {name}")
        except (ValueError, OverflowError):
            hint = getattr(hints[name], "__name__", None) if isinstance(hints[name], type) else None
            expected = hint or str(hints[name]).replace("typing.", "")
            raise OptionError(f"{who}: option {name!r} is {value!r}, expected {expected}") from None
    return kind(**converted)


def _converted(value: Any, hint: Any, who: str) -> Any:
    """Return a value as its type hint wants it; ValueError, OverflowError where it does not fit."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        for choice in arguments:
            try:
                return _converted(value, choice, who)
            except (ValueError, OverflowError):
                continue
        raise ValueError
    if origin is Literal:
        if value in arguments:
            return value
        raise ValueError
    if origin is tuple:
        return _converted_tuple(value, arguments, who)
    if dataclasses.is_dataclass(hint) and isinstance(value, Mapping):
        return from_plain(hint, value, who)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    if origin is None and isinstance(hint, type):
        if isinstance(value, hint) and not (hint is int and isinstance(value, bool)):
            return value
        raise ValueError
    return value  # a hint that only the backend can judge


def _converted_tuple(value: Any, arguments: tuple[Any, ...], who: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise ValueError
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(value) != len(arguments):
        raise ValueError
    return tuple(
        _converted(v, hint, f"{who}[{row}]")
        for row, (v, hint) in enumerate(zip(value, arguments, strict=True))
    )
