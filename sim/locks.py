"""Lock files: one process at a time, also between the machines of a shared file system.

A lock ends with the process that holds it, however that ends.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

# On Windows nothing is locked, and a second writer is found out as it writes.
if sys.platform != "win32":
    import fcntl


class TakenError(Exception):
    """Another process holds the lock; the text is what that process wrote into it."""


@contextlib.contextmanager
def locked(path: Path, text: str = "", wait: bool = True) -> Iterator[None]:
    """Hold the lock file `path`, which is there with `text` in it as long as it is held.

    Waits for another holder to end, or raises TakenError where `wait` is False.
    """
    fd = _take(path, wait)
    try:
        os.truncate(fd, 0)
        os.write(fd, text.encode())
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(fd)
        with contextlib.suppress(OSError):  # the last lock takes its folder along
            path.parent.rmdir()


def _take(path: Path, wait: bool) -> int:
    while True:
        with contextlib.suppress(FileNotFoundError):  # the folder went away in between
            path.parent.mkdir(parents=True, exist_ok=True)
            fd = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                if sys.platform != "win32":
                    fcntl.flock(fd, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
                # The one who held it before may have removed the file that we waited for.
                if os.path.samestat(os.fstat(fd), os.stat(path)):
                    return fd
            except BlockingIOError:
                text = os.pread(fd, 4096, 0).decode(errors="replace")
                os.close(fd)
                raise TakenError(text) from None
            except FileNotFoundError:
                pass  # removed while we waited for it: once more
            except BaseException:
                os.close(fd)
                raise
            os.close(fd)
