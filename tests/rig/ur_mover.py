"""Starts a long move and waits to be killed: ``python -m tests.rig.ur_mover HOST``."""

from __future__ import annotations

import sys

import numpy as np

from rig.arms.ur import UrArm, UrOptions
from tests.sim.controllers import READY

if __name__ == "__main__":
    arm = UrArm(UrOptions(sys.argv[1]))
    arm.connect()
    print("connected", flush=True)
    arm.move_joints(np.add(READY, [2.5, 0, 0, 0, 0, 0]), speed=0.3, acceleration=1.0)
