"""A session on a gantry: the simulated one over real sockets, with a camera that replays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from depthba.cli import main
from depthba.dataset import Dataset, verify
from rig.session.options import IDENTITY
from tests.rig.arm_scene import write_arm
from tests.rig.peers import loopback, peer
from tests.rig.sessions import frames

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
