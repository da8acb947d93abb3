"""Where a recording goes: into a file, to a viewer or both.

Rerun's own file writer waits forever for a thread that ended when the disk was full, and the
program with it. So it writes into a pipe, which takes everything; what comes out goes to the disk
here, where errors can be told.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import threading
from pathlib import Path
from typing import Any

import rerun as rr

APPLICATION = "depthba"
FLUSH_SECONDS = 20.0
"""For what is on its way to a viewer or to the disk."""
PART_SECONDS = 30.0
"""After so much time a part of the recording is written."""
_AT_ONCE = 1 << 20
"""Bytes that are taken from the pipe."""
_LOOK_SECONDS = 0.1
"""After so long without any it is asked whether more will come."""


class RecordingFile:
    """A recording on its way; it stands under its name once `finish` was called.

    Before, it has a hidden one.
    """

    def __init__(
        self,
        path: Path | None,
        viewer: str | None = None,
        stream: rr.RecordingStream | None = None,
    ) -> None:
        """Begin; no times are recorded but those that are set.

        Args:
            path: the file, in a folder that exists; None: there is none.
            viewer: address of a viewer, see `eval.live`.
            stream: what to take down; None: a new one. Without a viewer that waits for it, what
                comes is put together into few large parts: they are read faster.

        Raises:
            OSError: the file cannot be written.

        """
        self.path = path
        self._part = path and path.with_name(f".{path.name}.{os.getpid()}.part")
        self._drain: _Drain | None = None
        sinks: list[Any] = []
        if self._part is not None and os.name != "nt":
            self._drain = _Drain(self._part)
            sinks.append(rr.FileSink(f"/dev/fd/{self._drain.inlet}"))
        elif self._part is not None:  # Windows has no pipes with names such as these
            sinks.append(rr.FileSink(self._part))
        if viewer is not None:
            sinks.append(rr.GrpcSink(viewer))
        if stream is None:
            parts = rr.ChunkBatcherConfig(flush_tick=PART_SECONDS) if viewer is None else None
            stream = rr.RecordingStream(APPLICATION, batcher_config=parts)
        stream.set_log_tick_enabled(False)
        stream.set_log_time_enabled(False)
        self.stream = stream
        try:
            stream.set_sinks(*sinks)
        except BaseException:
            self.discard()
            raise
        finally:
            if self._drain is not None:
                self._drain.opened()

    def finish(self) -> None:
        """Bring everything to where it goes; a viewer that has been closed does not count.

        Raises:
            OSError: the file could not be written whole. It is gone.

        """
        with contextlib.suppress(RuntimeError):
            self.stream.flush(timeout_sec=FLUSH_SECONDS)
        self.stream.disconnect()
        try:
            if self._drain is not None:
                self._drain.close()
            if self._part is not None and self.path is not None:
                self._part.replace(self.path)
        except OSError:
            self.discard()
            raise

    def discard(self) -> None:
        """End without a recording and leave no file."""
        self.stream.disconnect()
        if self._drain is not None:
            with contextlib.suppress(OSError):
                self._drain.close()
        if self._part is not None:
            with contextlib.suppress(OSError):  # such as on a disk that is read-only by now
                self._part.unlink()


class _Drain:
    """Writes what comes out of a pipe into a file; where that fails, it goes on taking it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("wb", buffering=0)
        self._outlet, self.inlet = os.pipe()
        self._error: OSError | None = None
        self._last = threading.Event()
        # not waited for where nobody ends the recording
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    def opened(self) -> None:
        """Leave the pipe to whoever has opened it by its number: it ends when that does."""
        os.close(self.inlet)

    def close(self) -> None:
        """Wait until what is in the pipe by now is in the file; OSError where not all of it is."""
        self._last.set()
        self._thread.join()
        if self._error is not None:
            raise OSError(self._error.errno, self._error.strerror, str(self._path))

    def _run(self) -> None:
        with self._file as file, selectors.DefaultSelector() as pipe:
            pipe.register(self._outlet, selectors.EVENT_READ)
            # it has no end for as long as a process that was forked meanwhile holds it open, too
            while (ready := pipe.select(_LOOK_SECONDS)) or not self._last.is_set():
                part = os.read(self._outlet, _AT_ONCE) if ready else None
                if part == b"":
                    break
                self._write(part or b"")
            os.close(self._outlet)
            try:
                os.fsync(file.fileno())
            except OSError as error:
                self._error = self._error or error

    def _write(self, part: bytes) -> None:
        left = memoryview(part)
        try:
            while left and self._error is None:
                left = left[self._file.write(left) :]
        except OSError as error:
            self._error = error
