"""The same input gives the same answer: bits on one machine, kept numbers on any."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import depthba
from depthba.dataset import Dataset
from depthba.optimiser.workers import LEAST_ROWS
from depthba.options import Options
from depthba.result import Result
from tests.depthba.analytic_scene import write_scene
from tests.golden.problems import PROBLEMS, TOLERANCE, kept, solve

# So fine a map that two threads share its rows; where it ends does not matter here.
OPTIONS = {"resolution": 0.009, "max_iterations": 2}
ELSEWHERE = """
import json, sys
import depthba
from tests.depthba.test_reproducible import OPTIONS, bits
for threads in map(int, sys.argv[2:]):
    result = depthba.register(sys.argv[1], depthba.Options(threads=threads, **OPTIONS))
    print(json.dumps(bits(result)))
"""
COMPILED = """
import hashlib
import numpy as np
from depthba.optimiser.laying import lay
from depthba.optimiser.workers import Workers
from tests.depthba.balls import balls, poses
rng = np.random.default_rng(0)
T = poses(rng, 1e-3, 1e-3)
fit = lay(balls(rng, T, 3e-4), T, (0.06, 0.03), 3.5, 3e-4, Workers(1))
print(hashlib.sha256(fit.patches.surface.tobytes() + fit.off.tobytes()).hexdigest())
"""


def bits(result: Result) -> list[str]:
    """Return what tells two results apart, whatever the difference."""
    arrays = (
        result.T_world_camera,
        result.covariance,
        result.depth_map.heights,
        result.depth_map.sigma,
        np.array([i.cost for i in result.history]),
    )
    return [hashlib.sha256(array.tobytes()).hexdigest() for array in arrays]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_scene(tmp_path_factory.mktemp("repeat") / "scene", frames=3)


def test_runs_processes_and_threads_give_the_same_bits(scene: Dataset) -> None:
    result = depthba.register(scene, Options(threads=2, **OPTIONS))
    assert result.depth_map.shape[0] >= 2 * LEAST_ROWS
    here = bits(result)
    root = Path(__file__).resolve().parents[2]
    for linear_algebra, threads in (("1", ("1", "3")), ("2", ("1",))):
        other = {
            "PYTHONHASHSEED": "7", "PYTHONPATH": str(root), "OPENBLAS_NUM_THREADS": linear_algebra,
        }  # fmt: skip
        there = subprocess.run(
            [sys.executable, "-c", ELSEWHERE, str(scene.path), *threads],
            capture_output=True, text=True, env=os.environ | other, timeout=300, check=True,
        )  # fmt: skip
        found = [json.loads(line) for line in there.stdout.splitlines()]
        assert found == [here] * len(threads)


def test_kernels_from_the_disk_give_the_bits_of_those_that_were_just_compiled(
    tmp_path: Path,
) -> None:
    """Parts that were not one with their kernel came to run in the place of another's."""
    root = Path(__file__).resolve().parents[2]
    found = [
        subprocess.run(
            [sys.executable, "-c", COMPILED], capture_output=True, text=True, timeout=300,
            check=True,
            env=os.environ | {"PYTHONPATH": str(root), "NUMBA_CACHE_DIR": str(tmp_path)},
        ).stdout
        for _ in range(2)
    ]  # fmt: skip
    assert list(tmp_path.rglob("*.nbc")) and len(found[0]) > 60
    assert found[0] == found[1]


@pytest.mark.parametrize("name", PROBLEMS)
def test_answers_are_those_kept_for_this_version(name: str, tmp_path: Path) -> None:
    answers = kept()
    assert depthba.__version__ in answers, "no answers of this version are kept: `make golden`"
    expected = answers[depthba.__version__][name]
    answer, result = solve(name, tmp_path)
    assert answer["status"] == expected["status"], result.reason
    np.testing.assert_allclose(
        answer["moved_m_rad"], expected["moved_m_rad"], rtol=0, atol=TOLERANCE,
        err_msg="if the optimiser was meant to change: `make golden`, and say so in CHANGELOG.md",
    )  # fmt: skip
    assert answer["sigma_m"] == pytest.approx(expected["sigma_m"], abs=TOLERANCE)
