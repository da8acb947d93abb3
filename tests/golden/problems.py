"""The problems whose answers are kept, and where.

``make golden`` solves them anew and writes the answers under the present version; those of other
versions stay as they are.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import depthba
from depthba import se3
from depthba.options import Options
from depthba.result import Result
from tests.depthba.analytic_scene import bumpy, flat, write_scene

FILE = Path(__file__).with_name("poses.json")

# Metres and radians by which answers may differ between processors and libraries of linear algebra:
# a hundredth of what noise leaves unknown here. On one machine they agree to the last bit.
TOLERANCE = 2e-6

PROBLEMS: dict[str, tuple[dict[str, Any], Options]] = {
    "default": ({"surface": bumpy, "frames": 4}, Options(threads=1)),
    "paper": ({"surface": bumpy, "frames": 4}, Options(preset="paper", threads=1)),
    "without priors": ({"surface": bumpy, "frames": 4}, Options(priors=False, threads=1)),
    "plane": ({"surface": flat, "frames": 3}, Options(threads=1)),
}


def solve(name: str, folder: Path) -> tuple[dict[str, Any], Result]:
    """Solve a problem; return what is kept of it, and the whole."""
    scene, options = PROBLEMS[name]
    result = depthba.register(write_scene(folder / name.replace(" ", "-"), **scene), options)
    moved = se3.difference(result.T_world_camera, result.T_world_camera_start)
    return {"status": result.status, "moved_m_rad": moved.tolist(), "sigma_m": result.sigma}, result


def kept() -> dict[str, Any]:
    """Return the answers by version and problem."""
    return json.loads(FILE.read_text()) if FILE.exists() else {}


def main() -> None:
    """Solve all problems, say what changed, and keep the answers."""
    answers = kept()
    before = answers.get(depthba.__version__, {})
    with tempfile.TemporaryDirectory() as folder:
        now = {name: solve(name, Path(folder))[0] for name in PROBLEMS}
    for name, answer in now.items():
        if name in before:
            change = np.abs(np.subtract(answer["moved_m_rad"], before[name]["moved_m_rad"])).max()
            print(f"{name}: {before[name]['status']} -> {answer['status']}, by {change:.2g} m, rad")
        else:
            print(f"{name}: {answer['status']}, new")
    answers[depthba.__version__] = now
    FILE.write_text(json.dumps(answers, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
