"""Runs the levels, coarse to fine, each from where the last one ended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import certainty, crowding, pattern, reduced, schedule
from depthba.optimiser.clock import Clock
from depthba.optimiser.grid import Grid
from depthba.optimiser.level import Level, level_heights, make_level
from depthba.optimiser.linearise import Linearisation, State, robust_sigma
from depthba.optimiser.noise import ByRange, by_range
from depthba.optimiser.patches import Fit
from depthba.optimiser.prior import PosePrior
from depthba.optimiser.problem import Problem
from depthba.optimiser.reporting import iteration
from depthba.optimiser.slope_noise import without_slope_noise
from depthba.optimiser.solver import Outcome, Progress, Rules, solve_level, solve_map
from depthba.optimiser.tying import SHARED, patches_beside, tied_by_patches
from depthba.optimiser.workers import Workers
from depthba.options import Options
from depthba.result import Iteration

# A level that only leads to the next is left when a step gains less than this share of its cost.
GAIN = 0.02
# The last one is, with patches on it, below this share: their points and the map's robust tails
# never quite settle.
ENOUGH = 0.003
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
# Factor on the variance of what patches alone say from that share on, and in the verdict: noise in
# their slopes, which nothing takes off, slides frames along a bare table.
CAUTION = 16.0
# Factor on the noise at some range, from which on it is worth to settle anew.
NOTICEABLE = 1.2
# A spacing below this share of the last one is worth a level of its own.
CLEARLY = 0.9


@dataclass(frozen=True)
class Map:
    """Heights and the grid that they stand on."""

    heights: NDArray[np.float64]
    grid: Grid


@dataclass(frozen=True)
class End:
    """Where the last level ended, and what is known there."""

    level: Level
    outcome: Outcome
    temperature: float
    """m^2, what a squared normalised error of a measured pose cost."""
    index: int
    """Of the level, from the coarsest."""
    believed: float
    """Factor on the variance of what the points say that was reckoned with."""
    S: NDArray[np.float64]
    """(6N, 6N) the reduced matrix about there, without patches."""


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
    doubted: bool = False
    """Whether that was much before patches came, and measured poses could say otherwise. Nothing
    takes noise off the slopes of patches: then they find the poses, but do not vouch for them."""
    history: list[Iteration] = field(default_factory=list)
    bend: NDArray[np.float64] | None = None
    """(m,), m at a point of typical noise: what has been taken off the points; None: nothing."""
    emphasis: float = 1.0
    """How many times patches beside the map count."""
    plain: bool = False
    """Whether the camera was found to have no fixed pattern: it is not looked for again."""
    refused_pattern: float = 0.0
    """Root mean square over the image, m, of one that was too large to be the camera's; else 0."""

    @property
    def preset(self) -> schedule.Preset:
        """What the options' preset fixes."""
        return schedule.preset_of(self.options)

    @property
    def acting(self) -> PosePrior:
        """The prior as it enters the cost: nothing where the preset leaves it out."""
        if self.preset.prior:
            return self.prior
        return replace(self.prior, information=0 * self.prior.information)

    @property
    def fixed_pattern(self) -> float:
        """Root mean square over the image of what has been taken off the points, m."""
        waves = self.problem.waves
        return 0.0 if self.bend is None or waves is None else waves.size(self.bend)

    def run(
        self,
        levels: list[float],
        poses: NDArray[np.float64],
        refining: bool = False,
    ) -> End:
        """Run levels of the given spacings, m, from poses (N, 4, 4) ``T_map_camera``.

        ``refining``: the poses are near the solution, so that no level needs the wide loss first.
        """
        before: Map | None = None
        known: certainty.Correlation | None = None
        levels = list(levels)
        index = 0
        while True:
            last = index == len(levels) - 1 or self.clock.over
            if last and index:
                poses = self._tied(poses, levels[index], known)
            level, state, lin = self.lay(levels[index], poses, before, last)
            for phase in self.preset.phases(1 if refining else index):
                if last and phase == self.preset.phases(1)[-1]:
                    level = self.patched(level, state, lin)
                near = reduced.reduce(lin, self.workers, NEAR, self.free)
                if self.preset.prior and (known is None or known.owed > NEGLIGIBLE):
                    known = self._correlation(level, state, lin, near)
                believed = known.inflation if known else 1.0
                S = near.S
                del near  # the map's answers, which take more memory than all points
                final = last and phase == self.preset.phases(1)[-1] and not level.tied
                temperature, outcome = self._descend(
                    level, state, lin, S, phase, index, len(levels), known, final
                )
                state, lin = outcome.state, outcome.lin
                self.clock.lap(f"level {index} {phase}")
            if last:
                shown, told = self._seen(level, outcome)
                if level.tied or shown.wrong > NOTICEABLE or told.shares:
                    # where the poses have got to, patches lie better and points show their noise
                    level = self.weighed(self.weighed(level, shown), told)
                    return self.settle(level, state, lin, index, known, S)
                return End(level, outcome, temperature, index, believed, S)
            poses, before = state.T_map_camera, Map(state.heights, level.grid)
            if known and self.options.resolution is None:
                levels, known = self._no_finer(levels, index, level, outcome, known)
            index += 1

    def settle(
        self, level: Level, state: State, lin: Linearisation, index: int,
        known: certainty.Correlation | None, S: NDArray[np.float64] | None = None,
        tied: Fit | None = None,
    ) -> End:  # fmt: skip
        """Settle on the last level's map, and on patches beside it, which are laid anew.

        Args:
            level: the map, and the points.
            state: where to start.
            lin: the linearisation there.
            index: of the level.
            known: how the residuals are correlated.
            S: (6N, 6N) the reduced matrix on this map at poses nearby, if there is one: steps need
                no better, only what guards them against noise in slopes does.
            tied: patches to keep.
        """
        level = replace(level, tied=tied) if tied else self.patched(level, state, lin)
        phase = self.preset.phases(1)[-1]
        if S is None or self._guarded:
            S = reduced.reduce(lin, self.workers, NEAR, self.free).S
        temperature, outcome = self._descend(
            level, state, lin, S, phase, index, index + 1, known, True
        )
        self.clock.lap(f"level {index} {phase}")
        return End(level, outcome, temperature, index, known.inflation if known else 1.0, S)

    def _seen(self, level: Level, outcome: Outcome) -> tuple[ByRange, crowding.Told]:
        """Return how the noise over the range differs from the one reckoned with, and crowding."""
        if not self.preset.robust or self.clock.over:
            return ByRange.as_stated(), crowding.Told()
        there = level.problem, level.grid, outcome.state, outcome.loss, outcome.lin
        return by_range(*there), crowding.told(*there, self.workers)

    def weighed(self, level: Level, shown: ByRange | crowding.Told) -> Level:
        """Let all points count as was shown; return the level with its points likewise."""
        self.problem = shown.applied(self.problem, self.workers)
        return replace(level, problem=shown.applied(level.problem, self.workers))

    def unbent(self, level: Level, bend: NDArray[np.float64]) -> Level:
        """Take the camera's fixed pattern (m,) off all points, in place of the present one.

        Returns the level with its points likewise.
        """
        step = bend if self.bend is None else bend - self.bend
        self.problem, self.bend = pattern.without(self.problem, step), bend
        return replace(level, problem=pattern.without(level.problem, step))

    def lay(
        self, spacing: float, poses: NDArray[np.float64], before: Map | None, last: bool
    ) -> tuple[Level, State, Linearisation]:
        """Return a level, and its map solved for the poses."""
        level = make_level(
            self.problem, poses, spacing, self.preset, self.options, self.workers, last
        )
        heights = level_heights(level, *((before.heights, before.grid) if before else (None, None)))
        return level, *self.map_solved(level, State(poses, heights))

    def map_solved(self, level: Level, state: State) -> tuple[State, Linearisation]:
        """Return the state with the map that suits its poses best."""
        return solve_map(
            level.problem, level.grid, state, level.loss, level.smooth, self.workers, 1, NEAR
        )

    @property
    def doubt(self) -> float:
        """Factor on the variance of what the points say, where slopes are doubted; else 1."""
        return CAUTION if self.doubted else 1.0

    def _tied(
        self, poses: NDArray[np.float64], spacing: float, known: certainty.Correlation | None
    ) -> NDArray[np.float64]:
        """Return the poses as patches alone would have them."""
        if not self.preset.robust or self.clock.over:
            return poses
        inflation = known.inflation if known else 1.0
        if known and self.doubted:
            # only the measured poses keep the frames of a bare table from sliding
            inflation = CAUTION * max(inflation, known.overall)
        poses = tied_by_patches(
            self.problem, poses, self._fine(spacing), self.prior, self.acting, inflation, self.free,
            self.workers,
        )  # fmt: skip
        self.clock.lap("patches")
        return poses

    def patched(
        self, level: Level, state: State, lin: Linearisation, vouching: bool = False
    ) -> Level:
        """Return the level with patches laid anew over what is steep.

        ``vouching``: no point counts there that the map takes at its full weight, and none more
        than once.
        """
        if not self.preset.robust:
            return replace(level, tied=None)
        tied = patches_beside(
            self.problem, state.T_map_camera, level.grid.spacing, self._fine(level.grid.spacing),
            self.preset.robust, robust_sigma(lin.residuals), self.workers,
            0.0 if vouching else SHARED,
        )  # fmt: skip
        if tied and not vouching:
            tied = tied.counted(self.emphasis)
        return replace(level, tied=tied)

    def _fine(self, spacing: float) -> float:
        """Return the spacing that the voxels of patches go by, m, beside a map of a spacing.

        A map may be asked for that is coarser than the points: a quadric over as much of a rough
        scene ties what is not the same.
        """
        if self.options.resolution is None:
            return spacing
        return min(spacing, schedule.finest_spacing(self.problem))

    def with_patches(
        self, level: Level, state: State, lin: Linearisation, at: reduced.Reduction
    ) -> reduced.Reduction:
        """Return the reduction with what the patches say in its matrix."""
        if level.tied is None:
            return at
        told, _ = level.tied.patches.normal_equations(state.T_map_camera, lin.pivots, self.workers)
        return replace(at, S=at.S + told)

    def _descend(
        self, level: Level, state: State, lin: Linearisation, S: NDArray[np.float64], phase: str,
        index: int, levels: int, known: certainty.Correlation | None, final: bool,
    ) -> tuple[float, Outcome]:  # fmt: skip
        """Weigh the measured poses by what is known, and solve; return their weight too."""
        temperature = known.inflation * robust_sigma(lin.residuals) ** 2 if known else 0.0
        sure = self._sure(level, state, lin, S, temperature)
        outcome = self._solve(
            level, state, lin, phase, index, levels, temperature, known, S, sure, final
        )
        return temperature, outcome

    def _no_finer(
        self, levels: list[float], index: int, level: Level, outcome: Outcome,
        known: certainty.Correlation,
    ) -> tuple[list[float], certainty.Correlation]:  # fmt: skip
        """Return the levels less those that noise forbids, correlated as it has turned out."""
        finest = self._finest(known, outcome)
        if levels[index + 1] >= finest:
            return levels, known
        # what was found out before the poses had settled is not the last word
        near = reduced.reduce(outcome.lin, self.workers, NEAR, self.free)
        known = self._correlation(level, outcome.state, outcome.lin, near)
        finest = self._finest(known, outcome)
        if levels[index + 1] >= finest:
            return levels, known
        return [*levels[: index + 1], min(finest, levels[index])], known

    def _finest(self, known: certainty.Correlation, outcome: Outcome) -> float:
        return schedule.finest_spacing(self.problem, np.sqrt(known.inflation) * outcome.sigma)

    def finer(self, spacing: float, known: certainty.Correlation, outcome: Outcome) -> float:
        """Return a spacing that noise allows if it is clearly finer, no less than half; or it."""
        if self.options.resolution is not None or self.preset.whole:
            return spacing
        finest = max(self._finest(known, outcome), spacing / 2)
        return finest if finest < CLEARLY * spacing else spacing

    def _solve(
        self, level: Level, state: State, lin: Linearisation, phase: str, index: int, levels: int,
        temperature: float, known: certainty.Correlation | None, near: NDArray[np.float64],
        sure: NDArray[np.float64] | None, final: bool,
    ) -> Outcome:  # fmt: skip
        believed, variance = known.inflation if known else 1.0, robust_sigma(lin.residuals) ** 2
        # what so short steps seem to gain where residuals are correlated: frames that slide would
        # go on for as long as they may
        step = PASSING**2 * 6 * max(int(self.free.sum()), 1) * variance
        rules = Rules(
            self.preset.scale(phase),
            self.options.max_iterations,
            settled=self.settled if final else PASSING,
            steady=final and level.tied is not None,
            gain=(ENOUGH if level.tied else 0.0) if final else GAIN,
            least=step * (max(believed, known.overall) - 1.0) if known else 0.0,
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
            lambda: self.clock.over, level.tied,
        )  # fmt: skip

    @property
    def _guarded(self) -> bool:
        """Whether noise in the map's slope may be a part of what the data say that matters."""
        return self.preset.prior and self.noisy * FINER >= NOISY

    def _sure(
        self, level: Level, state: State, lin: Linearisation, S: NDArray[np.float64],
        temperature: float,
    ) -> NDArray[np.float64] | None:  # fmt: skip
        """Return what of S is not noise in the map's slope; None where that is next to all."""
        if not self._guarded:
            return None
        matrix, _ = self.prior.at(state.T_map_camera).normal_equations(lin.pivots)
        held = temperature * matrix
        if level.tied is not None:
            patches = level.tied.patches
            held = held + patches.normal_equations(state.T_map_camera, lin.pivots, self.workers)[0]
        less, self.noisy = without_slope_noise(
            level.problem, level.grid, state, level.loss, lin, S, held,
            self.free, self.workers, share=NOISY,
        )  # fmt: skip
        if level.tied is None:
            self.doubted = self.noisy >= NOISY
        return None if less is S else less

    def _correlation(
        self, level: Level, state: State, lin: Linearisation, at: reduced.Reduction
    ) -> certainty.Correlation:
        return certainty.correlation(
            level.problem, level.grid, state, level.loss, lin, self.prior, self.free, self.workers,
            self.with_patches(level, state, lin, at),
        )  # fmt: skip
