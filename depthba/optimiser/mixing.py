"""Anderson mixing of steps.

Reweighting under a robust loss converges linearly: each step goes part of the way, and the next
repeats the direction. The last few steps tell how much is left, and the mixed step goes there at
once (Anderson 1965; Walker & Ni 2011, type II).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser.eliminate import Step

# Steps that are remembered: each costs a map.
DEPTH = 3
# Coefficients larger than this say that the history is not that of a linear process.
WILD = 10.0


@dataclass
class Mixer:
    """Remembers what the solver proposed and where it went."""

    proposed: list[Step] = field(default_factory=list)
    taken: list[Step] = field(default_factory=list)

    def mix(self, step: Step, S: NDArray[np.float64]) -> Step:
        """Return the step to take in place of the proposed one.

        Args:
            step: the Gauss-Newton step from where the last one taken ended.
            S: (6N, 6N) metric in which steps of the poses are compared.
        """
        self.proposed = [*self.proposed, step][-DEPTH - 1 :]
        m = min(len(self.proposed) - 1, len(self.taken))
        if m == 0:
            return step
        before, after = self.proposed[-m - 1 : -1], self.proposed[-m:]
        changes = [(b.pose - a.pose).ravel() for a, b in zip(before, after, strict=True)]
        D = np.stack(changes)
        gram = D @ S @ D.T
        gram += 1e-8 * np.trace(gram) * np.eye(m) + 1e-300 * np.eye(m)
        theta = np.linalg.solve(gram, D @ S @ step.pose.ravel())
        if not np.abs(theta).sum() < WILD:
            return step
        pose, height = step.pose.copy(), step.map.copy()
        for weight, a, b, went in zip(theta, before, after, self.taken[-m:], strict=True):
            pose -= weight * (went.pose + b.pose - a.pose)
            height -= weight * (went.map + b.map - a.map)
        return Step(pose, height, step.decrement)

    def took(self, step: Step) -> None:
        """Remember a step that was taken."""
        self.taken = [*self.taken, step][-DEPTH:]

    def forget(self) -> None:
        """Begin anew: the next steps do not continue the last ones."""
        self.proposed.clear()
        self.taken.clear()
