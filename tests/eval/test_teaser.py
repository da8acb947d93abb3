"""TEASER against the original's answers, and its parts against what is known to be true."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from depthba import se3
from eval.methods.method import MethodError
from eval.methods.teaser import TeaserOptions, register, solve_clique
from eval.methods.teaser.choice import most_consistent
from eval.methods.teaser.clique import core_numbers, greedy_clique, maximum_clique, subgraph
from eval.methods.teaser.graph import consistency_graph, degrees
from eval.methods.teaser.local_search import exchanged
from eval.methods.teaser.rotation import gnc_rotation
from eval.methods.teaser.translation import vote
from tests.eval.oracle_scenes import oracle

Problem = dict[str, NDArray]
PROBLEMS = 18
UNIQUE = range(12)
"""Problems whose largest clique is the set of true inliers."""


@pytest.fixture(scope="module")
def problems() -> Iterator[list[Problem]]:
    with np.load(oracle("teaser_pairs.npz"), allow_pickle=False) as file:
        yield [
            {k.removesuffix(f"_{n}"): file[k] for k in file.files if k.endswith(f"_{n}")}
            for n in range(PROBLEMS)
        ]


def options_of(problem: Problem) -> TeaserOptions:
    return TeaserOptions(noise_bound=float(problem["noise_bound"]))


def apart(T_a: NDArray, T_b: NDArray) -> tuple[float, float]:
    """Degrees and metres."""
    turned = se3.log_so3(T_a[:3, :3].T @ T_b[:3, :3])
    return float(np.degrees(np.linalg.norm(turned))), float(np.linalg.norm((T_a - T_b)[:3, 3]))


def packed(matrix: NDArray[np.bool_]) -> NDArray[np.uint64]:
    n = len(matrix)
    bits = np.zeros((n, -(-n // 64) * 64), bool)
    bits[:, :n] = matrix
    return np.packbits(bits, axis=1, bitorder="little").view(np.uint64)


def unpacked(graph: NDArray[np.uint64]) -> NDArray[np.bool_]:
    bits = np.unpackbits(graph.view(np.uint8), axis=1, bitorder="little")
    return bits[:, : len(graph)].astype(bool)


def is_clique(matrix: NDArray[np.bool_], vertices: NDArray) -> bool:
    inside = matrix[np.ix_(vertices, vertices)]
    return bool((inside | np.eye(len(vertices), dtype=bool)).all())


def largest(matrix: NDArray[np.bool_]) -> int:
    """Size of the largest clique, by trying everything."""

    def grow(size: int, candidates: frozenset[int], best: int) -> int:
        best = max(size, best)
        for v in sorted(candidates):
            if size + len(candidates) <= best:
                break
            candidates = candidates - {v}
            best = grow(size + 1, candidates & neighbours[v], best)
        return best

    neighbours = [frozenset(np.flatnonzero(row).tolist()) for row in matrix]
    return grow(0, frozenset(range(len(matrix))), 0)


@pytest.mark.parametrize("n", range(PROBLEMS))
def test_given_the_originals_clique_the_motion_is_the_originals(
    problems: list[Problem], n: int
) -> None:
    problem = problems[n]
    options = options_of(problem)
    found = solve_clique(problem["src"], problem["dst"], problem["clique"], options)
    T = se3.make(problem["R"], problem["t"])
    np.testing.assert_allclose(found.T_target_source, T, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found.rotation_inliers, problem["rotation_inlier_mask"])
    np.testing.assert_array_equal(found.translation_inliers, problem["translation_inlier_mask"])
    np.testing.assert_allclose(found.gnc_cost, problem["gnc_cost"], rtol=1e-9)
    if "R_ct1e-6" in problem:
        early = solve_clique(
            problem["src"], problem["dst"], problem["clique"], replace(options, least_change=1e-6)
        )
        T = se3.make(problem["R_ct1e-6"], problem["t_ct1e-6"])
        np.testing.assert_allclose(early.T_target_source, T, rtol=0, atol=1e-9)


@pytest.mark.parametrize("n", range(PROBLEMS))
def test_end_to_end_as_the_original(problems: list[Problem], n: int) -> None:
    problem = problems[n]
    src, dst, options = problem["src"], problem["dst"], options_of(problem)
    found = register(src, dst, options)
    assert found.edges == problem["n_graph_edges"]
    assert found.clique_proven
    assert len(found.clique) == len(problem["clique"])
    assert is_clique(unpacked(consistency_graph(src, dst, 2 * options.noise_bound)), found.clique)
    T = se3.make(problem["R"], problem["t"])
    if n in UNIQUE:
        np.testing.assert_array_equal(found.clique, np.flatnonzero(problem["inlier_true"]))
        np.testing.assert_allclose(found.T_target_source, T, rtol=0, atol=1e-9)
        return
    for clique, R, t in zip(
        problem["alt_cliques"], problem["alt_R"], problem["alt_t"], strict=True
    ):
        if np.array_equal(found.clique, clique):
            np.testing.assert_allclose(found.T_target_source, se3.make(R, t), rtol=0, atol=1e-9)
            return
    degrees_apart, metres_apart = apart(found.T_target_source, T)
    spread = problem["alt_spread_deg_m"]
    assert degrees_apart <= max(3 * spread[0], 0.15)
    assert metres_apart <= max(3 * spread[1], 0.5e-3)


def test_the_graph_is_its_definition() -> None:
    rng = np.random.default_rng(3)
    src, dst = rng.normal(size=(2, 130, 3))

    def lengths(p: NDArray) -> NDArray:
        return np.linalg.norm(p[:, None] - p[None], axis=2)

    expected = np.abs(lengths(dst) - lengths(src)) <= 0.3
    np.fill_diagonal(expected, False)
    np.testing.assert_array_equal(unpacked(consistency_graph(src, dst, 0.3)), expected)


@pytest.mark.parametrize("density", [0.0, 0.1, 0.5, 0.8, 0.95, 1.0])
def test_cliques_of_random_graphs_are_the_largest(density: float) -> None:
    """Each part, also: what the greedy search and the exchanges leave to the proof is not empty."""
    rng = np.random.default_rng(int(100 * density))
    branched = 0
    for n in [1, 2, 17, *([24] * 6), *([66] if density < 0.6 else [])]:
        upper = np.triu(rng.random((n, n)) < density, 1)
        matrix = upper | upper.T
        graph = packed(matrix)
        found = maximum_clique(graph)
        assert found.proven
        assert is_clique(matrix, found.vertices)
        assert len(found.vertices) == largest(matrix)
        np.testing.assert_array_equal(maximum_clique(graph).vertices, found.vertices)
        branched += found.branches

        cores, order = core_numbers(graph)
        again = subgraph(graph, order)
        np.testing.assert_array_equal(unpacked(again), matrix[np.ix_(order, order)])
        np.testing.assert_array_equal(degrees(graph), matrix.sum(axis=1))
        # In the order of removal no vertex has more neighbours behind it than its core number.
        behind = np.triu(unpacked(again), 1).sum(axis=1)
        assert (behind <= cores[order]).all()
        assert behind.max() == cores.max()
        greedy = greedy_clique(graph, cores)
        assert is_clique(matrix, greedy)
        better = exchanged(graph, greedy, 50)
        assert is_clique(matrix, better)
        assert len(better) >= len(greedy)
    if density in (0.5, 0.8):
        assert branched


def test_a_large_hidden_clique_is_found() -> None:
    rng = np.random.default_rng(8)
    upper = np.triu(rng.random((600, 600)) < 0.3, 1)
    hidden = np.sort(rng.choice(600, 40, replace=False))
    upper[np.ix_(hidden, hidden)] |= np.triu(np.ones((40, 40), bool), 1)
    found = maximum_clique(packed(upper | upper.T))
    assert found.proven
    np.testing.assert_array_equal(found.vertices, hidden)


def test_without_time_the_best_clique_so_far_is_said_to_be_unproven() -> None:
    rng = np.random.default_rng(4)
    upper = np.triu(rng.random((300, 300)) < 0.8, 1)
    matrix = upper | upper.T
    found = maximum_clique(packed(matrix), seconds=0.0)
    assert not found.proven
    assert is_clique(matrix, found.vertices)
    assert len(found.vertices) >= 10


def test_of_equal_cliques_the_most_consistent_is_taken() -> None:
    """Five points without error and two that are consistent with four of them, but less so."""
    rng = np.random.default_rng(1)
    src = np.vstack([rng.uniform(-1, 1, (6, 3)), np.zeros((1, 3))])
    src[6] = src[5]
    dst = src + np.array([0.1, 0.2, 0.3])
    dst[6] += [0.0, 0.0, 5e-3]
    matrix = ~np.eye(7, dtype=bool)
    matrix[5, 6] = matrix[6, 5] = False
    graph = packed(matrix)
    worse = np.array([0, 1, 2, 3, 4, 6])
    np.testing.assert_array_equal(most_consistent(graph, src, dst, worse), np.arange(6))
    np.testing.assert_array_equal(most_consistent(graph, src, dst, np.arange(6)), np.arange(6))


def test_gnc_finds_the_rotation_among_outliers() -> None:
    rng = np.random.default_rng(2)
    R = se3.exp_so3([0.3, -1.0, 2.0])
    a = rng.normal(size=(200, 3))
    b = a @ R.T + rng.uniform(-1e-3, 1e-3, (200, 3))
    wrong = rng.random(200) < 0.4
    b[wrong] = rng.normal(size=(wrong.sum(), 3))
    found, agree, cost, iterations = gnc_rotation(a, b, 2e-3, 1.4, 100, 1e-12)
    np.testing.assert_array_equal(agree, ~wrong)
    assert np.linalg.norm(se3.log_so3(R.T @ found)) < 3e-4
    assert cost == pytest.approx(((b - a @ found.T)[~wrong] ** 2).sum(), rel=1e-6)
    assert 10 < iterations < 100


def test_a_mirror_image_gives_a_rotation_all_the_same() -> None:
    a = np.random.default_rng(2).normal(size=(50, 3))
    found, *_ = gnc_rotation(a, a * [1.0, 1.0, -1.0], 1e-3, 1.4, 5, 0.0)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)


def test_the_vote_is_the_truncated_least_squares_estimate() -> None:
    rng = np.random.default_rng(6)
    for _ in range(20):
        values = rng.normal(size=8) * 0.1 + 30.0

        def cost(x: NDArray, values: NDArray = values) -> NDArray:
            return np.minimum((values - x[..., None]) ** 2, 0.05**2).sum(axis=-1)

        found = np.array(vote(values, 0.05, 0.05**2))
        everywhere = np.linspace(29.5, 30.5, 20001)
        assert cost(found) <= cost(everywhere).min() + 1e-12
        assert abs(found - everywhere[np.argmin(cost(everywhere))]) <= 1e-4


def test_turning_both_sides_turns_the_answer() -> None:
    rng = np.random.default_rng(9)
    src = rng.uniform(-0.5, 0.5, (300, 3))
    T = se3.make(se3.exp_so3([0.5, 0.2, -0.4]), np.array([0.3, -0.2, 1.0]))
    dst = src @ T[:3, :3].T + T[:3, 3] + rng.uniform(-2e-3, 2e-3, (300, 3))
    wrong = rng.random(300) < 0.7
    dst[wrong] = rng.uniform(-1, 1, (wrong.sum(), 3))
    options = TeaserOptions(noise_bound=4e-3)
    found = register(src, dst, options)
    assert set(np.flatnonzero(~wrong)) <= set(found.clique)
    assert apart(found.T_target_source, T)[0] < 0.1
    T_a, T_b = (se3.make(se3.exp_so3(rng.normal(size=3)), rng.normal(size=3)) for _ in range(2))
    moved = register(src @ T_a[:3, :3].T + T_a[:3, 3], dst @ T_b[:3, :3].T + T_b[:3, 3], options)
    np.testing.assert_array_equal(moved.clique, found.clique)
    degrees_apart, metres_apart = apart(
        moved.T_target_source, T_b @ found.T_target_source @ se3.inverse(T_a)
    )
    assert degrees_apart < 1e-6
    # The vote is per axis, so the set that agrees may differ a little.
    assert metres_apart < 5e-4


def test_what_cannot_be_registered_is_refused() -> None:
    points = np.random.default_rng(0).normal(size=(10, 3))
    with pytest.raises(ValueError, match=r"\(10, 3\) and \(9, 3\)"):
        register(points, points[:9])
    with pytest.raises(ValueError, match="NaN"):
        register(points, points * np.nan)
    with pytest.raises(MethodError, match="2 matches"):
        register(points[:2], points[:2])
    with pytest.raises(MethodError, match="1 consistent"):
        register(points, points * 3.0)
