"""A process that reads hostile inputs: those that it is sent, or those that it makes itself.

``python -m tests.fuzz.child`` takes inputs from stdin, each after the name of its target and its
length, and says for each what was wrong. ``python -m tests.fuzz.child TARGET --seconds S --seed K
--keep FOLDER`` makes inputs for that long and leaves in the folder one for each fault; with
``--atheris`` besides, guided by coverage.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import shutil
import sys
import time
from pathlib import Path

from tests.fuzz.judging import Judge

DEADLINE = 20.0
"""s; nothing that is read here takes a tenth of that on a machine that has other things to do."""
LARGEST = 1 << 20
"""Bytes of an input that is made here."""


class Place:
    """A folder with the valid files of a target, into which inputs are put."""

    def __init__(self, target_name: str, home: Path, judge: Judge) -> None:
        """Make the folder, and read the valid files, so that all that is imported is there."""
        from tests.fuzz.targets import target

        self.target = target(target_name)
        self._home = home / target_name
        self._home.mkdir()
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
        self._judge = judge

    def judge(self, data: bytes) -> str:
        """Return what was wrong with how an input was read; "" where nothing was."""
        self.target.place(self.folder, data)
        fault = self._judge.judge(
            lambda: self.target.read(self.folder), self.folder, len(data), self.target.trusted
        )
        if self.target.writes:
            self._renew()
        return fault

    def _renew(self) -> None:
        shutil.rmtree(self.folder)
        shutil.copytree(self._valid, self.folder)


def answer(home: Path) -> None:
    """Judge what comes over stdin: a line of JSON, target and length, then so many bytes."""
    judge = Judge(DEADLINE)
    places: dict[str, Place] = {}
    while line := sys.stdin.buffer.readline():
        asked = json.loads(line)
        name = asked["target"]
        if name not in places:
            places[name] = Place(name, home, judge)
        if "bytes" in asked:
            fault = places[name].judge(sys.stdin.buffer.read(asked["bytes"]))
            print(json.dumps({"fault": fault}), flush=True)
        else:
            seeds = [seed.hex() for seed in places[name].seeds]
            print(json.dumps({"seeds": seeds}), flush=True)


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


def guided(name: str, home: Path, seconds: float, seed: int, keep: Path) -> None:
    """Let atheris find inputs that reach new code."""
    import atheris

    with atheris.instrument_imports(
        include=["depthba.dataset", "depthba.convert", "depthba.trajectory", "depthba.ply",
                 "depthba.stored_run", "depthba.ur_calibration", "rig.session", "rig.hand_eye",
                 "sim.controller", "depthba.verbs.arguments"],
        # numba compiles what is in them
        exclude=["depthba.convert.clouds.pcd", "depthba.straight", "depthba.optimiser"],
    ):  # fmt: skip
        place = Place(name, home, Judge(DEADLINE))
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
    parser.add_argument("target", nargs="?")
    parser.add_argument("--home", type=Path, required=True, help="an empty folder, for its files")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--atheris", action="store_true")
    asked = parser.parse_args()
    if asked.target is None:
        answer(asked.home)
    elif asked.atheris:
        guided(asked.target, asked.home, asked.seconds, asked.seed, asked.keep)
    else:
        place = Place(asked.target, asked.home, Judge(DEADLINE))
        make(place, asked.seconds, asked.seed, asked.keep)


if __name__ == "__main__":
    main()
