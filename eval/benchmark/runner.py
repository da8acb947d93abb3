"""Runs the jobs of a benchmark: each method in its own process, under limits, resumable.

A job is all methods on one dataset. Jobs run side by side in the processes of this machine or on a
Dask cluster; what has an outcome is not run again.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import suppress
from dataclasses import replace
from typing import IO

from depthba import durable
from depthba.errors import DepthbaError, OptionError
from eval.benchmark import outcome
from eval.benchmark.child import NO_DISK, REQUEST
from eval.benchmark.outcome import Outcome
from eval.benchmark.plan import Case, Job
from sim.workers import ClusterWorkers, LocalWorkers, Workers, cores

Told = Callable[[int, int, str], None]
"""Called with the methods dealt with, those in all, and what is being done."""

POLL = 0.2
"""Seconds between looks at a running method."""
TRIES = 2
"""Times that a job whose worker was lost is given out again."""
THREADS = tuple(f"{name}_THREADS" for name in ("OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "NUMBA_NUM"))


def run(
    jobs: Iterable[Job], workers: int | None, scheduler: str | None, told: Told
) -> list[Outcome]:
    """Run jobs and return all outcomes, in the order of jobs and methods.

    Raises:
        DepthbaError: the scheduler is not there or went away. What is done stays.

    """
    jobs = list(jobs)
    total = sum(len(job.methods) for job in jobs)
    queue = deque(job for job in jobs if any(needed(job, m) for m in job.methods))
    told(sum(_done(job) for job in jobs), total, "looking what is there")
    if queue:
        staff: Workers = (
            LocalWorkers(min(workers or cores(), len(queue)))
            if scheduler is None
            else ClusterWorkers(scheduler)
        )
        _give_out(queue, staff, lambda text: told(sum(map(_done, jobs)), total, text))
    told(total, total, "done")
    return [_kept(job, method) for job in jobs for method in job.methods]


def needed(job: Job, method: str) -> bool:
    """Tell whether a method has still to run: no outcome, a stale one, or limits were raised."""
    there = outcome.read(job.folder(method))
    if there is None or there.key != job.key(method):
        return True
    if there.status == "done" and not (job.folder(method) / outcome.POSES).is_file():
        return True
    if there.status in ("time", "memory"):
        limit = "seconds" if there.status == "time" else "bytes"
        return there.limits.get(limit, 0.0) < _limits(job)[limit]
    return there.status in ("missing", "no dataset")


def perform(job: Job) -> str | None:
    """In a worker: run what is needed of a job; return the line of an error, None without one."""
    try:
        _make_dataset(job)
    except DepthbaError as error:
        for method in job.methods:
            folder = job.folder(method)
            folder.mkdir(parents=True, exist_ok=True)
            blank = _blank(job, method)
            replace(blank, status="no dataset", reason=" ".join(str(error).split())).write(folder)
        return None
    for method in job.methods:
        if needed(job, method):
            try:
                _run_method(job, method)
            except OSError as error:
                return f"{job.folder(method)}: {error.strerror or error}"
    return None


def _give_out(queue: deque[Job], staff: Workers, told: Callable[[str], None]) -> None:
    running: dict[Future[str | None], Job] = {}
    tries: dict[str, int] = {}
    now = True
    try:
        while queue or running:
            for _ in range(min(staff.room(), len(queue))):
                job = queue.popleft()
                running[staff.submit(perform, job)] = job
            finished, _ = wait(running, timeout=1.0, return_when=FIRST_COMPLETED)
            for future in finished:
                job, error = running.pop(future), staff.outcome(future)
                tries[job.case.name] = tries.get(job.case.name, 0) + 1
                if error is not None and tries[job.case.name] <= TRIES:
                    queue.append(job)
                elif error is not None:
                    raise DepthbaError(f"{job.case.name}: {error}")
            names = ", ".join(sorted(_state(job) for job in running.values()))
            told(names or staff.state())
        now = False
    finally:
        staff.stop(now)


def _state(job: Job) -> str:
    """Say which method of a job runs."""
    name = next((m for m in job.methods if needed(job, m)), "done")
    return f"{job.case.name} {name}"


def _done(job: Job) -> int:
    return sum(not needed(job, method) for method in job.methods)


def _kept(job: Job, method: str) -> Outcome:
    there = outcome.read(job.folder(method))
    if there is None:
        return replace(_blank(job, method), status="crashed", reason="left no outcome")
    return there


def _blank(job: Job, method: str) -> Outcome:
    case = job.case
    return Outcome(
        key=job.key(method),
        dataset=case.name,
        group=case.group,
        seed=case.seed,
        method=method,
        status="crashed",
        limits=_limits(job),
        varied=case.varied,
    )


def _limits(job: Job) -> dict[str, float]:
    return {"seconds": job.seconds, "bytes": job.memory}


def _make_dataset(job: Job) -> None:
    case: Case = job.case
    if case.scene is None or case.options is None:
        return
    import sim

    sim.generate(case.scene, case.path, case.options)


def _run_method(job: Job, method: str) -> None:
    """Run a method in a child process; whatever becomes of it, an outcome is there then.

    OSError: a disk takes nothing more. That is no outcome: the method runs again.
    """
    folder = job.folder(method)
    folder.mkdir(parents=True, exist_ok=True)
    for name in (outcome.FILE, outcome.POSES):
        (folder / name).unlink(missing_ok=True)
    blank = _blank(job, method)
    shown = job.case.path.resolve()
    request = {
        "outcome": blank.as_json(),
        "dataset": str(shown),
        "first": job.case.first,
        "threads": job.threads,
        "cache": str((job.out / job.case.name / ".pairs").resolve()),
    }
    durable.write_json(folder / REQUEST, request)
    environment = {**os.environ, **dict.fromkeys(THREADS, str(job.threads))}
    with tempfile.TemporaryFile() as log:
        child = subprocess.Popen(
            [sys.executable, "-m", "eval.benchmark.child", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=log,
            env=environment,
        )
        try:
            ended = _watch(child, job)
        finally:
            if child.poll() is None:
                child.kill()
            child.wait()
            if child.stdin is not None:
                child.stdin.close()
        (folder / REQUEST).unlink(missing_ok=True)
        if child.returncode == NO_DISK and ended is None:
            raise OSError(_last_line(log) or "the disk takes nothing more")
        if outcome.read(folder) is None:
            status, reason, memory = ended or ("crashed", _last_words(child.returncode, log), None)
            replace(blank, status=status, reason=reason, memory=memory).write(folder)


def _watch(child: subprocess.Popen[bytes], job: Job) -> tuple[outcome.Status, str, float] | None:
    """Wait for a child; return why it was stopped, None where it ended by itself."""
    import psutil

    began, most = time.monotonic(), 0.0
    process = psutil.Process(child.pid)
    while True:
        try:
            child.wait(POLL)
            return None
        except subprocess.TimeoutExpired:
            pass
        with suppress(psutil.Error):
            most = max(most, float(process.memory_info().rss))
        if most > job.memory:
            child.kill()
            return "memory", f"stopped: it held more than {job.memory / 1e9:.3g} GB", most
        if time.monotonic() - began > job.seconds:
            child.kill()
            return "time", f"stopped: it took longer than {job.seconds:.0f} s", most


def _last_words(status: int | None, log: IO[bytes]) -> str:
    """Say how a process ended that left nothing."""
    line = _last_line(log)
    said = f": {line}" if line else ""
    if status is not None and status < 0:
        return f"its process was ended by signal {-status}{said}"[:300]
    return f"its process ended with status {status}{said}"[:300]


def _last_line(log: IO[bytes]) -> str:
    log.seek(0)
    lines = log.read().decode(errors="replace").strip().splitlines()
    return lines[-1].strip() if lines else ""


def check(workers: int | None, scheduler: str | None) -> None:
    """Refuse workers that make no sense; OptionError."""
    if workers is not None and workers < 1:
        raise OptionError(f"--workers {workers}: expected 1 or more")
    if workers is not None and scheduler is not None:
        raise OptionError(
            f"--workers {workers}: the scheduler has its own, expected one of the two"
        )
