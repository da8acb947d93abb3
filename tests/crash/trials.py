"""Runs of a verb that something happens to, and what is left of what they had committed.

Every run is a process of its own, disturbed once at a moment that chance chooses, looked at, given
again until it is done, and compared with a run that nothing happened to.
"""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
LONGEST = 300.0
"""s, for a run on a machine that has other things to do."""
_ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": str(ROOT),
    **dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
}
_JUMPY = """
import random, sys, time
real, rng, ahead = time.time, random.Random(int(sys.argv[1])), [0.0]
def jumpy():
    if rng.random() < 0.2:
        ahead[0] = rng.choice((-1e9, -86400.0, -3600.0, 0.0, 3600.0, 86400.0, 1e9))
    return real() + ahead[0]
time.time, time.time_ns = jumpy, lambda: int(1e9 * jumpy())
from depthba.cli import main
sys.exit(main(sys.argv[2:]))
"""
"""depthba under a wall clock that jumps; the steady clock goes on, as a machine's does."""


@dataclass(frozen=True)
class Verb:
    """What is disturbed."""

    name: str
    words: Callable[[Path], list[str]]
    """The command line, with where it writes."""
    committed: Callable[[Path], dict[str, str]]
    """What counts by now: names, and sums of bytes. AssertionError: something half-written does."""
    again: tuple[str, ...] = ()
    """What is said besides when it is given again."""


@dataclass
class Tally:
    """What came of the runs of one verb and one fault."""

    runs: int = 0
    committed: int = 0
    lost: int = 0
    broken: list[str] = field(default_factory=list)
    skipped: str = ""


def digest(data: bytes) -> str:
    """Return the sum of bytes."""
    return hashlib.sha256(data).hexdigest()


# Verbs


def _frames(out: Path) -> dict[str, str]:
    """The frames of a dataset, each with all its files."""
    from depthba.dataset import Dataset, verify

    if not (out / "dataset.json").exists():
        return {}
    assert not verify(out), verify(out)[:2]
    found = {}
    for frame in Dataset.open(out):
        files = b"".join((out / stored.path).read_bytes() for stored in frame.files.values())
        found[f"frame {frame.id}"] = digest(files + frame.T_world_camera.tobytes())
    return found


def _run(out: Path) -> dict[str, str]:
    """A run counts as soon as its result.json is there, which is then the last."""
    from depthba.stored_run import Run

    if not (out / "result.json").exists():
        return {}
    run = Run.open(out)
    return {"run": digest(np.round(run.T_world_camera, 9).tobytes())}


def _outcomes(out: Path) -> dict[str, str]:
    """The outcomes of methods, with the poses that they found."""
    from eval.benchmark import outcome

    found = {}
    for file in out.glob("*/*/outcome.json"):
        told = outcome.read(file.parent)
        assert told is not None, f"{file} cannot be read"
        if told.status == "done":
            found[str(file.parent.relative_to(out))] = digest(
                (file.parent / "poses.txt").read_bytes()
            )
    return found


def verbs(dataset: Path) -> tuple[Verb, ...]:
    """Return what is disturbed; ``dataset`` is a small one."""
    scene = ["industrial-6", "--frames", "6", "--size", "64x48", "--seed", "3"]
    solve = ["--resolution", "0.1", "--max-iterations", "3"]
    methods = ["--methods", "initial,gicp-pgo,depthba-paper", "--workers", "1"]
    return (
        Verb("generate", lambda out: ["generate", *scene, "--out", str(out)], _frames),
        Verb("capture", _capture, _frames),
        Verb(
            "register",
            lambda out: ["register", str(dataset), "--out", str(out), *solve],
            _run,
            ("--overwrite",),
        ),
        Verb(
            "benchmark",
            lambda out: ["benchmark", "--datasets", str(dataset), *methods, "--out", str(out)],
            _outcomes,
        ),
    )


