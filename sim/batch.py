"""Datasets in great number: one scene, seeds in turn, on all cores or on a cluster.

One dataset is one piece of work. Its bytes hang on its seed alone, so it does not matter who makes
it, when, or how often it was begun. (Machines of another kind may round otherwise.)
"""

from __future__ import annotations

import contextlib
import os
import platform
import threading
import time
import traceback
from collections import Counter, deque
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, replace
from pathlib import Path

from depthba.durable import PART
from depthba.errors import DatasetError, DepthbaError, OptionError
from sim.generation import Progress, generate, is_complete
from sim.locks import TakenError, locked
from sim.options import DEFAULTS, GenerateOptions
from sim.scenes import find_scene
from sim.workers import ClusterWorkers, LocalWorkers, Workers, cores

LOCKS = ".locks"
"""Folder of the lock files, in the batch's folder while it is made."""


@dataclass(frozen=True)
class Failure:
    """A dataset that could not be made."""

    seed: int
    error: str
    """One line, of the last try."""


@dataclass(frozen=True)
class BatchReport:
    """How a batch went."""

    folder: Path
    done: int
    """Datasets made or finished now."""
    skipped: int
    """Datasets that were there already."""
    failed: tuple[Failure, ...]
    """In the order of their seeds."""
    seconds: float

    def line(self, most: int = 5) -> str:
        """One line that names what failed, the first `most` with their errors."""
        named = [f"seed {f.seed} ({f.error})" for f in self.failed[:most]]
        rest = [str(f.seed) for f in self.failed[most:]]
        if rest:
            named.append(f"and seeds {' '.join(rest)}")
        total = self.done + self.skipped + len(self.failed)
        return f"{self.folder}: {len(self.failed)} of {total} datasets failed: {', '.join(named)}"


@dataclass(frozen=True)
class Work:
    """One dataset to make."""

    scene: str
    folder: Path
    options: GenerateOptions
    batch: Path
    """The lock file of the batch it belongs to,"""
    token: str
    """and what that says as long as the batch goes on."""


def generate_many(
    scene: str,
    out: str | Path,
    count: int,
    options: GenerateOptions = DEFAULTS,
    workers: int | None = None,
    scheduler: str | None = None,
    retries: int = 2,
    progress: Progress | None = None,
) -> BatchReport:
    """Make `count` datasets with the seeds options.seed, + 1, … in folders `out`/<scene>-<seed>.

    Those that are finished already are skipped, those cut short are resumed, and those that fail
    are tried again up to `retries` times, while the rest go on. A script that calls this needs
    `if __name__ == "__main__":`, since the workers import it.

    Args:
        scene: a name of `sim.SCENES`, the path of an MJCF file, or `module:function`.
        out: folder of the batch.
        count: how many datasets.
        options: of every dataset, but for the seed.
        workers: processes on this machine, None as many as it has cores.
        scheduler: address of a Dask scheduler, in place of `workers`. Its workers need this package
            and the same file system, and do best with one thread each (`--nthreads 1`).
        retries: further tries of a dataset that fails.
        progress: called with the datasets dealt with, those in all, and what is being done.

    Raises:
        DepthbaError: nothing could begin (an unknown scene, a bad option, another batch at work in
            `out`), or the scheduler went away.
    """
    begin, report = time.perf_counter(), progress or (lambda done, total, text: None)
    out = Path(out).absolute()
    name = _checked(scene, count, options, workers, scheduler, retries)
    token = f"process {os.getpid()} on {platform.node()}, {time.time_ns()}"
    batch = out / LOCKS / "batch"
    try:
        with locked(batch, token, wait=False):
            works: list[Work] = []
            for seed in range(options.seed, options.seed + count):
                folder, own = out / f"{name}-{seed:06d}", replace(options, seed=seed)
                if not is_complete(scene, folder, own):
                    works.append(Work(scene, folder, own, batch, token))
            report(count - len(works), count, "starting" if works else "nothing to do")
            failed: list[Failure] = []
            if works:
                staff: Workers = (
                    LocalWorkers(min(workers or cores(), len(works)))
                    if scheduler is None
                    else ClusterWorkers(scheduler)
                )
                failed = _make_all(works, staff, retries, count, report)
            _sweep(batch)
    except TakenError as taken:
        holder = str(taken).rpartition(",")[0] or "another process"
        raise DatasetError(f"{out}: {holder} is generating here; expected to be alone") from None
    return BatchReport(
        out,
        len(works) - len(failed),
        count - len(works),
        tuple(sorted(failed, key=lambda failure: failure.seed)),
        time.perf_counter() - begin,
    )


