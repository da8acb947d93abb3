"""Writing that survives a crash at any instant: a file is there whole, or not at all.

All functions raise `OSError` when the disk refuses; what was there before then still is.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from pathlib import Path

PART = ".part"
"""Suffix of the temporary names; a crash can leave one behind, and it means nothing."""


def write_bytes(path: str | Path, data: bytes) -> str:
    """Put ``data`` at ``path`` at once, on disk when this returns; return its sha256 in hex."""
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}{PART}")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise
    sync_folder(path.parent)
    return hashlib.sha256(data).hexdigest()


def write_text(path: str | Path, text: str) -> str:
    """Put ``text`` at ``path`` as UTF-8, as `write_bytes` does."""
    return write_bytes(path, text.encode())


def write_json(path: str | Path, value: object) -> str:
    """Put ``value`` at ``path`` as JSON for people (keys in their order), as `write_bytes` does.

    Raises `ValueError` for NaN and infinity, which JSON does not have.
    """
    return write_text(path, json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def append_line(path: str | Path, line: str) -> None:
    """Append one line (its newline is added) with a single write, on disk when this returns."""
    path = Path(path)
    if "\n" in line:
        raise ValueError(f"a line with a newline in it: {line!r}")
    data = (line + "\n").encode()
    new = not path.exists()
    fd = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    try:
        size = os.fstat(fd).st_size
        try:
            written = os.write(fd, data)
            if written != len(data):
                raise OSError(f"{path}: only {written} of {len(data)} bytes were written")
            os.fsync(fd)
        except OSError:
            # Half a line must not stay, else the next one would be glued to it.
            os.ftruncate(fd, size)
            raise
    finally:
        os.close(fd)
    if new:
        sync_folder(path.parent)


def make_folder(path: str | Path) -> None:
    """Make a folder and those above it, on disk when this returns; it may be there already."""
    path = Path(path)
    missing = [p for p in (path, *path.parents) if not p.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for made in missing:
        sync_folder(made.parent)


def sync_folder(path: str | Path) -> None:
    """Make the names in a folder durable."""
    if os.name == "nt":  # Windows cannot open a folder, and makes renames durable by itself
        return
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
