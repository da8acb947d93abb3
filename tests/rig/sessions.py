"""Session files for tests, runs of them, and what their datasets have in common."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

from depthba.dataset import verify
from tests.sim.controllers import BOXED, READY, ROOT

HAND_EYE = [
    # 5 mm and 0.5 degrees away from where the simulated camera sits.
    [0.863689282, -0.503134239, 0.029945982, -0.019034603],
    [0.503973813, 0.861232970, -0.065484098, -0.084834949],
    [0.007156825, 0.071649904, 0.997404166, 0.052464612],
    [0.0, 0.0, 0.0, 1.0],
]
STATIONS = [[READY[0] + 0.12 * k, *READY[1:]] for k in (1, 2, 3)]

SESSION: dict[str, Any] = {
    "name": "test",
    "rig": {"kind": "ur", "options": {"host": "127.0.0.2"}},
    "camera": {"kind": "simulated", "options": {"size": [96, 54]}, "timeout": 0.5},
    "hand_eye": HAND_EYE,
    "poses": [{"joints": STATIONS}],
    "limits": {"camera": [-0.8, 0.8, 0.2, 0.95, 0.35, 0.9]},
    "motion": {"settle": 0.2},
    "rehearsal": {"scene": BOXED},
}


def changed(**changes: Any) -> dict[str, Any]:
    """The session with changes: `motion__speed=0.1` sets the key speed of motion."""
    content = copy.deepcopy(SESSION)
    for name, value in changes.items():
        *keys, last = name.split("__")
        inner = content
        for key in keys:
            inner = inner.setdefault(key, {})
        if value is None:
            inner.pop(last, None)
        else:
            inner[last] = value
    return content


def write(path: Path, **changes: Any) -> Path:
    """Write the session with changes to a file."""
    path.write_text(yaml.safe_dump(changed(**changes), sort_keys=False))
    return path


def command(*words: str | Path) -> subprocess.Popen[str]:
    """Start `depthba capture` with these words."""
    environment = {**os.environ}
    paths = [str(ROOT), *filter(None, [environment.get("PYTHONPATH")])]
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    return subprocess.Popen(
        [sys.executable, "-m", "depthba", "capture", *map(str, words)],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(process: subprocess.Popen[str], timeout: float = 240.0) -> tuple[int, str, str]:
    """Wait for a command: status, stdout, stderr."""
    try:
        out, err = process.communicate(timeout=timeout)
    finally:
        process.kill()
        process.wait()
    return process.returncode, out, err


def frames(path: Path) -> list[dict[str, Any]]:
    """The lines of a dataset's frames.jsonl; none where it is not there yet."""
    try:
        text = (path / "frames.jsonl").read_text()
    except FileNotFoundError:
        return []
    return [json.loads(line) for line in text.split("\n")[:-1]]


def but_for_stamps(path: Path) -> dict[str, Any]:
    """All that is in a whole dataset, its images by their sums, without anything that is a time."""
    assert verify(path) == []
    header = json.loads((path / "dataset.json").read_text())
    del header["created"], header["source"]["camera"]["serial"]
    lines = frames(path)
    for line in lines:
        del line["stamp"], line["rig_stamp"]
    poses = {
        name: [row.split()[1:] for row in (path / name).read_text().splitlines()[1:]]
        for name in ("poses_measured.txt", "poses_true.txt")
    }
    files = sorted(str(p.relative_to(path)) for p in path.rglob("*") if p.is_file())
    return {"header": header, "frames": lines, "poses": poses, "files": files}
