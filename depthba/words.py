"""Small words for messages."""

from __future__ import annotations


def count(number: int, what: str) -> str:
    """Return such as "1 frame" or "3 frames"."""
    return f"{number} {what}{'' if number == 1 else 's'}"
