"""The measured poses, untouched: what every method must beat."""

from __future__ import annotations

from dataclasses import dataclass

from eval.methods.method import Estimate, Task


@dataclass(frozen=True)
class Initial:
    """Returns the start."""

    def run(self, task: Task) -> Estimate:
        """Return the start poses."""
        return Estimate(task.T_world_camera.copy(), {})
