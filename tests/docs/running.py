"""Runs the blocks of a page in a folder, in order, as a reader would type them."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

from depthba.cli import main
from tests.docs.pages import ROOT, Block

LIMIT = 300.0
"""Seconds after which a command hangs."""


class Reader:
    """Somebody who types what a page says, in a folder of their own."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._names: dict[str, Any] = {"__name__": "__main__"}
        programs = folder / ".programs"
        programs.mkdir()
        program = programs / "depthba"
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m depthba "$@"\n')
        program.chmod(0o755)
        self._environment = {
            **os.environ,
            "HOME": str(folder),
            "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)]),
        }

    def does(self, block: Block) -> None:
        """Run a block; it fails where a command ends with another status than the page says."""
        if name := block.notes.get("file"):
            (self._folder / name).write_text(block.text)
        where = f"{block.page}:{block.line}"
        if block.language == "python":
            exec(compile("\n" * (block.line - 1) + block.text, where, "exec"), self._names)
            return
        commands = _commands(block.text)
        for k, command in enumerate(commands):
            last = k == len(commands) - 1
            expected = int(block.notes.get("status", "0")) if last else 0
            status = self._typed(command)
            assert status == expected, f"{where}: {command}: status {status}"

    def _typed(self, command: str) -> int:
        words = shlex.split(command, comments=True)
        if words[0] == "depthba" and not {"|", ">"} & set(words):
            try:
                return main(words[1:])  # the same as the program, without starting Python anew
            except SystemExit as end:
                return int(end.code or 0)
        done = subprocess.run(
            ["bash", "-c", command], cwd=self._folder, env=self._environment, timeout=LIMIT
        )
        return done.returncode


def _commands(text: str) -> list[str]:
    """Return the commands of a block, each with its continued lines."""
    joined = text.replace("\\\n", " ")
    return [line for line in joined.splitlines() if line.strip() and not line.startswith("#")]