def _capture(out: Path) -> list[str]:
    """A rehearsed session of five poses, on an address of this run's own."""
    import yaml

    host = f"127.{150 + os.getpid() % 50}.{(os.getpid() // 50) % 256}.9"
    path = out.with_name("session.yaml")
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        content = yaml.safe_load((ROOT / "docs/sessions/simulated.yaml").read_text())
        content["rig"]["options"]["host"] = content["camera"]["options"]["host"] = host
        content["camera"]["options"]["size"] = [96, 54]
        lines = (ROOT / "docs/sessions/lab_1.txt").read_text().splitlines()
        poses = [line for line in lines if line.partition("#")[0].strip()][:5]
        path.with_name("taught.txt").write_text("\n".join(poses) + "\n")
        content["poses"][0]["taught"]["file"] = "taught.txt"
        path.write_text(yaml.safe_dump(content))
    return ["capture", str(path), "--out", str(out), "--rehearse", "--speed", "20"]


# Running


def start(words: list[str], clock: int | None = None) -> subprocess.Popen[str]:
    """Start depthba, leader of a group of its own; with ``clock`` under one that jumps."""
    how = ["-m", "depthba"] if clock is None else ["-c", _JUMPY, str(clock)]
    return subprocess.Popen(
        [sys.executable, *how, *words], cwd=ROOT, env=_ENVIRONMENT, text=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Wait for a process; return its status and the last line that it said."""
    try:
        _, said = process.communicate(timeout=LONGEST)
    finally:
        if process.poll() is None:
            _kill(process)
            process.wait()
    lines = said.strip().splitlines()
    return process.returncode, lines[-1] if lines else ""


def finish(verb: Verb, out: Path, more: tuple[str, ...] = ()) -> None:
    """Give a verb until it is done; AssertionError where it does not get there."""
    status, said = ended(start([*verb.words(out), *more]))
    assert status in (0, 3), f"given again: status {status}, {said}"


def wait_for(process: subprocess.Popen[str], out: Path, files: int) -> None:
    """Wait until so many files are there, or the process has ended."""
    end = time.monotonic() + LONGEST
    while process.poll() is None and time.monotonic() < end:
        if sum(1 for p in out.rglob("*") if p.is_file()) >= files:
            return
        time.sleep(0.005)


@contextmanager
def small_disk(path: Path, size: str) -> Iterator[Path]:
    """A disk of its own; OSError where none can be made."""
    path.mkdir(parents=True)
    if os.geteuid() != 0 or shutil.which("mount") is None:
        raise OSError("only root can make a small disk")
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(path)],
        capture_output=True, text=True,
    )  # fmt: skip
    if made.returncode != 0:
        raise OSError(f"no small disk can be made here: {made.stderr.strip()}")
    try:
        yield path
    finally:
        subprocess.run(["umount", str(path)], check=True)


def _kill(process: subprocess.Popen[str]) -> None:
    """End a process and all that it has started; it may have ended by itself."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


# What happens


def killed(verb: Verb, out: Path, rng: random.Random, files: int) -> None:
    """SIGKILL soon after so many files are there, to the run and all that it has started."""
    process = start(verb.words(out))
    wait_for(process, out, files)
    time.sleep(rng.uniform(0.0, 0.05))
    _kill(process)
    ended(process)


def filled(verb: Verb, out: Path, rng: random.Random, files: int) -> None:
    """The disk is full once so many files are there."""
    process = start(verb.words(out))
    wait_for(process, out, files)
    others = out.parent / "others"
    try:
        with others.open("wb", 0) as file:
            while True:
                file.write(bytes(4096))
    except OSError:
        pass
    status, said = ended(process)
    others.unlink()
    assert status in (0, 1, 3), f"full disk: status {status}, {said}"
    assert status != 1 or "No space left" in said or "MB free" in said, f"full disk: {said}"


def read_only(verb: Verb, out: Path, rng: random.Random, files: int) -> None:
    """The disk takes nothing more once so many files are there."""
    process = start(verb.words(out))
    wait_for(process, out, files)
    disk = str(out.parent)
    while process.poll() is None:  # it is refused while a file is open
        if subprocess.run(["mount", "-o", "remount,ro", disk], capture_output=True).returncode == 0:
            break
        time.sleep(0.002)
    status, said = ended(process)
    subprocess.run(["mount", "-o", "remount,rw", disk], check=True)
    assert status in (0, 1, 3), f"read-only disk: status {status}, {said}"
    assert status != 1 or "Read-only" in said, f"read-only disk: {said}"


def jumped(verb: Verb, out: Path, rng: random.Random, files: int) -> None:
    """The wall clock jumps back and forth, and the run is killed besides."""
    process = start(verb.words(out), clock=rng.randrange(1000))
    wait_for(process, out, files)
    _kill(process)
    ended(process)
    again = () if not out.exists() or not any(out.iterdir()) else verb.again
    status, said = ended(start([*verb.words(out), *again], clock=rng.randrange(1000)))
    assert status in (0, 3), f"clock: status {status}, {said}"


def removed(verb: Verb, out: Path, rng: random.Random, files: int) -> None:
    """Somebody removes a file of a run that was done."""
    finish(verb, out)
    names = ("depth/*", "*/*/poses.txt", "map.npz")
    there = sorted(p for name in names for p in out.glob(name) if p.is_file())
    rng.choice(there).unlink()


FAULTS: dict[str, Callable[[Verb, Path, random.Random, int], None]] = {
    "SIGKILL": killed,
    "full disk": filled,
    "read-only disk": read_only,
    "clock jumps": jumped,
    "file removed": removed,
}


def trial(verb: Verb, fault: str, folder: Path, seed: int, expected: dict[str, str]) -> Tally:
    """Disturb one run and see what is left.

    Args:
        verb: what is run.
        fault: of `FAULTS`.
        folder: a new folder's name.
        seed: of chance.
        expected: what an undisturbed run commits.
    """
    tally, rng = Tally(runs=1), random.Random(f"{verb.name} {fault} {seed}")
    disk = fault.endswith("disk")
    # late, in the middle and early in turn, by the files that are there: something is to be lost
    third = 2 - seed % 3
    most = 4 + 3 * len(expected)
    files = rng.randint(third * most // 3, (third + 1) * most // 3)
    try:
        if disk:
            with small_disk(folder, "24m"):
                _disturbed(verb, fault, folder / "out", rng, files, expected, tally)
        else:
            folder.mkdir(parents=True)
            _disturbed(verb, fault, folder / "out", rng, files, expected, tally)
    except OSError as error:
        if not disk or tally.committed:
            raise
        tally.runs, tally.skipped = 0, str(error)
    except AssertionError as error:
        tally.broken.append(f"{verb.name}, {fault}, seed {seed}: {error}"[:400])
    return tally


def _disturbed(
    verb: Verb, fault: str, out: Path, rng: random.Random, files: int,
    expected: dict[str, str], tally: Tally,
) -> None:  # fmt: skip
    FAULTS[fault](verb, out, rng, files)
    if fault == "file removed":  # what was removed is gone; the rest must stay, and come again
        before: dict[str, str] = {}
    else:
        before = verb.committed(out)
    tally.committed = len(before) or (len(expected) if fault == "file removed" else 0)
    again = verb.again if out.is_dir() and any(out.iterdir()) else ()
    finish(verb, out, again)
    after = verb.committed(out)
    tally.lost = sum(after.get(name) != what for name, what in before.items())
    assert set(after) == set(expected), f"{sorted(after)}, expected {sorted(expected)}"
    if verb.name != "capture":  # its frames hold the moments at which they were taken
        wrong = [name for name in expected if after[name] != expected[name]]
        assert not wrong, f"{wrong} differ from those of an undisturbed run"
