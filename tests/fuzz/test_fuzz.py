"""A short, repeatable slice of `make fuzz`, and every input that once went wrong.

A child process reads the inputs: it is watched for what it raises, for how long it takes, for the
memory it asks for and for the files it opens.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from collections.abc import Iterator
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.__main__ import ONE_THREAD, new_home
from tests.fuzz.child import DEADLINE
from tests.fuzz.judging import ROOT
from tests.fuzz.targets import CORPUS, target, targets

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does")
NAMES = [t.name for t in targets()]
EXAMPLES = 12
"""Inputs for each target."""


class Reader:
    """The child; begun anew after it has died."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[bytes] | None = None

    def seeds(self, name: str) -> list[bytes]:
        return [bytes.fromhex(seed) for seed in self._ask({"target": name}, b"")["seeds"]]

    def fault(self, name: str, data: bytes) -> str:
        return str(self._ask({"target": name, "bytes": len(data)}, data)["fault"])

    def end(self) -> None:
        if self._child is not None:
            assert self._child.stdin is not None and self._child.stdout is not None
            self._child.stdin.close()
            self._child.stdout.close()
            self._child.kill()
            self._child.wait()
            self._home.cleanup()
            self._child = None

    def _ask(self, request: dict[str, Any], data: bytes) -> dict[str, Any]:
        if self._child is None:
            self._home = new_home()
            command = [sys.executable, "-m", "tests.fuzz.child", "--home", self._home.name]
            environment = {**os.environ, "PYTHONPATH": str(ROOT), **ONE_THREAD}
            self._child = subprocess.Popen(
                command, cwd=ROOT, env=environment, stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        assert self._child.stdin is not None and self._child.stdout is not None
        self._child.stdin.write(json.dumps(request).encode() + b"\n" + data)
        self._child.stdin.flush()
        # it ends by itself at the deadline of an input; the rest is for its start on a busy machine
        ready, _, _ = select.select([self._child.stdout], [], [], 5 * DEADLINE)
        line = self._child.stdout.readline() if ready else b""
        if not line:
            status = self._child.poll()
            self.end()
            return {"fault": f"the process ended with status {status}, or hung"}
        return dict(json.loads(line))


@pytest.fixture(scope="session")
def reader() -> Iterator[Reader]:
    child = Reader()
    yield child
    child.end()


@pytest.mark.parametrize("name", NAMES)
def test_hostile_inputs_are_refused_by_a_known_error(name: str, reader: Reader) -> None:
    seeds = reader.seeds(name)
    mutate = target(name).mutate

    @settings(max_examples=EXAMPLES, derandomize=True, deadline=None, database=None)
    @given(seed=st.sampled_from(seeds), number=st.integers(0, 2**32), times=st.integers(1, 3))
    def read(seed: bytes, number: int, times: int) -> None:
        rng, data = Random(number), seed
        for _ in range(times):
            data = mutate(rng, data)
        fault = reader.fault(name, data)
        assert not fault, f"{fault}\n{data[:2000]!r}"

    for seed in seeds[:1]:
        assert not reader.fault(name, seed), "the valid file"
    read()


@pytest.mark.parametrize("name", sorted(p.name for p in CORPUS.iterdir()))
def test_what_once_went_wrong_stays_right(name: str, reader: Reader) -> None:
    for path in target(name).kept():
        assert not reader.fault(name, path.read_bytes()), path.name
