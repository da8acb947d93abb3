"""What holds for all tests."""

from __future__ import annotations

from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[1] / "depthba"


def pytest_configure(config: pytest.Config) -> None:
    """Let kernels be compiled anew that are older than a part of theirs in another module.

    Numba goes by the file of the kernel itself alone.
    """
    if hasattr(config, "workerinput"):
        return
    with_kernels = [p for p in SOURCES.rglob("*.py") if "depthba.compiling" in p.read_text("utf-8")]
    newest = max(p.stat().st_mtime for p in with_kernels)
    for index in SOURCES.rglob("__pycache__/*.nbi"):
        if index.stat().st_mtime < newest:
            index.unlink(missing_ok=True)
