"""Reads the fenced blocks of a page, and what comments before them say of how they are run.

A comment alone on the line before a block is one of

    <!-- not run: REASON -->    shown only: hardware, downloads, windows
    <!-- file: NAME -->         written to a file of that name, too, where later blocks find it
    <!-- status: N -->          the last command ends with that status
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
RUN = ("sh", "python")
"""Languages that are run; any other block is not code of ours."""
SHOWN = ("text", "json", "toml", "yaml")
KEYS = ("not run", "file", "status")

_FENCE = re.compile(r"^(?P<indent> *)```(?P<language>[\w-]*)\s*$")
_NOTE = re.compile(r"^ *<!-- (?P<key>[a-z ]+): (?P<value>.+) -->$")


@dataclass(frozen=True)
class Block:
    """A fenced block."""

    page: str
    line: int
    """Of its first line, from 1."""
    language: str
    text: str
    notes: dict[str, str]


def pages() -> list[str]:
    """Return the pages that have blocks to run, relative to the root."""
    found = ["README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]
    return [name for name in found if any(block.language in RUN for block in blocks(name))]


def blocks(page: str) -> list[Block]:
    """Return the blocks of a page in order."""
    out: list[Block] = []
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    k = 0
    while k < len(lines):
        fence = _FENCE.match(lines[k])
        if fence is None:
            k += 1
            continue
        end = next(j for j in range(k + 1, len(lines)) if lines[j].strip() == "```")
        indent = len(fence["indent"])
        text = "\n".join(line[indent:] for line in lines[k + 1 : end]) + "\n"
        out.append(Block(page, k + 2, fence["language"], text, _notes(lines, k)))
        k = end + 1
    return out


def _notes(lines: list[str], fence: int) -> dict[str, str]:
    """Return what the comments right before a fence say."""
    notes = {}
    while fence > 0 and (note := _NOTE.match(lines[fence - 1])):
        notes[note["key"]] = note["value"]
        fence -= 1
    return notes
