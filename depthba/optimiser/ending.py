"""Finds out what is known where the last level ended, and goes on where that asks for it.

The residuals may turn out less correlated than was thought, so that the measured poses weigh less
or a finer map is allowed; and the camera may have a fixed pattern to be taken off.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import certainty, patch_waves, pattern, reduced
from depthba.optimiser.bends import without_bends
from depthba.optimiser.engine import End, Engine, Map
from depthba.optimiser.level import Level
from depthba.optimiser.linearise import Linearisation, Loss, State, linearise, robust_sigma
from depthba.optimiser.problem import Problem

# Times that the last level goes on.
AGAIN = 12
# Residuals more alike than this many times what independent ones would be are the map's to blame
# for, too, which has one height per node. Patches beside it then count so many times, from one
# settling to the next, for as long as that leaves residuals less alike; where it does not, they go
# back by one. They count once until the poses have settled, since patches hold what they tie.
ALIKE = 1.5
EMPHASIS = (1.0, 1.0, 4.0, 16.0, 64.0)
# It goes on when the residuals' inflation has come out below this share of what was believed.
LESS = 0.8
# It goes on when residuals have come out below this share of what they were at the last settling:
# frames that had stuck have come loose.
LOOSE = 0.8
# It goes on when the camera's fixed pattern calls for steps of so many standard deviations.
BENT = 0.1
# How much farther than asked for a pattern goes at most, in steps.
FARTHEST = 4.0
# A pattern up to so many times the noise that the sensor states is taken at its word.
MODEST = 2.0
# A larger one must leave residuals whose inflation is below this share of what it was. Wrong
# intrinsics, and frames that can slide, mimic patterns that explain less.
CLEARED = 0.15
# Any must leave residuals whose inflation is below this share: relief that a coarse map cannot hold
# mimics one that grows with every step, and the inflation with it.
GROWN = 1.25
# And residuals that are at most so many times as large: what is taken off explains them.
LARGER = 1.1


@dataclass(frozen=True)
class Known:
    """What the points say at a state, but for those that must not vouch for it."""

    problem: Problem
    """Without the points at sharp bends."""
    lin: Linearisation
    """Without its B."""
    correlation: certainty.Correlation
    believed: pattern.Believed | None = None
    """The fixed pattern of the camera; None: there is none."""

    @property
    def inflation(self) -> float:
        """The larger of the factors on the variance of what the points say."""
        return max(self.correlation.inflation, self.correlation.overall)


@dataclass(frozen=True)
class _Before:
    """Where the first pattern was taken off: there it goes back to if one proves false."""

    end: End
    inflation: float
    problem: Problem
    """All points, as they were measured."""
    size: float
    """Root mean square over the image of the pattern that has been taken off since, m."""
    share: float
    """Of the inflation, that it may leave at most."""


@dataclass
class Trail:
    """Where patterns were taken off, and where each asked to go.

    The pattern that the points show is the one taken off but for a share of what was still left of
    it, which poses and loss have yet to follow: a linear process, whose end two steps tell
    (Anderson 1965).
    """

    here: NDArray[np.float64] | None = None
    asked: NDArray[np.float64] | None = None

    def next(
        self, here: NDArray[np.float64] | None, shown: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the pattern (m,) to take off next.

        Args:
            here: (m,) the one that is taken off now; None: none.
            shown: (m,) the one that the points show.
        """
        here = np.zeros_like(shown) if here is None else here
        asked, step = shown - here, shown - here
        if self.here is not None and self.asked is not None:
            went, change = here - self.here, asked - self.asked
            share = float(asked @ change) / max(float(change @ change), 1e-300)
            if -FARTHEST < share < 0.0:
                step = asked - share * (went + change)
        self.here, self.asked = here, asked
        return here + step


def gone_on(engine: Engine, end: End) -> tuple[End, Known | None]:
    """Go on from the end of the last level for as long as what is known there asks for it.

    Returns where that ends, and what is known there if it was found out.
    """
    course = Course()
    for _ in range(AGAIN):
        there = known_at(engine, end.level, end.outcome.state, end.outcome.loss)
        if course.refuted(end, there):
            end = course.back(engine)
            there = known_at(engine, end.level, end.outcome.state, end.outcome.loss)
        further = course.further(engine, end, there)
        if further is None:
            return _uncoupled(end), there
        # of many points, what was known there takes memory that finding out anew needs
        end = further
        del there
    return _uncoupled(end), None


def _uncoupled(end: End) -> End:
    return replace(end, outcome=replace(end.outcome, lin=end.outcome.lin.uncoupled()))


