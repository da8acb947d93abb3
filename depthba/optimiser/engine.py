"""Runs the levels, coarse to fine, each from where the last one ended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import count

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from depthba.optimiser import certainty, reduced, schedule
from depthba.optimiser.bends import without_bends
from depthba.optimiser.clock import Clock
from depthba.optimiser.grid import Grid
from depthba.optimiser.level import Level, level_heights, make_level
from depthba.optimiser.linearise import Linearisation, Loss, State, linearise, robust_sigma
from depthba.optimiser.prior import PosePrior
from depthba.optimiser.problem import Problem
from depthba.optimiser.reporting import iteration
from depthba.optimiser.slope_noise import without_slope_noise
from depthba.optimiser.solver import Outcome, Progress, Rules, solve_level, solve_map
from depthba.optimiser.workers import Workers
from depthba.options import Options
from depthba.result import Iteration

# The robust loss begins this wide, in robust standard deviations: far stray points are checked, the
# rest is not.
WIDE = 12.0
# A level that only leads to the next is left when a step gains less than this share of its cost.
GAIN = 0.02
# Where the estimate owes the measured poses less than this in every direction, their exact weight
# is of no account.
NEGLIGIBLE = 0.002
# What may be left to go where a level ends, in standard deviations of the poses: the last, others.
SETTLED, PASSING = 0.03, 0.1
# Tolerance of a reduced matrix that only has to be near the one it preconditions.
NEAR = 1e-2
# Share of noise in what the data say of a direction, from which on steps are guarded against it.
NOISY = 0.1
# That share grows from a level to the next by less than this.
FINER = 4.0
# Times that the last level goes on when the residuals turn out less correlated than was thought.
AGAIN = 2


@dataclass(frozen=True)
class Map:
    """Heights and the grid that they stand on."""

    heights: NDArray[np.float64]
    grid: Grid


@dataclass(frozen=True)
class Known:
    """What the points say at a state, but for those that must not vouch for it."""

    problem: Problem
    """Without the points at sharp bends."""
    lin: Linearisation
    correlation: certainty.Correlation


@dataclass(frozen=True)
class End:
    """Where the last level ended, and what is known there."""

    level: Level
    outcome: Outcome
    temperature: float
    """m^2, what a squared normalised error of a measured pose cost."""
    known: Known | None = None
    """What the points say there, if that was found out."""


@dataclass
class Engine:
    """What stays the same through all levels."""

    problem: Problem
    options: Options
    prior: PosePrior
    """The measured poses, whether or not they take part."""
    free: NDArray[np.bool_]
    """(N,), frames that move."""
    workers: Workers
    clock: Clock
    callback: Callable[[Iteration], None] = lambda _: None
    settled: float = SETTLED
    noisy: float = 1.0
    """Largest share of noise in what the data said about a direction, when last measured."""
    history: list[Iteration] = field(default_factory=list)

    @property
    def preset(self) -> schedule.Preset:
        """What the options' preset fixes."""
        return schedule.PRESETS[self.options.preset]

    @property
    def acting(self) -> PosePrior:
        """The prior as it enters the cost: nothing where the preset leaves it out."""
        if self.preset.prior:
            return self.prior
        return replace(self.prior, information=0 * self.prior.information)

    def run(
        self,
        levels: list[float],
        poses: NDArray[np.float64],
        refining: bool = False,
        judged: bool = True,
    ) -> End:
        """Run levels of the given spacings, m, from poses (N, 4, 4) ``T_map_camera``.

        ``refining``: the poses are near the solution, so that no level needs the wide loss first.
        ``judged``: what is known at the end is found out, and the last level goes on where it asks
        for that.
        """
        before: Map | None = None
        known: certainty.Correlation | None = None
        levels = list(levels)
        for index in count():
            spacing = levels[index]
            last = index == len(levels) - 1 or self.clock.over
            level = make_level(self.problem, poses, spacing, self.preset, self.options, last)
            heights = level_heights(
                level, before.heights if before else None, before.grid if before else None
            )
            state, lin = solve_map(
                level.problem, level.grid, State(poses, heights), level.loss, level.smooth,
                self.workers, 1, NEAR,
            )  # fmt: skip
            for phase in phases(1 if refining else index, self.preset):
                near = reduced.reduce(lin, self.workers, NEAR, self.free)
                if self.preset.prior and (known is None or known.owed > NEGLIGIBLE):
                    known = self._correlation(level, state, lin, near)
                believed = known.inflation if known else 1.0
                temperature = believed * robust_sigma(lin.residuals) ** 2 if known else 0.0
                sure = self._sure(level, state, lin, near.S, temperature)
                final = last and phase == phases(1, self.preset)[-1]
                outcome = self._solve(
                    level, state, lin, phase, index, len(levels), temperature, believed, near.S,
                    sure, final,
                )  # fmt: skip
                state, lin = outcome.state, outcome.lin
                self.clock.lap(f"level {index} {phase}")
            if last:
                break
            poses, before = state.T_map_camera, Map(state.heights, level.grid)
            if known and self.options.resolution is None:
                levels = self._no_finer(levels, index, np.sqrt(known.inflation) * outcome.sigma)
        if not judged:
            return End(level, outcome, temperature)
        for _ in range(AGAIN):
            there = self.known_at(level, outcome.state, outcome.loss)
            inflation = there.correlation.inflation
            if not outcome.converged or inflation > 0.5 * believed:
                return End(level, outcome, temperature, there)
            believed = inflation
            outcome = self._solve(
                level, outcome.state, outcome.lin, phase, index, len(levels), temperature,
                believed, near.S, sure, True,
            )  # fmt: skip
            self.clock.lap(f"level {index} {phase}")
        return End(level, outcome, temperature)

    def known_at(self, level: Level, state: State, loss: Loss) -> Known:
        """Return what the points say at a state, but for those that must not vouch for it."""
        problem = level.problem
        if self.preset.robust:
            problem = without_bends(problem, level.grid, state.heights, state.T_map_camera)
        lin = linearise(problem, level.grid, state, loss, self.workers, level.smooth)
        at = reduced.reduce(lin, self.workers, free=self.free)
        found = certainty.correlation(
            problem, level.grid, state, loss, lin, self.prior, self.free, self.workers, at
        )
        self.clock.lap("certainty")
        return Known(problem, lin, found)

    def _no_finer(self, levels: list[float], index: int, deviation: float) -> list[float]:
        """Return the levels less those that noise forbids, correlated as it has turned out."""
        finest = schedule.finest_spacing(self.problem, deviation)
        if levels[index + 1] >= finest:
            return levels
        return [*levels[: index + 1], min(finest, levels[index])]

    def _solve(
        self, level: Level, state: State, lin: Linearisation, phase: str, index: int, levels: int,
        temperature: float, believed: float, near: NDArray[np.float64],
        sure: NDArray[np.float64] | None, final: bool,
    ) -> Outcome:  # fmt: skip
        rules = Rules(
            _scale(self.preset, phase),
            self.options.max_iterations,
            settled=self.settled if final else PASSING,
            gain=0.0 if final else GAIN,
            believed=believed,
        )

        def report(p: Progress) -> None:
            self.history.append(
                iteration(
                    p, level, index, levels, phase, len(self.history), self.problem,
                    self.clock.elapsed,
                )
            )  # fmt: skip
            self.callback(self.history[-1])

        return solve_level(
            level.problem, level.grid, state, lin, level.loss, rules, self.acting, temperature,
            self.free, level.smooth, self.workers, report, near, sure,
            lambda: self.clock.over,
        )  # fmt: skip

    def _sure(
        self, level: Level, state: State, lin: Linearisation, S: NDArray[np.float64],
        temperature: float,
    ) -> NDArray[np.float64] | None:  # fmt: skip
        """Return what of S is not noise in the map's slope; None where that is next to all."""
        if not self.preset.prior or self.noisy * FINER < NOISY:
            return None
        matrix, _ = self.prior.normal_equations(state.T_map_camera, lin.pivots)
        less, self.noisy = without_slope_noise(
            level.problem, level.grid, state, level.loss, lin, S, temperature * block_diag(*matrix),
            self.free, self.workers, share=NOISY,
        )  # fmt: skip
        return None if less is S else less

    def _correlation(
        self, level: Level, state: State, lin: Linearisation, at: reduced.Reduction
    ) -> certainty.Correlation:
        return certainty.correlation(
            level.problem, level.grid, state, level.loss, lin, self.prior, self.free, self.workers,
            at,
        )  # fmt: skip


def phases(index: int, preset: schedule.Preset) -> tuple[str, ...]:
    """Return the losses of a level.

    The robust one comes only when the poses have settled under a wide one.
    """
    if not preset.robust:
        return ("quadratic",)
    return ("quadratic", "robust") if index == 0 else ("robust",)


def _scale(preset: schedule.Preset, phase: str) -> float:
    """Return the robust scale of a phase, in robust standard deviations; 0 without such a loss."""
    if not preset.robust:
        return 0.0
    return preset.robust if phase == "robust" else WIDE
