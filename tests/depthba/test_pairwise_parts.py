"""The parts of the pairwise start: graph, correlation, descriptors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft

from depthba import se3
from depthba.pairwise import correlate, features, graph


def ring(rng: np.random.Generator, count: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count
    t = np.column_stack([2 * np.cos(angle), 2 * np.sin(angle), np.ones(count)])
    return se3.make(se3.exp_so3(rng.normal(0, 0.5, (count, 3))), t)


@pytest.mark.parametrize("seed", range(5))
def test_graph_finds_the_truth_among_outliers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, edges, wrong = ring(rng, 12), [], []
    for i in range(12):
        for j in (i + 1, i + 2, i + 3):
            T_i_j = se3.inverse(truth[i]) @ truth[j % 12]
            bad = bool(rng.random() < 0.3)
            noise = rng.normal(size=6) * (np.repeat([0.3, 0.2], 3) if bad else 1e-4)
            wrong.append(bad)
            T_i_j = se3.retract(T_i_j, noise)
            edges.append(graph.Edge(i, j % 12, T_i_j, np.array([0, 0, 1.0]), 0.5))
    start = se3.retract(truth, rng.normal(size=(12, 6)) * np.repeat([0.1, 0.05], 3))
    start[0] = truth[0]
    information = np.repeat(np.diag([100.0] * 3 + [400.0] * 3)[None], 12, axis=0)
    found = graph.solve(start, edges, 0.005, information)
    assert ((found.believed < 0.5) == np.array(wrong)).all()
    assert found.off[found.believed > 0.5].max() < 1e-3
    # half of a frame's few edges may be wrong, and the others feel a turn 3 m away
    assert np.abs(se3.difference(found.T_map_camera, truth)).max() < 0.005
    assert (found.T_map_camera[0] == truth[0]).all()


def test_graph_ties_a_frame_whose_right_edges_are_outnumbered() -> None:
    """Wrong edges that agree with nothing do not keep the right ones out."""
    rng = np.random.default_rng(0)
    truth = ring(rng, 6)
    edges = []
    for i in range(6):
        for j in range(i):
            T_i_j, right = se3.inverse(truth[i]) @ truth[j], 3 not in (i, j) or {i, j} == {3, 0}
            if not right:
                T_i_j = se3.retract(T_i_j, rng.normal(size=6) * 0.3)
            weight = 8.0 if {i, j} == {3, 0} else 1.5
            edges.append(graph.Edge(i, j, T_i_j, np.array([0, 0, 1.0]), 0.5, weight))
    start = truth.copy()
    start[3] = se3.retract(truth[3], [0.3, -0.2, 0.1, 0.1, 0.1, -0.1])
    information = np.repeat(np.diag([100.0] * 3 + [400.0] * 3)[None], 6, axis=0)
    found = graph.solve(start, edges, 0.01, information)
    assert found.believed.sum() == 11
    # the start pulls a little at the one edge
    assert np.abs(se3.difference(found.T_map_camera, truth)).max() < 0.002


def test_graph_keeps_what_no_edge_holds() -> None:
    truth = ring(np.random.default_rng(0), 4)
    edge = graph.Edge(0, 1, se3.inverse(truth[0]) @ truth[1], np.zeros(3), 0.5)
    found = graph.solve(truth, [edge], 0.01, np.repeat(np.eye(6)[None], 4, axis=0))
    assert np.abs(found.T_map_camera - truth).max() < 1e-9


def test_correlation_equals_its_sums() -> None:
    """Against the definition, shift by shift, with holes in both."""
    rng = np.random.default_rng(0)
    side, size = 24, fft.next_fast_len(47, real=True)
    seen = [rng.random((side, side)) < 0.9 for _ in range(2)]
    relief = [np.where(s, rng.standard_normal((side, side)), 0).astype(np.float32) for s in seen]
    spectra = [correlate.spectrum(r, s, size) for r, s in zip(relief, seen, strict=True)]
    window = correlate.Window(np.arange(-4, 6), np.arange(-3, 8))
    r, shared = correlate.correlation(spectra[0], spectra[1], size, window)
    for row, dy in enumerate(window.rows):
        for column, dx in enumerate(window.columns):
            here = np.s_[max(dy, 0) : side + min(dy, 0), max(dx, 0) : side + min(dx, 0)]
            there = np.s_[max(-dy, 0) : side + min(-dy, 0), max(-dx, 0) : side + min(-dx, 0)]
            both = seen[0][here] & seen[1][there]
            a, b = relief[0][here][both], relief[1][there][both]
            expected = max(float(a @ b / np.sqrt((a @ a) * (b @ b))), 0.0)
            assert shared[row, column] == pytest.approx(both.sum(), abs=0.01)
            assert r[row, column] == pytest.approx(expected, abs=1e-4)


def cloud(rng: np.random.Generator) -> np.ndarray:
    xy = rng.uniform(-0.3, 0.3, (1500, 2))
    z = 1.0 + 0.03 * np.sin(17 * xy[:, 0]) * np.cos(13 * xy[:, 1]) + 0.02 * np.sin(23 * xy[:, 1])
    return np.column_stack([xy, z])


def test_descriptors_do_not_change_under_rigid_motion() -> None:
    points = cloud(np.random.default_rng(0))
    normal = features.normals(points, 0.06)
    R = se3.exp_so3([0.4, -0.8, 1.3])
    one = features.fpfh(points, normal, 0.1)
    two = features.fpfh(points @ R.T + [1.0, 2.0, -3.0], normal @ R.T, 0.1)
    # a pair on the edge of two bins may fall to either side by rounding
    assert np.quantile(np.abs(one - two).max(axis=1), 0.9) < 1e-3
    assert np.allclose(one.reshape(-1, 3, features.BINS).sum(axis=2), 100, atol=1e-2)
    pairs = features.mutual(one, two)
    assert len(pairs) > 0.99 * len(points) and (pairs[:, 0] == pairs[:, 1]).mean() > 0.99


def test_normals_face_the_sensor() -> None:
    xy = np.random.default_rng(1).uniform(-0.3, 0.3, (500, 2))
    points = np.column_stack([xy, 1.0 + 0.2 * xy[:, 0]])
    expected = np.array([0.2, 0.0, -1.0]) / np.hypot(0.2, 1.0)
    assert np.allclose(features.normals(points, 0.08), expected, atol=1e-6)
    assert len(features.thinned(points.astype(np.float32), 0.1)) < 80
