"""Rehearsals: a session and its simulated rig in one command, killed at any moment."""

from __future__ import annotations

import json
import random
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from depthba import se3
from depthba.cli import main
from depthba.dataset import Dataset, verify
from depthba.trajectory import read_tum
from sim.robots.ur16e import T_FLANGE_CAMERA
from tests.rig.sessions import (
    HAND_EYE,
    ROOT,
    SESSION,
    STATIONS,
    but_for_stamps,
    command,
    finished,
    frames,
    write,
)

pytest.importorskip("rtde_control")

SPEED = ("--rehearse", "--speed", "10")


def descendants(pid: int) -> list[psutil.Process]:
    try:
        return psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def gone(processes: list[psutil.Process], seconds: float = 20.0) -> None:
    """Wait until they have ended; of an orphan its new parent may be slow to take notice."""
    _, there = psutil.wait_procs(processes, timeout=seconds)
    assert not [p for p in there if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]


def killed_after(path: Path, out: Path, seconds: float) -> None:
    """Run a rehearsal, and kill the session's process so long after its start."""
    process = command(path, "--out", out, *SPEED)
    try:
        time.sleep(seconds)
        children = descendants(process.pid)
    finally:
        process.kill()
        finished(process)
    # Nobody ends them any more: they do it themselves.
    gone(children)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, float]:
    """A session's file, the dataset of its rehearsal, and how long that took."""
    folder = tmp_path_factory.mktemp("rehearsal")
    path, out, begin = write(folder / "s.yaml"), folder / "out", time.monotonic()
    process = command(path, "--out", out, *SPEED, "--json")
    listening: set[str] = set()
    children: dict[int, psutil.Process] = {}
    while process.poll() is None:
        for child in [psutil.Process(process.pid), *descendants(process.pid)]:
            children[child.pid] = child
            try:
                sockets = child.net_connections("inet")
            except psutil.Error:
                continue
            listening |= {s.laddr.ip for s in sockets if s.status == psutil.CONN_LISTEN}
        time.sleep(0.2)
    status, printed, error = finished(process)
    seconds = time.monotonic() - begin
    assert status == 0, error
    summary = json.loads(printed)
    assert summary["complete"] and summary["frames"] == summary["taken"] == 3
    assert summary["skipped"] == [] and summary["seconds"] < seconds
    assert listening and all(ip.startswith("127.") for ip in listening)
    gone([child for pid, child in children.items() if pid != process.pid], 10.0)
    return path, out, seconds


def test_a_rehearsal_brings_truth_joints_and_what_was_believed(
    undisturbed: tuple[Path, Path, float],
) -> None:
    _, out, _ = undisturbed
    assert verify(out) == []
    dataset = Dataset.open(out)
    _, truth = read_tum(out / "poses_true.txt")
    X = np.array(HAND_EYE)
    assert dataset.T_flange_camera is not None
    np.testing.assert_allclose(dataset.T_flange_camera, X)
    for frame, T_true in zip(dataset, truth, strict=True):
        assert frame.joints is not None and frame.T_base_flange is not None
        np.testing.assert_allclose(frame.joints, STATIONS[frame.id], atol=1e-9)
        np.testing.assert_allclose(frame.T_world_camera, frame.T_base_flange @ X, atol=1e-8)
        np.testing.assert_allclose(T_true, frame.T_base_flange @ T_FLANGE_CAMERA, atol=1e-8)
        assert frame.rgb() is not None and np.isfinite(frame.depth()).mean() > 0.5
        assert abs(frame.stamp - time.time()) < 3600.0
    T = np.array([frame.T_world_camera for frame in dataset])
    assert 0.003 < np.linalg.norm(se3.difference(T, truth)[:, :3], axis=1).max() < 0.02


def test_a_session_that_is_done_is_left_alone(
    undisturbed: tuple[Path, Path, float], capsys: pytest.CaptureFixture[str]
) -> None:
    path, out, _ = undisturbed
    before = but_for_stamps(out)
    # Without the rehearsal it is another rig, and refused before anything is reached.
    assert main(["capture", str(path), "--out", str(out)]) == 1
    assert "rehearsal: {" in capsys.readouterr().err
    assert but_for_stamps(out) == before


def test_killed_at_random_moments_it_goes_on_to_the_same_dataset(
    tmp_path: Path, undisturbed: tuple[Path, Path, float]
) -> None:
    path, expected, seconds = undisturbed
    rng, out = random.Random(), tmp_path / "out"
    # Not before it has begun; later and later, so that frames come together between the kills.
    for share in (0.4, 0.6, 0.8):
        killed_after(path, out, seconds * rng.uniform(share, share + 0.2))
    status, _, error = finished(command(path, "--out", out, *SPEED))
    assert status == 0, error
    assert but_for_stamps(out) == but_for_stamps(expected)


@pytest.mark.slow
@pytest.mark.parametrize("moment", range(30))
def test_killed_at_any_moment_it_goes_on_to_the_same_dataset(
    tmp_path: Path, undisturbed: tuple[Path, Path, float], moment: int
) -> None:
    path, expected, seconds = undisturbed
    out = tmp_path / "out"
    killed_after(path, out, seconds * (moment + random.random()) / 30)
    committed = len(frames(out))
    if (out / "dataset.json").exists():
        assert verify(out) == []
    status, printed, error = finished(command(path, "--out", out, *SPEED, "--json"))
    assert status == 0, error
    assert json.loads(printed)["taken"] == 3 - committed
    assert but_for_stamps(out) == but_for_stamps(expected)


@pytest.mark.slow
def test_four_rehearsals_run_side_by_side(
    tmp_path: Path, undisturbed: tuple[Path, Path, float]
) -> None:
    path, expected, _ = undisturbed
    outs = [tmp_path / f"out-{k}" for k in range(4)]
    processes = [command(path, "--out", out, *SPEED) for out in outs]
    for process, out in zip(processes, outs, strict=True):
        status, _, error = finished(process)
        assert status == 0, error
        found, wanted = but_for_stamps(out), but_for_stamps(expected)
        assert found == wanted


@pytest.mark.slow
def test_from_a_hand_eye_transform_that_is_wrong_the_dataset_registers(tmp_path: Path) -> None:
    import yaml

    content = yaml.safe_load((ROOT / "docs" / "sessions" / "simulated.yaml").read_text())
    taught = ROOT / "docs" / "sessions" / "lab_1.txt"
    content["poses"][0]["taught"]["file"] = str(taught)
    path, out, run = tmp_path / "s.yaml", tmp_path / "out", tmp_path / "run"
    path.write_text(yaml.safe_dump(content))
    status, _, error = finished(command(path, "--out", out, *SPEED))
    assert status == 0, error
    assert len(Dataset.open(out)) == 20
    assert np.allclose(content["hand_eye"], SESSION["hand_eye"])
    off = se3.difference(np.array(HAND_EYE), T_FLANGE_CAMERA)
    assert np.linalg.norm(off[:3]) == pytest.approx(0.005, rel=0.01)
    assert np.degrees(np.linalg.norm(off[3:])) == pytest.approx(0.5, rel=0.01)
    assert main(["register", str(out), "--out", str(run)]) in (0, 3)
    assert main(["evaluate", str(run)]) == 0
    metrics = json.loads((run / "metrics.json").read_text())
    for name in ("translation_mae", "rotation_mae"):
        before, after = metrics["start"][name]["value"], metrics["metrics"][name]["value"]
        assert after < 0.5 * before, (name, before, after)
