"""Tracks and their bundle adjustment: dense algebra, finite differences, known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from depthba import se3
from depthba.clouds import transform
from eval.methods.landmarks import LandmarkOptions, adjust, cost, linearise, residuals, step
from eval.methods.tracks import Link, Tracks, build_tracks, only_frames, tied_frames

Floats = NDArray[np.float64]
HUBER = 0.004


def test_matches_become_tracks_and_contradictions_go() -> None:
    points = [np.arange(12.0).reshape(4, 3) + 100 * k for k in range(3)]
    links = [
        Link(0, 1, np.array([[0, 1], [1, 2], [3, 3]])),
        Link(1, 2, np.array([[1, 0], [2, 1]])),
        # says that points 1 and 2 of frame 0 are one
        Link(0, 2, np.array([[2, 1]])),
        Link(2, 1, np.zeros((0, 2), np.int64)),
    ]
    tracks = build_tracks(points, links)
    assert len(tracks) == 2 and tracks.dropped == 1
    np.testing.assert_array_equal(tracks.track, [0, 0, 0, 1, 1])
    np.testing.assert_array_equal(tracks.frame, [0, 1, 2, 0, 1])
    rows = [points[0][0], points[1][1], points[2][0], points[0][3], points[1][3]]
    np.testing.assert_array_equal(tracks.points, rows)
    # the order of the links says nothing
    again = build_tracks(points, [Link(k.b, k.a, k.matches[:, ::-1]) for k in links[::-1]])
    np.testing.assert_array_equal(again.points, tracks.points)


def test_rows_that_do_not_exist_are_refused() -> None:
    points = [np.zeros((4, 3)), np.zeros((2, 3))]
    with pytest.raises(ValueError, match="row 2 of frame 1, which has 2 points"):
        build_tracks(points, [Link(0, 1, np.array([[0, 0], [1, 2]]))])
    assert len(build_tracks(points, [])) == 0


def test_frames_are_tied_by_three_landmarks_at_least() -> None:
    points = [np.random.default_rng(0).normal(size=(9, 3)) for _ in range(4)]
    three, two = np.tile(np.arange(3)[:, None], 2), np.tile(np.arange(4, 6)[:, None], 2)
    tracks = build_tracks(points, [Link(0, 1, three), Link(1, 2, three + 3), Link(0, 3, two)])
    tied = tied_frames(tracks)
    np.testing.assert_array_equal(tied, [True, True, True, False])
    left = only_frames(tracks, tied)
    assert len(left) == 6 and 3 not in left.frame
    assert np.all(np.bincount(left.track) == 2)


def scene(
    frames: int = 5, sigma: float = 0.001, outliers: float = 0.0, seed: int = 0
) -> tuple[Tracks, Floats, Floats]:
    """Landmarks in a cube of a metre, seen by two frames or more; truth of poses and landmarks."""
    rng = np.random.default_rng(seed)
    T = se3.retract(np.tile(np.eye(4), (frames, 1, 1)), rng.normal(size=(frames, 6)) * 0.3)
    world = rng.uniform(-0.5, 0.5, size=(60, 3))
    seen = [np.sort(rng.choice(frames, rng.integers(2, frames + 1), replace=False)) for _ in world]
    frame = np.concatenate(seen)
    track = np.repeat(np.arange(len(world)), [len(s) for s in seen])
    at = world[track] + sigma * rng.normal(size=(len(track), 3))
    wrong = rng.uniform(size=len(track)) < outliers
    at[wrong] += rng.normal(size=(int(wrong.sum()), 3)) * 0.3
    points = np.stack(
        [transform(se3.inverse(T[k]), q[None])[0] for k, q in zip(frame, at, strict=True)]
    )
    return Tracks(frames, track, frame, points), T, world


def joint(tracks: Tracks, T: Floats, landmarks: Floats) -> tuple[Floats, Floats]:
    """Dense weighted normal equations over all poses and landmarks."""
    lin = linearise(tracks, T, landmarks, HUBER)
    n = 6 * tracks.frames
    J = np.zeros((len(tracks.track), 3, n + 3 * len(tracks)))
    for k, (i, m) in enumerate(zip(tracks.frame, tracks.track, strict=True)):
        J[k, :, 6 * i : 6 * i + 6] = lin.A[k]
        J[k, :, n + 3 * m : n + 3 * m + 3] = -np.eye(3)
    J = J.reshape(-1, J.shape[-1])
    w = np.repeat(lin.weight, 3)
    return J.T @ (w[:, None] * J), J.T @ (w * lin.residual.ravel())


@pytest.fixture(scope="module")
def awkward() -> tuple[Tracks, Floats, Floats]:
    """Some residuals within Huber's bound, some beyond."""
    tracks, T, landmarks = scene(sigma=0.002)
    rng = np.random.default_rng(1)
    T = se3.retract(T, rng.normal(size=(len(T), 6)) * 0.002)
    landmarks = landmarks + rng.normal(size=landmarks.shape) * 0.002
    length = np.linalg.norm(residuals(tracks, T, landmarks), axis=1)
    assert np.count_nonzero(length < HUBER) > 20 and np.count_nonzero(length > HUBER) > 20
    return tracks, T, landmarks


