"""A process that reads hostile inputs: those that it is sent, or those that it makes itself.

``python -m tests.fuzz.child TARGET`` takes inputs from stdin, each after its length, and says for
each what was wrong. With ``--seconds S --seed K --keep FOLDER`` it makes inputs for that long and
leaves in the folder one for each fault; with ``--atheris`` besides, guided by coverage.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import struct
import sys
import tempfile
import time
from pathlib import Path

DEADLINE = 20.0
"""s; nothing that is read here takes a tenth of that on a machine that has other things to do."""
LARGEST = 1 << 20
"""Bytes of an input that is made here."""


class Place:
    """A folder with the valid files of a target, into which inputs are put."""

    def __init__(self, target_name: str) -> None:
        """Make the folder, and read the valid files, so that all that is imported is there."""
        from tests.fuzz import judging
        from tests.fuzz.targets import target

        self.target = target(target_name)
        memory = "/dev/shm" if os.path.isdir("/dev/shm") else None
        self._home = Path(tempfile.mkdtemp(prefix="depthba-fuzz-", dir=memory))
        self._valid = self._home / "valid" / "source"
        self.folder = self._home / "inside" / "source"
        self._valid.parent.mkdir()
        self.folder.parent.mkdir()
        (self._home / "inside" / "decoy.txt").write_text("0 0 0 0 0 0 0 1\n")
        self.target.make(self._valid)
        shutil.copytree(self._valid, self.folder)
        self.seeds = self.target.seeds(self.folder)
        self.target.read(self.folder)
        if self.target.writes:
            self._renew()
        self._judge = judging.Judge(DEADLINE)

    def judge(self, data: bytes) -> str:
        """Return what was wrong with how an input was read; "" where nothing was."""
        self.target.place(self.folder, data)
        fault = self._judge.judge(lambda: self.target.read(self.folder), self.folder, len(data))
        if self.target.writes:
            self._renew()
        return fault

    def remove(self) -> None:
        """Remove everything."""
        shutil.rmtree(self._home)

    def _renew(self) -> None:
        shutil.rmtree(self.folder)
        shutil.copytree(self._valid, self.folder)


def answer(place: Place) -> None:
    """Judge what comes over stdin."""
    print(json.dumps({"ready": place.target.name}), flush=True)
    while head := sys.stdin.buffer.read(4):
        data = sys.stdin.buffer.read(struct.unpack(">I", head)[0])
        print(json.dumps({"fault": place.judge(data)}), flush=True)


def make(place: Place, seconds: float, seed: int, keep: Path) -> None:
    """Make inputs and judge them; ``keep`` gets the smallest for each fault, and what is tried."""
    rng = random.Random(seed)
    pool = list(place.seeds)
    faults: dict[str, bytes] = {}
    tried, end = 0, time.monotonic() + seconds
    current = keep / "current"
    while time.monotonic() < end:
        data = rng.choice(pool)
        for _ in range(rng.choice((1, 1, 2, 3))):
            data = place.target.mutate(rng, data)
        data = data[:LARGEST]
        current.write_bytes(data)
        fault = place.judge(data)
        tried += 1
        if fault:
            kind = re.sub(r"[^\w.>: ]|\d{3,}", "", fault.split(":")[0] + fault[fault.rfind("(") :])
            if kind not in faults or len(data) < len(faults[kind]):
                faults[kind] = data
                name = re.sub(r"\W+", "-", kind)[:80]
                (keep / f"{place.target.name}.{name}").write_bytes(data)
                print(json.dumps({"fault": fault, "bytes": len(data)}), flush=True)
        elif len(pool) < 40 and rng.random() < 0.02:
            pool.append(data)
    current.unlink(missing_ok=True)
    print(json.dumps({"tried": tried, "faults": len(faults)}), flush=True)


def guided(name: str, seconds: float, seed: int, keep: Path) -> None:
    """Let atheris find inputs that reach new code."""
    import atheris

    with atheris.instrument_imports(
        include=["depthba.dataset", "depthba.convert", "depthba.trajectory", "depthba.ply",
                 "depthba.run_folder", "depthba.ur_calibration", "rig.session", "rig.hand_eye",
                 "sim.controller", "depthba.verbs.arguments"],
        exclude=["depthba.convert.clouds.pcd"],  # numba compiles what is in it
    ):  # fmt: skip
        place = Place(name)
    corpus = keep / "corpus"
    corpus.mkdir(exist_ok=True)
    for k, data in enumerate(place.seeds):
        (corpus / f"seed-{k}").write_bytes(data)

    def one(data: bytes) -> None:
        if fault := place.judge(data):
            raise RuntimeError(fault)

    def mutated(data: bytes, most: int, number: int) -> bytes:
        rng = random.Random(number)
        if rng.random() < 0.3:
            return bytes(atheris.Mutate(data, most))
        return bytes(place.target.mutate(rng, data)[:most])

    words = [sys.argv[0], f"-max_total_time={int(seconds)}", f"-seed={seed + 1}", "-timeout=60"]
    words += [f"-max_len={LARGEST}", f"-artifact_prefix={keep}/", "-print_final_stats=1"]
    atheris.Setup([*words, "-rss_limit_mb=0", str(corpus)], one, custom_mutator=mutated)
    atheris.Fuzz()


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser()
    parser.add_argument("target")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--atheris", action="store_true")
    asked = parser.parse_args()
    if asked.atheris:
        guided(asked.target, asked.seconds, asked.seed, asked.keep)
        return
    place = Place(asked.target)
    try:
        if asked.seconds is None:
            answer(place)
        else:
            make(place, asked.seconds, asked.seed, asked.keep)
    finally:
        place.remove()


if __name__ == "__main__":
    main()
