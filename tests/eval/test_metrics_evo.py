"""Our trajectory figures are evo's, on the same files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from depthba import se3
from depthba.trajectory import read_tum, write_tum
from eval.metrics import pose_metrics

evo_metrics = pytest.importorskip("evo.core.metrics")
sync = pytest.importorskip("evo.core.sync")
file_interface = pytest.importorskip("evo.tools.file_interface")


@pytest.mark.parametrize("size", [1e-5, 1e-3, 0.3])
@pytest.mark.parametrize("line", [False, True])
def test_evo_agrees(tmp_path: Path, size: float, line: bool) -> None:
    """ATE after alignment without scale, and RPE from frame to frame; centres on a line, too."""
    n = 40
    rng = np.random.default_rng(3)
    phi = 0.2 * np.cumsum(rng.normal(size=(n, 3)), axis=0)
    t = np.cumsum(rng.normal(size=(n, 3)) * ([1.0, 1e-3, 1e-3] if line else [1.0, 1.0, 0.2]), 0)
    T_true = se3.make(se3.exp_so3(phi), t)
    T_est = se3.retract(T_true, size * rng.normal(size=(n, 6)))
    T_est = se3.make(se3.exp_so3([0.5, -1.0, 2.0]), [3.0, 2.0, 1.0]) @ T_est
    stamps = 100.0 + 0.1 * np.arange(n)
    for name, T in (("true", T_true), ("est", T_est)):
        write_tum(tmp_path / f"{name}.txt", stamps, T, name)

    read = [file_interface.read_tum_trajectory_file(tmp_path / f"{k}.txt") for k in ("true", "est")]
    true, est = sync.associate_trajectories(*read)
    relation, unit = evo_metrics.PoseRelation, evo_metrics.Unit.frames
    rpe = {}
    for name, kind in (
        ("rpe_translation_rmse", relation.translation_part),
        ("rpe_rotation_rmse", relation.rotation_angle_rad),
    ):
        judged = evo_metrics.RPE(kind, delta=1.0, delta_unit=unit, all_pairs=False)
        judged.process_data((true, est))
        rpe[name] = judged.get_statistic(evo_metrics.StatisticsType.rmse)
    est.align(true, correct_scale=False)
    ape = evo_metrics.APE(relation.translation_part)
    ape.process_data((true, est))

    ours = pose_metrics(read_tum(tmp_path / "est.txt")[1], read_tum(tmp_path / "true.txt")[1])
    got = {m.name: m.value for m in ours}
    ate = ape.get_statistic(evo_metrics.StatisticsType.rmse)
    assert_allclose(got["ate_rmse"], ate, rtol=0, atol=1e-9)
    for name, value in rpe.items():
        assert_allclose(got[name], value, rtol=0, atol=1e-9, err_msg=name)
