"""Simulated controllers as processes of their own, each on an address of its own."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sim.controller.channel import Channel
from sim.engine import mujoco
from sim.robots.ur16e import add_ur16e

ROOT = Path(__file__).parents[2]
READY = (-1.927, -1.584, 1.424, -1.41, -1.571, -0.356)

_numbers = itertools.count(1)


def address() -> str:
    """A loopback address that no other test process takes."""
    pid = os.getpid()
    return f"127.{64 + pid % 128}.{(pid >> 7) % 256}.{1 + next(_numbers) % 250}"


@dataclass(frozen=True)
class Running:
    host: str
    process: subprocess.Popen[str]
    channel: Channel
    about: dict[str, Any]

    def fault(self, name: str, on: bool = True) -> None:
        self.channel.ask("fault", name=name, on=on)

    def truth(self) -> dict[str, Any]:
        return self.channel.ask("truth")


@contextmanager
def controller(*words: str, host: str | None = None) -> Iterator[Running]:
    """A running controller, ready; it ends with the block, and with this process anyhow."""
    host = host or address()
    command = [sys.executable, "-m", "depthba", "simulate-controller", "--json"]
    process = subprocess.Popen(
        [*command, "--host", host, "--end-with-parent", *words],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert process.stdout is not None
        lines = [process.stdout.readline()]
        while lines[-1] not in ("}\n", ""):
            lines.append(process.stdout.readline())
        assert lines[-1], f"the controller ended with {process.wait()}"
        text = "".join(lines)
        with Channel(host, timeout=20.0) as channel:
            yield Running(host, process, channel, json.loads(text))
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def peer(name: str, host: str, *arguments: Any, timeout: float = 60.0) -> Any:
    """What a function of `tests.sim.ur_peers` returns, run with the client in its own process."""
    words = [sys.executable, "-m", "tests.sim.ur_peers", name, host, json.dumps(arguments)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=timeout)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def boxed(seed: int) -> mujoco.MjSpec:
    """The arm on a floor at z = 0, a pillar in its way."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[2, 2, 0.01],
        pos=[0, 0, -0.01],
        rgba=[0.5, 0.5, 0.5, 1],
    )
    spec.worldbody.add_geom(
        name="pillar",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.05, 0.05, 0.5],
        pos=[0.36, 0.36, 0.5],
        rgba=[0.6, 0.3, 0.2, 1],
    )
    add_ur16e(spec)
    return spec


BOXED = "tests.sim.controllers:boxed"
