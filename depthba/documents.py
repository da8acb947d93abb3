"""JSON and YAML that somebody else may have written: parsed, or refused for one known reason.

The parsers themselves answer hostile text with errors of many kinds, or with a tree that no memory
holds: brackets in brackets beyond the depth of the stack, integers beyond all numbers, aliases that
multiply from line to line.
"""

from __future__ import annotations

import json
from typing import Any

import yaml

DEEPEST = 60
"""Lists and mappings within each other. Nothing that is read here has ten."""
MOST_NODES = 200_000
"""Values in a YAML text, each alias counted as all that it stands for."""
_DIGITS = 300
"""Of an integer; one of more is no number that anything here could mean."""


class TooMuch(yaml.YAMLError, ValueError):
    """A text that is nested too deep, or whose aliases stand for too much."""


def parse_json(text: str) -> Any:  # untyped until who reads it has checked it
    """Parse JSON, as Python does, with NaN and infinity; an integer beyond `float` is infinite.

    Raises:
        ValueError: it is not JSON, or nested too deep.

    """
    try:
        return json.loads(text, parse_int=_integer)
    except RecursionError:
        raise ValueError("nested too deep") from None


def parse_yaml(text: str) -> Any:  # untyped until who reads it has checked it
    """Parse YAML of plain values: no tag makes an object of any other kind.

    Raises:
        yaml.YAMLError: it is not YAML, is nested too deep, or its aliases stand for too much.

    """
    check_yaml(text)
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise
    except (ValueError, OverflowError, TypeError, KeyError, AttributeError) as error:
        # dates that do not exist, merges of what cannot be merged, numbers such as 0o9 and __
        raise TooMuch(f"a value that cannot be read: {error}") from error


def check_yaml(text: str) -> None:
    """Refuse YAML that is small as a text and large as a tree; other faults are left to the parser.

    Raises:
        TooMuch: it is nested too deep, an alias lies in what it stands for, or aliases stand for
            more than `MOST_NODES` values.

    """
    # libyaml gives up on some text that Python's own parser, which reads it in the end, takes
    for loader in (getattr(yaml, "CSafeLoader", yaml.SafeLoader), yaml.SafeLoader):
        try:
            _check_events(text, loader)
            return
        except TooMuch:
            raise
        except yaml.YAMLError:
            continue


def _check_events(text: str, loader: Any) -> None:
    sizes: dict[str, int] = {}
    opened: list[tuple[str | None, int]] = []  # anchor, and the nodes before it
    nodes = 0
    for event in yaml.parse(text, Loader=loader):
        if isinstance(event, yaml.AliasEvent):
            if any(anchor == event.anchor for anchor, _ in opened):
                raise TooMuch(f"alias {event.anchor!r} lies in what it stands for")
            nodes += sizes.get(str(event.anchor), 1)
        elif isinstance(event, yaml.ScalarEvent):
            nodes += 1
            if event.anchor is not None:
                sizes[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            opened.append((event.anchor, nodes))
            nodes += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = opened.pop()
            if anchor is not None:
                sizes[anchor] = nodes - before
        if len(opened) > DEEPEST:
            raise TooMuch(f"nested deeper than {DEEPEST} times")
        if nodes > MOST_NODES:
            raise TooMuch(f"its aliases stand for more than {MOST_NODES} values")


def _integer(digits: str) -> int | float:
    return int(digits) if len(digits) <= _DIGITS else float(digits)
