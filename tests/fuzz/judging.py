"""What a reader may do with a hostile input: refuse it by a known error, soon, in little memory.

A `Judge` watches one process, this one: which files are opened, how much memory is asked for, and
how long an input takes. It is meant for a child process, for a hang ends the process.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import os
import resource
import site
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from depthba.errors import DepthbaError

ROOT = Path(__file__).parents[2]
SPARE = 200_000_000
"""Bytes that reading may take beside twice the input."""
LONGEST_LINE = 3000
_OPENS = {
    "open", "os.listdir", "os.scandir", "os.remove", "os.rename", "os.mkdir", "os.rmdir",
    "os.symlink", "os.link", "os.chmod", "os.truncate", "os.utime", "shutil.copyfile",
    "shutil.move", "shutil.rmtree", "sqlite3.connect",
}  # fmt: skip
"""Events of Python's audit hooks whose first arguments are paths."""


class Judge:
    """Runs readers on inputs and says what was wrong with that, if anything."""

    def __init__(self, deadline: float) -> None:
        """Watch this process for good; after ``deadline`` s with one input it is ended."""
        self._deadline = deadline
        self._inside: tuple[str, ...] = ()
        self._strayed: list[str] = []
        self._judged = 0
        machine = ("/proc", "/sys", "/dev/null", "/dev/urandom", "/usr/share/zoneinfo")
        python = {sys.prefix, sys.base_prefix, sys.exec_prefix, *site.getsitepackages()}
        self._program = tuple(
            os.path.realpath(path) for path in (*machine, *python, ROOT / "depthba", ROOT / "sim",
                                                ROOT / "rig", ROOT / "eval", ROOT / "tests")
        )  # fmt: skip
        sys.addaudithook(self._heard)

    def judge(
        self, read: Callable[[], object], folder: Path, size: int, anywhere: bool = False
    ) -> str:
        """Return what went wrong while an input of ``size`` bytes was read; "" where nothing did.

        Args:
            read: reads the input; may raise what `depthba` would print in one line.
            folder: the only one whose files may be opened.
            size: bytes of the input.
            anywhere: files elsewhere may be opened, too.
        """
        self._judged += 1
        if self._judged % 100 == 0:  # each time would take longer than reading
            gc.collect()
        self._strayed.clear()
        fault = ""
        faulthandler.dump_traceback_later(self._deadline, exit=True)
        try:
            with self._watched(folder), _less_memory(SPARE + 2 * size):
                read()
        except DepthbaError as error:
            line = " ".join(str(error).split())
            if not 8 <= len(line) <= LONGEST_LINE:
                fault = f"{type(error).__name__} with a line of {len(line)} characters: {line[:80]}"
        except OSError as error:
            # as `depthba.cli` prints it: which file, and what is wrong with it
            if error.errno is None or error.filename is None:
                fault = _described(error)
        except MemoryError as error:
            fault = f"asked for more than {SPARE} bytes and twice the input: {_described(error)}"
        except Exception as error:
            fault = _described(error)
        finally:
            faulthandler.cancel_dump_traceback_later()
        if self._strayed and not anywhere:
            fault += f" opened {self._strayed[:3]}"
        return fault

    @contextlib.contextmanager
    def _watched(self, folder: Path) -> Iterator[None]:
        self._inside = (*self._program, os.path.realpath(folder))
        try:
            yield
        finally:
            self._inside = ()

    def _heard(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._inside or event not in _OPENS:
            return
        for path in arguments[: 2 if event in ("os.rename", "os.link", "shutil.move") else 1]:
            if isinstance(path, bytes):
                path = os.fsdecode(path)
            if isinstance(path, str | os.PathLike) and not str(path).startswith(":"):
                try:
                    real = os.path.realpath(path)
                except ValueError:  # a NUL in it: it cannot be opened either
                    continue
                if not any(real == home or real.startswith(home + "/") for home in self._inside):
                    self._strayed.append(f"{event} {real}")


@contextlib.contextmanager
def _less_memory(spare: int) -> Iterator[None]:
    """Let this process have no more than ``spare`` bytes beyond what it has."""
    with open("/proc/self/statm", encoding="ascii") as file:
        now = int(file.read().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (now + spare, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def _described(error: BaseException) -> str:
    """Return an error by its type, its text and the places of ours where it came up."""
    ours = [
        f"{Path(at.filename).name}:{at.lineno}"
        for at in traceback.extract_tb(error.__traceback__)
        if any(f"/{package}/" in at.filename for package in ("depthba", "sim", "rig", "eval"))
        and "site-packages" not in at.filename
        and "/tests/" not in at.filename
    ]
    text = " ".join(str(error).split())[:200]
    return f"{type(error).__name__}: {text} ({' > '.join(ours[-3:])})"
