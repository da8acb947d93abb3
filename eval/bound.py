"""The Cramér-Rao bound: the least error that the noise of a dataset with truth allows.

Poses and map are estimated together, frame 0 anchored, so the least covariance of the poses is
``sigma^2 S^-1`` with the exact reduced matrix ``S = A - B C^-1 B^T`` at the true poses, the map
being as fine as asked. Every point weighs what its own range noise says, ``1 / (n.u)^2`` of a
vertical residual: the floor for lateral noise that the optimiser adds is taken out again.

The matrix needs the gradients of the surface without noise: an estimated map's noise counts as
slope and flatters the bound. They come from

- ``clean``: frames without noise at the true poses, rendered anew where the dataset comes from our
  simulator, or given by the caller;
- ``noisy``: else the map is fitted to the frames as they are, at the true poses, and what noise in
  its slope adds to S is drawn once and taken off.

A bound only covers points that obey the model. Edges and walls, which a height map of that spacing
cannot hold, get the weight that the robust loss gives them at the noise's own scale: to the misfit
alone in ``clean``; in ``noisy`` to misfit and noise, less what the noise alone would lose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from depthba.dataset import Dataset
from depthba.errors import DatasetError, OptionError
from depthba.optimiser import kernels, reduced, schedule
from depthba.optimiser.feet import Ground
from depthba.optimiser.grid import Grid, average, filled, make_grid, near
from depthba.optimiser.linearise import (
    Linearisation,
    Loss,
    State,
    fronts_of,
    robust_sigma,
)
from depthba.optimiser.prior import about_pivot
from depthba.optimiser.problem import FramePoints, Problem, Roi, prepare
from depthba.optimiser.slope_noise import noise_linearisation
from depthba.optimiser.solver import solve_map
from depthba.optimiser.workers import Workers
from depthba.options import Options

Floats = NDArray[np.float64]

# Rounds of reweighting; the map has settled by then.
ROUNDS = 4
# Relative residual of the solves with the map's block.
TOLERANCE = 1e-5


@dataclass(frozen=True)
class Bound:
    """The least errors, and what they were computed from."""

    translation: float
    """Least mean absolute error per axis of the camera centres, m; infinite where the data leave a
    direction open."""
    rotation: float
    """Likewise of ``log(R_est R_true^T)``, rad."""
    covariance: Floats
    """(6N - 6, 6N - 6), translation then rotation of frames 1 and on, world axes, about the camera
    centre, frame 0 anchored."""
    spacing: float
    """Of the map, m."""
    sigma: float
    """Range noise of a typical point, m."""
    surface: Literal["clean", "noisy"]
    """Where the gradients come from."""


def bound(
    dataset: Dataset,
    spacing: float,
    clean: Sequence[NDArray[np.floating]] | None = None,
    roi: Roi | None = None,
    truth: Floats | None = None,
    threads: int = 1,
) -> Bound:
    """Return the Cramér-Rao bound of a dataset.

    Args:
        dataset: with true poses and a stated noise.
        spacing: of the map, m.
        clean: (height, width) depth of each frame without noise, m; None: rendered anew where the
            dataset tells how, else the frames as they are.
        roi: as for the registration.
        truth: (N, 4, 4) T_world_camera; None: the dataset's own.
        threads: of the kernels.

    Raises:
        DatasetError: truth or stated noise is missing.
        OptionError: so fine a grid would not fit into memory.

    """
    T_true = dataset.T_world_camera_true if truth is None else truth
    if T_true is None:
        raise DatasetError(
            f"{dataset.path}: no poses_true.txt, but the bound needs the true poses; `depthba "
            "evaluate` takes a file of them with --truth"
        )
    if dataset.sensor.noise is None:
        raise DatasetError(
            f"{dataset.path}: dataset.json states no sensor.noise, but the bound needs it"
        )
    if not (np.isfinite(spacing) and spacing > 0):
        raise OptionError(f"spacing of the bound: {spacing} m, expected a length above 0")
    problem = prepare(dataset, T_true, roi)
    sigma = problem.noise or 0.0
    if clean is None:
        clean = rendered(dataset, T_true)
    workers = Workers(threads)
    try:
        if clean is not None:
            S, lin = _of_clean(_cleaned(problem, dataset, clean), spacing, workers)
        else:
            S, lin = _of_noisy(problem, spacing, workers)
    finally:
        workers.close()
    covariance = _covariance(S, sigma**2, problem, lin)
    deviations = np.sqrt(np.diag(covariance)).reshape(-1, 6)
    expected = np.sqrt(2 / np.pi)  # of the magnitude of a standard normal error
    return Bound(
        translation=float(expected * deviations[:, :3].mean()),
        rotation=float(expected * deviations[:, 3:].mean()),
        covariance=covariance,
        spacing=spacing,
        sigma=sigma,
        surface="noisy" if clean is None else "clean",
    )


def rendered(dataset: Dataset, T_true: Floats) -> list[Floats] | None:
    """Return each frame's exact depth (height, width), m, rendered anew at the true poses.

    None where the dataset is not the simulator's, or its scene no longer comes out the same.
    """
    source = dataset.header.get("source", {})
    if source.get("tool") != "depthba generate" or "config" not in source:
        return None
    from sim import stored_scene
    from sim.capture import Capture  # MuJoCo and Embree take a while to import
    from sim.options import GenerateOptions
    from sim.scenes import SCENES, find_scene

    config: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in source["config"].items()
    }
    # A dataset may come from anybody: no code that it names is run, and no file outside is read.
    if "scene_sha256" in source:
        stored_scene.read(dataset.path)
        scene = str(dataset.path / stored_scene.SCENE)
    elif source.get("scene") in SCENES:
        scene = source["scene"]
    else:
        return None
    capture = Capture.plan(find_scene(scene), GenerateOptions(**config))
    planned = capture.track.T_world_camera_true
    rows = [frame.id for frame in dataset]
    if max(rows) >= len(planned) or not np.allclose(planned[rows], T_true, atol=1e-8):
        return None
    return [capture.expose(k, rgb=False).exact for k in rows]


def _cleaned(problem: Problem, dataset: Dataset, clean: Sequence[NDArray[np.floating]]) -> Problem:
    """Return the problem with every point moved along its ray to the exact depth.

    Points for which there is none no longer count.
    """
    camera = dataset.sensor.camera
    if camera is None:
        raise DatasetError(f"{dataset.path}: clean depth images, but its frames are clouds")
    if len(clean) != len(problem.frames):
        raise DatasetError(
            f"{dataset.path}: {len(clean)} clean depth images, expected {len(problem.frames)}"
        )
    frames = []
    for frame, depth in zip(problem.frames, clean, strict=True):
        points = frame.points.copy()
        pixel = np.rint(camera.project(points)).astype(int)
        u = np.clip(pixel[:, 0], 0, camera.width - 1)
        v = np.clip(pixel[:, 1], 0, camera.height - 1)
        exact = np.asarray(depth, dtype=float)[v, u]
        known = np.isfinite(exact) & (exact > 0)
        points[known] *= (exact[known] / points[known, 2])[:, None].astype(np.float32)
        share = np.where(known, frame.share, np.float32(0.0))
        frames.append(replace(frame, points=points, share=share))
    return replace(problem, frames=tuple(frames))


def _of_clean(problem: Problem, spacing: float, workers: Workers) -> tuple[Floats, Linearisation]:
    problem, _, _, _, lin = _fitted(problem, spacing, workers)
    return reduced.exact(lin, workers, TOLERANCE), lin


def _of_noisy(problem: Problem, spacing: float, workers: Workers) -> tuple[Floats, Linearisation]:
    problem, grid, state, loss, lin = _fitted(problem, spacing, workers)
    noise = noise_linearisation(problem, grid, state, loss, lin, workers)
    S = reduced.exact(lin, workers, TOLERANCE)
    S -= (problem.noise or 0.0) ** 2 * reduced.exact(noise, workers, 1e-3)
    return S / _kept_of_noise(schedule.PRESETS["default"].robust), lin


def _kept_of_noise(c: float) -> float:
    """Return the mean Geman-McClure weight of standard normal errors at scale c."""
    e = np.linspace(-8, 8, 2001)
    density = np.exp(-0.5 * e * e)
    return float((c**2 / (c**2 + e * e)) ** 2 @ density / density.sum())


def _fitted(
    problem: Problem, spacing: float, workers: Workers
) -> tuple[Problem, Grid, State, Loss, Linearisation]:
    """Fit the map at the problem's poses.

    Returns the problem with its points weighed by range noise alone, and what was fitted.
    """
    preset = schedule.PRESETS["default"]
    grid = make_grid(problem, spacing, 2 * spacing)
    averages = average(problem, problem.T_map_camera, grid)
    seen = averages.count > 0
    typical = float(np.median(averages.count[seen])) if seen.any() else 1.0
    loss = schedule.loss_for(preset, Options(), problem, spacing, typical)
    smooth = near(seen, 3)
    state = State(problem.T_map_camera, filled(averages.heights))
    state, lin = solve_map(problem, grid, state, loss, smooth, workers, 2)
    for _ in range(ROUNDS):
        scale = max(problem.noise or 0.0, robust_sigma(lin.residuals))
        loss = replace(loss, robust_c=preset.robust * scale)
        weighed = _by_range(problem, grid, state, loss)
        state, lin = solve_map(weighed, grid, state, loss, smooth, workers, 1)
    return weighed, grid, state, loss, lin


def _by_range(problem: Problem, grid: Grid, state: State, loss: Loss) -> Problem:
    """Return the problem with points weighed so that a residual is as large as its range noise.

    The kernels divide a vertical residual by ``sqrt((n.u)^2 + LATERAL |n|^2)``; range noise alone
    asks for ``|n.u|``, which is kept away from 0 as they do.
    """
    if not loss.along_ray:
        return problem
    ground = Ground(problem, grid, state, replace(loss, along_ray=False))
    fronts = fronts_of(problem, state.T_map_camera)

    def weighed(i: int) -> FramePoints:
        frame, feet = problem.frames[i], ground.feet(i)
        if not len(frame):
            return frame
        u = feet.arms / np.linalg.norm(feet.arms, axis=0)
        nu = fronts[i] * (u[2] - (feet.slopes * u[:2]).sum(axis=0))
        normal = 1.0 + (feet.slopes**2).sum(axis=0)
        asked = np.maximum(nu, kernels.GRAZING)
        less = (np.sqrt(nu**2 + kernels.LATERAL * normal) / asked).astype(np.float32)
        return replace(frame, inverse_noise=frame.inverse_noise * less)

    frames = tuple(weighed(i) for i in range(len(problem.frames)))
    return replace(problem, frames=frames)


def _covariance(S: Floats, variance: float, problem: Problem, lin: Linearisation) -> Floats:
    """Return ``variance S^-1`` over frames 1 and on, about the camera centres, world axes."""
    S = S[6:, 6:]
    # each unknown in its own scale, so that metres and radians do not hide what is open
    own = np.sqrt(np.maximum(np.diag(S), 1e-300))
    values, vectors = np.linalg.eigh(S / np.outer(own, own))
    if values[0] < 1e-9 * values[-1]:
        return np.full(S.shape, np.inf)
    inverse = variance * (vectors / values) @ vectors.T / np.outer(own, own)
    turn = np.kron(np.eye(2), problem.T_map_world[:3, :3].T)
    J = turn @ about_pivot(problem.T_map_camera, lin.pivots)[1:]
    n = len(J)
    rows = np.einsum("iab,ibjc->iajc", J, inverse.reshape(n, 6, n, 6))
    return np.asarray(np.einsum("iajc,jdc->iajd", rows, J).reshape(6 * n, 6 * n))