def test_derivatives_are_those_of_the_residuals_and_of_the_loss(
    awkward: tuple[Tracks, Floats, Floats],
) -> None:
    tracks, T, landmarks = awkward
    lin = linearise(tracks, T, landmarks, HUBER)
    _, gradient = joint(tracks, T, landmarks)
    h = 1e-6
    for i in range(6 * tracks.frames):
        delta = np.zeros((tracks.frames, 6))
        delta.ravel()[i] = h
        up = residuals(tracks, se3.retract(T, delta), landmarks)
        down = residuals(tracks, se3.retract(T, -delta), landmarks)
        mine = tracks.frame == i // 6
        np.testing.assert_allclose((up - down)[mine] / (2 * h), lin.A[mine, :, i % 6], atol=1e-8)
        np.testing.assert_array_equal(up[~mine], down[~mine])
        slope = (cost(up, HUBER) - cost(down, HUBER)) / (2 * h)
        assert gradient[i] == pytest.approx(slope, abs=1e-7)
    for i in range(3 * len(tracks)):
        shift = np.zeros_like(landmarks)
        shift.ravel()[i] = h
        up = residuals(tracks, T, landmarks + shift)
        down = residuals(tracks, T, landmarks - shift)
        slope = (cost(up, HUBER) - cost(down, HUBER)) / (2 * h)
        assert gradient[6 * tracks.frames + i] == pytest.approx(slope, abs=1e-7)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_elimination_is_the_dense_solution(
    awkward: tuple[Tracks, Floats, Floats], damping: float
) -> None:
    tracks, T, landmarks = awkward
    H, gradient = joint(tracks, T, landmarks)
    H[np.diag_indices(len(H))] *= 1 + damping
    want = np.zeros(len(H))
    want[6:] = -np.linalg.solve(H[6:, 6:], gradient[6:])
    moves = np.ones(tracks.frames, dtype=bool)
    moves[0] = False
    delta, shift = step(tracks, linearise(tracks, T, landmarks, HUBER), damping, moves)
    np.testing.assert_allclose(np.concatenate([delta.ravel(), shift.ravel()]), want, atol=1e-12)


def test_recovers_poses_exactly_without_noise_and_despite_outliers() -> None:
    tracks, T_true, world = scene(sigma=0.0)
    start = se3.retract(T_true, np.random.default_rng(2).normal(size=(5, 6)) * 0.2)
    start[0] = T_true[0]
    solution = adjust(tracks, start, LandmarkOptions(HUBER, tolerance=1e-14))
    assert solution.converged
    np.testing.assert_allclose(solution.T_world_camera, T_true, atol=1e-8)
    np.testing.assert_allclose(solution.landmarks, world, atol=1e-8)
    np.testing.assert_array_equal(solution.T_world_camera[0], start[0])

    tracks, T_true, _ = scene(sigma=0.001, outliers=0.1)
    robust = adjust(tracks, start, LandmarkOptions(HUBER)).T_world_camera
    squares = adjust(tracks, start, LandmarkOptions(1e9)).T_world_camera
    off = [np.abs(se3.difference(T, T_true)).mean() for T in (robust, squares)]
    assert off[0] < 0.001 and off[1] > 5 * off[0]


def test_a_common_motion_of_the_start_moves_the_result() -> None:
    tracks, T_true, _ = scene()
    together = se3.retract(np.eye(4), np.random.default_rng(4).normal(size=6))
    here = adjust(tracks, T_true, LandmarkOptions(HUBER))
    there = adjust(tracks, together @ T_true, LandmarkOptions(HUBER))
    assert there.cost == pytest.approx(here.cost, rel=1e-9)
    np.testing.assert_allclose(there.T_world_camera, together @ here.T_world_camera, atol=1e-7)


def test_frames_without_landmarks_stay() -> None:
    tracks, T_true, _ = scene()
    wider = replace(tracks, frames=6)
    start = np.concatenate([T_true, np.eye(4)[None]])
    solution = adjust(wider, start, LandmarkOptions(HUBER))
    np.testing.assert_array_equal(solution.T_world_camera[5], np.eye(4))
    alone = adjust(tracks, T_true, LandmarkOptions(HUBER))
    np.testing.assert_allclose(solution.T_world_camera[:5], alone.T_world_camera, atol=1e-12)
