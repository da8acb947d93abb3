"""The arm that the tests of `UrArm` drive, over real sockets."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rig.arms.ur import UrArm, UrOptions
from tests.sim.controllers import READY, Running, controller

CALIBRATION = """[mount]
# of no arm that there is
delta_theta = [ 1.1e-03, -2.0e-03, 1.5e-03, -4.0e-04, 2e-05, 0.0 ]
delta_a = [ 2.0e-04, -1.1e-03, 8.0e-04, 3.0e-05, -2.0e-05, 0 ]
delta_d = [ 1.0e-04, 4.0e-03, -3.0e-03, -1.0e-03, 4.0e-05, -2.0e-04 ]
delta_alpha = [ 5.0e-04, -1.3e-03, 9.0e-04, 2.0e-04, -1.0e-04, 0 ]
joint_checksum = [ 0x1, 0x2, 0x3, 0x4, 0x5, 0x6 ]
"""


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "calibration.conf"
    path.write_text(CALIBRATION)
    return path


@pytest.fixture(scope="module")
def running(calibration: Path) -> Iterator[Running]:
    with controller("--calibration", str(calibration)) as running:
        yield running


@pytest.fixture
def arm(running: Running, calibration: Path) -> Iterator[UrArm]:
    """Connected, in its place, nothing wrong."""
    for fault in running.channel.ask("about")["faults"]:
        running.fault(fault, False)
    running.channel.ask("refuse", on=False)
    running.channel.ask("place", joints=list(READY))
    arm = UrArm(UrOptions(running.host, calibration=calibration))
    arm.connect()
    yield arm
    arm.disconnect()
    arm.disconnect()
