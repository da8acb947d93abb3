"""Live registration for a long time, in a process of its own: ``SECONDS FRAMES FOLDER``.

Frames come without a pause. When all FRAMES have come, the registration ends on its finest map, is
closed, and the next session begins. Prints a JSON line for every frame: seconds, session, frames in
it, memory held (GB), and seconds that the frame took.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import depthba
from depthba.options import Options
from tests.benchmarks.relief import Relief


def held() -> float:
    """Return the memory that this process holds, GB."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    line = next(line for line in status.splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024**2


def main(words: list[str]) -> None:
    """Register until the time is up."""
    seconds, frames, folder = float(words[0]), int(words[1]), Path(words[2])
    relief = Relief(columns=frames // 2, rows=2, size=(96, 72), start_error=(2e-3, 2e-3))
    dataset = relief.write(folder / "live")
    began, session = time.monotonic(), 0
    while time.monotonic() - began < seconds:
        with depthba.Registration(
            dataset.sensor, Options(threads=1), dataset.map_frame, dataset.pose_noise
        ) as live:
            for frame in dataset:
                update = live.add(frame)
                row = {
                    "seconds": time.monotonic() - began,
                    "session": session,
                    "frames": len(live),
                    "gigabytes": held(),
                    "frame_seconds": update.seconds,
                }
                print(json.dumps(row), flush=True)
            live.result()
        session += 1


if __name__ == "__main__":
    main(sys.argv[1:])