def _checked(
    scene: str,
    count: int,
    options: GenerateOptions,
    workers: int | None,
    scheduler: str | None,
    retries: int,
) -> str:
    """Refuse what no dataset could be made of; return what the datasets are called."""
    from sim.capture import sensor_of
    from sim.noise import choose_stages
    from sim.rigs import find_rig

    if count < 1:
        raise OptionError(f"count {count}: expected 1 or more")
    if retries < 0:
        raise OptionError(f"retries {retries}: expected 0 or more")
    if workers is not None and scheduler is not None:
        raise OptionError(f"workers {workers}: the scheduler has its own, expected one of the two")
    if workers is not None and workers < 1:
        raise OptionError(f"workers {workers}: expected 1 or more")
    entry = find_scene(scene)
    sensor_of(entry, options)
    choose_stages(options.clean, options.without, options.white)
    find_rig(options.rig or entry.rig)
    if scheduler is not None and Path(scene).is_file() and not Path(scene).is_absolute():
        raise OptionError(
            f"scene {scene}: expected an absolute path, which the scheduler's workers find too"
        )
    return entry.id


def _make_all(
    works: list[Work], staff: Workers, retries: int, count: int, report: Progress
) -> list[Failure]:
    queue, tries = deque(works), Counter[int]()
    running: dict[Future[str | None], Work] = {}
    failed: list[Failure] = []
    now = True  # until all is done
    try:
        report(count - len(works), count, staff.state())
        while queue or running:
            for _ in range(min(staff.room(), len(queue))):
                work = queue.popleft()
                running[staff.submit(make, work)] = work
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                work, error = running.pop(future), staff.outcome(future)
                seed = work.options.seed
                tries[seed] += 1
                if error is not None and tries[seed] <= retries:
                    queue.append(work)  # behind the others: what was amiss may be over by then
                elif error is not None:
                    failed.append(Failure(seed, error))
            text = f"{staff.state()}, {len(failed)} failed" if failed else staff.state()
            report(count - len(queue) - len(running), count, text)
        now = False
    finally:
        staff.stop(now)
    return failed


def _sweep(batch: Path) -> None:
    """Remove the lock files of workers that were killed."""
    for lock in batch.parent.iterdir():
        if lock != batch:
            with contextlib.suppress(TakenError), locked(lock, wait=False):
                pass


class _OverError(Exception):
    """The batch that wanted this dataset is no more."""


_one_at_a_time = threading.Lock()
"""A worker of a cluster may have threads, and MuJoCo's compiler is not made for that."""


def make(work: Work) -> str | None:
    """In a worker: make one dataset; return the line of the error, None without one."""
    try:
        with _one_at_a_time, locked(work.batch.parent / work.folder.name):
            _clear(work.folder)
            generate(work.scene, work.folder, work.options, lambda *frame: _go_on(work))
    except DepthbaError as error:
        return " ".join(str(error).split())
    except Exception as error:
        at = traceback.extract_tb(error.__traceback__)[-1]
        text = " ".join(f"{type(error).__name__}: {error}".split())
        return f"{text} ({Path(at.filename).name}:{at.lineno})"
    return None


def _go_on(work: Work) -> None:
    """A cluster's worker outlives the one who gave it work: see whether that is still there."""
    try:
        if work.batch.read_text() == work.token:
            return
    except FileNotFoundError:
        pass
    raise _OverError(f"{work.folder}: given up, as the batch has ended")


def _clear(folder: Path) -> None:
    """Remove the unfinished files that a crash leaves under temporary names."""
    for part in (part for f in (folder, folder / "scene") for part in f.glob(f".*{PART}")):
        part.unlink()
