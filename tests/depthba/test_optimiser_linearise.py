"""The fast pass against the plain NumPy reference, and the paper's parametrisation against ours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from depthba.optimiser.linearise import Loss, Workers, linearise
from tests.depthba import numpy_reference as reference
from tests.depthba.optimiser_problems import (
    LOSSES,
    VERTICAL,
    Case,
    awkward_case,
    dense_of,
    rows_of,
)

STEPS = 1e-6 * np.eye(3)


def rotation(euler: np.ndarray) -> np.ndarray:
    return np.asarray(Rotation.from_euler("ZYX", euler).as_matrix())


def judged_by(case: Case, loss: Loss, pivots: np.ndarray) -> reference.Dense:
    return reference.normal_equations(
        [rows_of(f) for f in case.problem.frames], case.state.T_map_camera, pivots,
        reference.Map(case.state.heights, case.grid.origin, case.grid.spacing),
        along_ray=loss.along_ray, slope=loss.slope, cap=loss.cap, c=loss.robust_c,
        charge=loss.charge, smoothing=loss.smoothing, smooth=case.smooth,
    )  # fmt: skip


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("name", LOSSES)
def test_pass_agrees_with_explicit_rows(name: str, threads: int) -> None:
    case, loss, workers = awkward_case(), LOSSES[name], Workers(threads)
    lin = linearise(case.problem, case.grid, case.state, loss, workers, case.smooth)
    workers.close()
    want = judged_by(case, loss, lin.pivots)
    # the case holds what it promises: lost points, walks cut at the cap, bare nodes
    assert 0 < want.used < sum(map(len, case.problem.frames))
    n = 6 * len(lin.A)
    bare = n + np.flatnonzero(np.diag(want.H)[n:] == 0)
    assert len(bare)
    want.H[bare, bare] = 1.0
    H, g = dense_of(lin)
    np.testing.assert_allclose(H, want.H, atol=1e-9 * np.abs(want.H).max(), rtol=1e-9)
    np.testing.assert_allclose(g, want.g, atol=1e-9 * np.abs(want.g).max())
    assert lin.cost == pytest.approx(want.cost, rel=1e-9)
    assert lin.judged == pytest.approx(want.cost, rel=1e-9)
    assert lin.used == want.used
    for got, expected in zip(
        lin.weights + lin.residuals, want.weights + want.residuals, strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-9)


def test_a_step_is_judged_at_the_scale_and_charge_it_was_linearised_with() -> None:
    case, workers = awkward_case(1), Workers(1)
    old = replace(LOSSES["robust"], robust_c=0.03, charge=0.03**2)
    lin = linearise(
        case.problem, case.grid, case.state, LOSSES["robust"], workers, case.smooth, old
    )
    assert lin.judged == pytest.approx(judged_by(case, old, lin.pivots).cost, rel=1e-9)
    assert lin.judged != pytest.approx(lin.cost, rel=1e-3)


def test_paper_in_euler_angles_takes_the_same_step() -> None:
    """The paper's state is [t, Euler angles]; its step is ours in other coordinates."""
    case = awkward_case(2)
    case = replace(case, smooth=np.ones(case.grid.shape, bool))
    T, D = case.state.T_map_camera, case.state.heights
    lin = linearise(case.problem, case.grid, case.state, VERTICAL, Workers(1), case.smooth)
    H, g = dense_of(lin)
    # d(R p + t) / d[t, euler] by the paper; to [tau, phi] about the pivot by the chain rule alone
    n, to_ours = len(T), np.eye(len(g))
    for i in range(n):
        euler = Rotation.from_matrix(T[i, :3, :3]).as_euler("ZYX")
        phi = np.zeros((3, 3))
        for k, step in enumerate(STEPS):
            omega = (rotation(euler + step) - rotation(euler - step)) @ T[i, :3, :3].T / 2e-6
            phi[:, k] = omega[2, 1], omega[0, 2], omega[1, 0]
        block = slice(6 * i, 6 * i + 3), slice(6 * i + 3, 6 * i + 6)
        arm = T[i, :3, 3] - lin.pivots[i]
        to_ours[block[1], block[1]] = phi
        # the camera centre moves by tau + phi x arm
        to_ours[block[0], block[1]] = -np.cross(phi.T, arm).T
    flat, rows, values = D.ravel(), [], []
    grid = reference.Map(D, case.grid.origin, case.grid.spacing)
    for i, frame in enumerate(case.problem.frames):
        euler = Rotation.from_matrix(T[i, :3, :3]).as_euler("ZYX")
        for *p, own, share in rows_of(frame):
            found = reference.vertical(np.array(p), T[i], np.zeros(3), grid)
            if found is None or share == 0:
                continue
            turned = [(rotation(euler + s) - rotation(euler - s)) @ p / 2e-6 for s in STEPS]
            row = np.zeros(len(g))
            normal = found.pose[:3]
            row[6 * i : 6 * i + 6] = [*normal, *(normal @ np.transpose(turned))]
            row[6 * n :] = found.heights
            rows.append(row * own * np.sqrt(share))
            values.append(found.r * own * np.sqrt(share))
    for one, other in reference.neighbours(D.shape, case.smooth):
        row = np.zeros(len(g))
        row[6 * n + one], row[6 * n + other] = np.sqrt(0.1), -np.sqrt(0.1)
        rows.append(row)
        values.append(np.sqrt(0.1) * (flat[one] - flat[other]))
    free = np.arange(len(g)) >= 6  # frame 0 is fixed
    paper = np.zeros(len(g))
    paper[free] = -np.linalg.lstsq(np.array(rows)[:, free], np.array(values), rcond=None)[0]
    ours = np.zeros(len(g))
    ours[free] = -np.linalg.solve(H[np.ix_(free, free)], g[free])
    np.testing.assert_allclose(to_ours @ paper, ours, atol=1e-6 * np.abs(ours).max())
