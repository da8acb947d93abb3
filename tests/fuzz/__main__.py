"""``python -m tests.fuzz``: fuzzes every target for some minutes, each in a process of its own.

What goes wrong is left in the folder of ``--keep``; moved to ``tests/fuzz/corpus/TARGET/`` it is
tried again by every test run.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.fuzz.child import DEADLINE
from tests.fuzz.judging import ROOT
from tests.fuzz.targets import names

ONE_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1"
)


def new_home() -> tempfile.TemporaryDirectory[str]:
    """Return a folder for the files of a child, in memory where that can be had."""
    memory = "/dev/shm" if os.path.isdir("/dev/shm") else None
    return tempfile.TemporaryDirectory(prefix="depthba-fuzz-", dir=memory)


def fuzz(name: str, seconds: float, seed: int, keep: Path, words: tuple[str, ...] = ()) -> str:
    """Fuzz one target; return what it said, and how it ended where that was not well."""
    folder = keep / name
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "tests.fuzz.child", name, *words]
    command += ["--seconds", str(seconds), "--seed", str(seed), "--keep", str(folder)]
    with (folder / "errors.txt").open("wb") as errors, new_home() as home:
        child = subprocess.Popen(
            [*command, "--home", home], cwd=ROOT, stdout=subprocess.PIPE, stderr=errors, text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT), **ONE_THREAD},
        )  # fmt: skip
        try:
            said, _ = child.communicate(timeout=seconds + 4 * DEADLINE)
        except subprocess.TimeoutExpired:
            child.kill()
            said = child.communicate()[0] + '{"fault": "had to be ended"}\n'
    if child.returncode != 0:
        said += f'{{"fault": "ended with status {child.returncode}, see {folder}"}}\n'
    return said


def main() -> int:
    """Fuzz what is asked for; the status is 1 where anything went wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", help="all, where none is named")
    parser.add_argument("--minutes", type=float, default=10.0, help="for each target")
    parser.add_argument("--seed", type=int, help="None: by the clock")
    parser.add_argument("--keep", type=Path, default=ROOT / "logs" / "fuzz")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="targets at once")
    told = "own: mutations of structure; atheris: guided by coverage"
    parser.add_argument("--driver", choices=("both", "own", "atheris"), default="both", help=told)
    asked = parser.parse_args()
    seed = int(time.time()) if asked.seed is None else asked.seed
    guided = importlib.util.find_spec("atheris") is not None
    if asked.driver == "atheris" and not guided:
        parser.error("atheris is not installed, which has wheels for Linux alone")
    drivers: tuple[tuple[str, ...], ...] = ((), ("--atheris",))
    if asked.driver != "both" or not guided:
        drivers = (("--atheris",),) if asked.driver == "atheris" else ((),)
    seconds = 60.0 * asked.minutes / len(drivers)

    def fuzzed(name: str) -> bool:
        faulty = False
        for words in drivers:
            said = fuzz(name, seconds, seed, asked.keep.resolve(), words)
            print(f"{name}{' guided' if words else ''}: {' '.join(said.split()) or 'sound'}",
                  flush=True)  # fmt: skip
            faulty |= '"fault":' in said
        return faulty

    chosen = asked.targets or names()
    print(f"seed {seed}, {asked.minutes:g} min a target, faults in {asked.keep}", flush=True)
    with ThreadPoolExecutor(asked.workers) as pool:
        faults = pool.map(fuzzed, chosen)
        failed = [name for name, faulty in zip(chosen, faults, strict=True) if faulty]
    print(f"{len(failed)} of the targets went wrong: {' '.join(failed)}" if failed else "all sound")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