@dataclass
class Course:
    """What going on has come by."""

    before: _Before | None = None
    trail: Trail = field(default_factory=Trail)
    emphasis: int = 0
    firm: bool = False
    """Whether patches have been found to count as much as they should."""
    alike: float = np.inf
    """How much alike residuals were when patches were last made to count more."""
    sigma: float = 0.0
    """Deviation of the residuals, m, where it settled before; 0: nowhere."""

    def refuted(self, end: End, there: Known) -> bool:
        """Whether the pattern that was taken off leaves residuals too large, or too much alike."""
        before = self.before
        if before is None:
            return False
        larger = end.outcome.sigma > LARGER * before.end.outcome.sigma
        return larger or there.inflation > before.share * before.inflation

    def back(self, engine: Engine) -> End:
        """Put all points back to where they were measured; return where that was."""
        before, self.before = self.before, None
        self.emphasis, self.firm, self.alike = 0, False, np.inf
        assert before is not None
        engine.problem, engine.bend, engine.plain = before.problem, None, True
        engine.refused_pattern, engine.emphasis = before.size, EMPHASIS[0]
        level, outcome = before.end.level, before.end.outcome
        lin = linearise(
            level.problem, level.grid, outcome.state, outcome.loss, engine.workers, level.smooth
        )
        return replace(before.end, outcome=replace(outcome, lin=lin))

    def further(self, engine: Engine, end: End, there: Known) -> End | None:
        """Settle anew as what is known asks for; None: it asks for nothing."""
        known, outcome, level = there.correlation, end.outcome, end.level
        finer = engine.finer(level.grid.spacing, known, outcome)
        less = known.inflation < LESS * end.believed
        bent = _bent(engine, there, outcome.sigma)
        recounted = level.tied is not None and self.recount(known.overall)
        loose = outcome.sigma < LOOSE * self.sigma
        settled = less or loose or finer < level.grid.spacing
        # a pattern may be what keeps the poses from settling
        more = recounted or bent or (outcome.converged and settled)
        self.sigma = outcome.sigma
        if engine.clock.over or not more:
            return None
        # poses that had not settled had made the residuals look more alike than they are
        state, lin, index = outcome.state, outcome.lin, end.index
        # where nothing but the measured poses' weight changes, patches lie as well as they can
        new = recounted or bent or loose or finer < level.grid.spacing or engine.doubted
        tied = None if new else outcome.tied
        if bent and there.believed is not None:
            taken = self.trail.next(engine.bend, there.believed.pattern)
            self.before = _on_trial(engine, self.before, end, there, taken)
            level = engine.unbent(level, taken)
            state, lin = engine.map_solved(level, state)
        if recounted:
            engine.emphasis = EMPHASIS[self.emphasis]
        S: NDArray[np.float64] | None = end.S
        if finer < level.grid.spacing:
            index, S = index + 1, None
            coarse = Map(state.heights, level.grid)
            level, state, lin = engine.lay(finer, state.T_map_camera, coarse, True)
        return engine.settle(level, state, lin, index, known, S, tied)

    def recount(self, overall: float) -> bool:
        """Let patches count more, or less again; return whether they count otherwise than before.

        ``overall``: how much alike residuals are now.
        """
        if self.firm or overall <= ALIKE:
            return False
        if overall < self.alike:
            if self.emphasis == len(EMPHASIS) - 1:
                return False
            self.emphasis += 1
        elif EMPHASIS[self.emphasis] > EMPHASIS[max(self.emphasis - 1, 0)]:
            self.emphasis, self.firm = self.emphasis - 1, True
        else:
            return False
        self.alike = overall
        return True


def known_at(engine: Engine, level: Level, state: State, loss: Loss) -> Known:
    """Return what the points say at a state, but for those that must not vouch for it."""
    problem, workers = level.problem, engine.workers
    if engine.preset.robust:
        problem = without_bends(problem, level.grid, state.heights, state.T_map_camera)
    lin = linearise(problem, level.grid, state, loss, workers, level.smooth)
    at = reduced.reduce(lin, workers, free=engine.free)
    if engine.doubted:
        level = replace(level, tied=None)
    elif level.tied:
        # no point vouches twice
        level = engine.patched(level, state, lin, vouching=True)
    at = engine.with_patches(level, state, lin, at)
    believed = _believed(engine, problem, level, state, loss, lin, at)
    found = certainty.correlation(
        problem, level.grid, state, loss, lin, engine.prior, engine.free, workers, at, believed,
        level.tied.patches if level.tied else None,
    )  # fmt: skip
    engine.clock.lap("certainty")
    return Known(problem, lin.uncoupled(), found, believed)


def _believed(
    engine: Engine, problem: Problem, level: Level, state: State, loss: Loss, lin: Linearisation,
    at: reduced.Reduction,
) -> pattern.Believed | None:  # fmt: skip
    """Return what the points say of the camera's fixed pattern; None: there is none."""
    waves, free = problem.waves, engine.free
    if engine.plain or not engine.preset.pattern or waves is None or not free.any():
        return None
    now = np.zeros(len(waves)) if engine.bend is None else engine.bend
    variance = robust_sigma(lin.residuals) ** 2
    if not variance:  # no point is left to ask: the map bends sharply everywhere
        return None
    matrix, _ = engine.acting.at(state.T_map_camera).normal_equations(lin.pivots)
    found = pattern.answers(problem, level.grid, state, loss, lin, at, waves, engine.workers)
    if level.tied:
        poses, patches = state.T_map_camera, level.tied.patches
        told = patch_waves.told(patches, poses, lin.pivots, waves, engine.workers)
        found = found.beside(told)
    believed = pattern.believe(
        found, at.S + variance * matrix, np.repeat(free, 6), now, pattern.CAUTION * variance
    )
    engine.plain = engine.bend is None and not believed.strength
    return None if engine.plain else believed


def _bent(engine: Engine, there: Known, sigma: float) -> bool:
    """Whether the camera's fixed pattern calls for steps that are worth taking."""
    if there.believed is None:
        return False
    gain, variance = there.believed.gain, there.inflation * sigma**2
    dof = 6 * max(int(engine.free.sum()), 1)
    return bool(gain @ there.correlation.S @ gain > dof * BENT**2 * variance)


def _on_trial(
    engine: Engine, before: _Before | None, end: End, there: Known, taken: NDArray[np.float64]
) -> _Before:
    """Return where to go back to if the pattern (m,) that is taken off now proves false."""
    waves, noise = engine.problem.waves, engine.problem.noise
    assert waves is not None  # a pattern is made of them
    size = waves.size(taken)
    share = GROWN if noise is not None and size <= MODEST * noise else CLEARED
    before = before or _Before(_uncoupled(end), there.inflation, engine.problem, size, share)
    return replace(before, size=size, share=share)
