"""Runs one method on one dataset in a process of its own.

``python -m eval.benchmark.child FOLDER``: ``FOLDER/request.json`` says what to do; ``poses.txt``
and ``outcome.json`` are left there. Where a disk takes nothing more there is no outcome, for that
says nothing of a method: the process ends with the status `NO_DISK`.
"""

from __future__ import annotations

import errno
import json
import os
import resource
import sys
import threading
import traceback
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from depthba.dataset import Dataset
from depthba.errors import DepthbaError, MissingPackage
from depthba.trajectory import write_tum
from eval.benchmark.judging import judge
from eval.benchmark.outcome import POSES, Outcome
from eval.benchmark.warming import warm
from eval.methods import MethodError, Task, find_method

REQUEST = "request.json"
NO_DISK = 74
"""Status of a process whose disk is full or read-only (EX_IOERR of sysexits.h)."""
_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}


def main(folder: Path) -> None:
    """Do what the request says; every end but a crash or a disk's leaves an outcome."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    request = json.loads((folder / REQUEST).read_text(encoding="utf-8"))
    blank = Outcome.of_json(request["outcome"])
    try:
        run(folder, request, blank).write(folder)
    except Exception as error:
        refused = disk_error(error)
        if refused is None:
            raise
        _say(refused.strerror or str(refused))
        os._exit(NO_DISK)  # at once: a thread that hears stdin cannot be waited for


def disk_error(error: BaseException | None) -> OSError | None:
    """Return what a disk said that takes nothing more, if that is behind an error."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, OSError) and error.errno in _DISK:
            return error
        seen.add(id(error))
        error = error.__cause__ or error.__context__
    return None


def run(folder: Path, request: dict[str, Any], blank: Outcome) -> Outcome:
    """Run the method and judge what it found; what a full disk ends is raised."""
    dataset = Dataset.open(request["dataset"])
    if request["first"] is not None:
        dataset = dataset.subset(range(min(request["first"], len(dataset))))
    cache = Path(request["cache"])
    cache.mkdir(parents=True, exist_ok=True)
    task = Task.of(dataset, threads=request["threads"], cache=cache, say=_say)
    try:
        method = find_method(blank.method)
        warm(method, task.threads)
        found = method.run(task)
        if not np.isfinite(found.T_world_camera).all():
            raise MethodError("its poses are not finite")
    except MissingPackage as error:
        return replace(blank, status="missing", reason=_line(error))
    except (MethodError, DepthbaError) as error:
        if disk_error(error):
            raise
        return replace(blank, status="failed", reason=_line(error), memory=_most_memory())
    except MemoryError:
        return replace(blank, status="memory", reason="no memory left", memory=_most_memory())
    except Exception as error:
        if disk_error(error):
            raise
        at = traceback.extract_tb(error.__traceback__)[-1]
        reason = f"{type(error).__name__}: {_line(error)} ({Path(at.filename).name}:{at.lineno})"
        return replace(blank, status="crashed", reason=reason, memory=_most_memory())
    memory = _most_memory()
    stamps = np.array([frame.stamp for frame in dataset])
    write_tum(folder / POSES, stamps, found.T_world_camera, blank.method)
    return replace(
        blank,
        status="done",
        seconds=dict(found.seconds),
        memory=memory,
        iterations=found.iterations,
        notes=found.notes,
        metrics=tuple(judge(task, found)),
    )


def _most_memory() -> float:
    """Return the most memory that this process held so far, bytes.

    Linux hands ru_maxrss on from whoever started the process; its own mark is in /proc.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return 1024.0 * float(line.split()[1])
    unit = 1 if sys.platform == "darwin" else 1024
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit)


def _end_with_parent() -> None:
    """Whoever asked holds the other end of stdin: where it closes, nobody waits any more."""
    sys.stdin.buffer.read()
    os._exit(1)


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
