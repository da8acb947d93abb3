"""A session on a gantry: the simulated one over real sockets, with a camera that replays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import yaml

from depthba import se3
from depthba.cli import main
from depthba.dataset import Dataset, verify
from rig.session.options import IDENTITY
from tests.rig.arm_scene import write_arm
from tests.rig.peers import loopback, peer
from tests.rig.sessions import frames
from tests.sim.controllers import BOXED

pytest.importorskip("pymodbus")


def test_a_gantry_takes_its_frames_and_an_alarm_ends_the_session(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = write_arm(tmp_path / "recorded", frames=4)
    mount = np.diag([1.0, -1.0, -1.0, 1.0])
    mount[2, 3] = -0.1
    base = np.array(IDENTITY)
    base[2, 3] = 1.0

    def session(where: str) -> Path:
        host, _, port = where.rpartition(":")
        axes = [
            {"name": "x", "lower": 0.0, "upper": 0.8, "speed": 1.0},
            {"name": "y", "lower": 0.0, "upper": 0.6, "speed": 1.0},
        ]
        content = {
            "rig": {
                "kind": "modbus",
                "options": {"host": host, "port": int(port), "axes": axes},
                "directions": [[0, 2, 0], [1, 0, 0]],
            },
            "camera": {"kind": "folder", "options": {"path": str(recorded.path), "loop": True}},
            "hand_eye": mount.tolist(),
            "T_world_base": base.tolist(),
            "poses": [{"steps": {"first": [0.1, 0.2], "last": [0.3, 0.4], "counts": [2, 2]}}],
            "motion": {"settle": 0.05, "speed": 0.5},
            "limits": {"camera": [-0.1, 0.7, -0.1, 0.9, 0.8, 1.0]},
            "frames": {"holes": 1.0, "at_limits": 1.0},
        }
        path = tmp_path / f"{port}.yaml"
        path.write_text(yaml.safe_dump(content))
        return path

    device = "sim.axes.modbus_device"
    words = ["--host", loopback(), "--port", "0", "--rate", "5"]
    with peer(device, *words) as (_, where):
        out = tmp_path / "out"
        assert main(["capture", str(session(where)), "--out", str(out)]) == 0
    assert verify(out) == []
    dataset = Dataset.open(out)
    wanted = {(0.1, 0.2), (0.3, 0.2), (0.3, 0.4), (0.1, 0.4)}
    for frame in dataset:
        assert frame.joints is not None
        x, y = frame.joints
        assert (round(float(x), 4), round(float(y), 4)) in wanted
        wanted.remove((round(float(x), 4), round(float(y), 4)))
        # The first axis leads along base y, the second along x; the camera hangs 10 cm below.
        np.testing.assert_allclose(frame.T_world_camera[:3, 3], [y, x, 0.9], atol=1e-9)
    assert not wanted
    fault = ["--mechanics.fault.kind", "alarm", "--mechanics.fault.move", "2"]
    with peer(device, *words, *fault) as (_, where):
        out = tmp_path / "alarm"
        assert main(["capture", str(session(where)), "--out", str(out)]) == 1
    assert "limit switch" in capsys.readouterr().err
    assert verify(out) == [] and len(frames(out)) == 1


@pytest.mark.parametrize("kind", ["modbus", "grbl"])
def test_a_gantry_is_rehearsed_in_a_scene(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    # Looking straight down from 15 cm below the carriage.
    mount, base = np.diag([1.0, -1.0, -1.0, 1.0]), np.eye(4)
    mount[2, 3], base[:3, 3] = -0.15, [-0.2, 0.3, 1.0]
    axes = [
        {"name": "x", "lower": 0.0, "upper": 0.4, "speed": 1.0},
        {"name": "y", "lower": 0.0, "upper": 0.5, "speed": 1.0},
    ]
    options = {"host": "192.168.1.9"} if kind == "modbus" else {"port": "/dev/none"}
    content: dict[str, Any] = {
        "rig": {"kind": kind, "options": {**options, "axes": axes}},
        "camera": {"kind": "folder", "options": {"path": "none"}, "timeout": 10},
        "hand_eye": mount.tolist(),
        "T_world_base": base.tolist(),
        "poses": [{"steps": {"first": [0.1, 0.1], "last": [0.3, 0.2], "counts": [2, 2]}}],
        "motion": {"settle": 0.1, "speed": 0.5},
        "limits": {"camera": [-0.3, 0.3, 0.2, 0.9, 0.8, 0.9]},
        "frames": {"holes": 1.0, "at_limits": 1.0},
        "rehearsal": {"scene": BOXED, "sensor": "zed2", "size": [64, 36], "mounting_t": 0.004},
    }
    path, out = tmp_path / "s.yaml", tmp_path / "out"
    path.write_text(yaml.safe_dump(content))
    words = ["capture", str(path), "--out", str(out), "--rehearse", "--speed", "10"]
    assert main(words) == 0
    assert verify(out) == []
    dataset = Dataset.open(out)
    assert len(dataset) == 4
    measured = np.array([frame.T_world_camera for frame in dataset])
    true = dataset.T_world_camera_true
    assert true is not None
    for frame, T in zip(dataset, measured, strict=True):
        assert frame.joints is not None
        x, y = frame.joints
        np.testing.assert_allclose(T[:3, 3], [x - 0.2, y + 0.3, 0.85], atol=1e-9)
    # What is wrong is how the camera is mounted: the same in all frames.
    off = se3.inverse(measured) @ true
    np.testing.assert_allclose(off, np.broadcast_to(off[0], off.shape), atol=2e-5)
    assert np.linalg.norm(off[0, :3, 3]) == pytest.approx(0.004, abs=2e-5)
    turned = np.linalg.norm(se3.log_so3(off[0, :3, :3]))
    assert np.degrees(turned) == pytest.approx(0.3, abs=1e-6)
    # A scene lies below, and the frames differ.
    depths = [frame.depth() for frame in dataset]
    assert all(np.nanmedian(depth) < 0.9 for depth in depths)
    assert main(words) == 0
    assert "4 of 4 frames, 0 of them now" in capsys.readouterr().out
    left = [child.cmdline() for child in psutil.Process().children(recursive=True)]
    assert not any("sim.axes" in " ".join(words) for words in left)
