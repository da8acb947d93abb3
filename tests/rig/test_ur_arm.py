"""`UrArm` against a simulated controller: where it goes, and what never leaves for it."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from depthba import se3
from depthba.errors import OptionError
from depthba.kinematics import UR16E
from rig.arms import Arm, Safety
from rig.arms.ur import UrArm, UrOptions
from rig.errors import ArmError
from tests.rig.peers import ends_in_time, one_line
from tests.sim.controllers import READY, Running

pytest.importorskip("rtde_control")


def test_moves_arrive_where_our_own_kinematics_say(arm: UrArm, running: Running) -> None:
    interface: Arm = arm
    goal = np.add(READY, [0.3, 0.1, -0.2, 0.1, 0.2, -0.4])
    there = interface.move_joints(goal, speed=1.5, acceleration=3.0)
    np.testing.assert_array_equal(there.joints, goal)
    assert there.safety is Safety.NORMAL and there.remote and not there.velocities.any()
    T_goal = se3.retract(there.T_base_flange, [-0.1, 0.08, 0.05, 0.1, -0.2, 0.3])
    there = interface.move_linear(T_goal, speed=0.5, acceleration=2.0)
    np.testing.assert_allclose(there.T_base_flange, T_goal, atol=1e-9)
    # The simulation has it there too, by the kinematics of the same arm, which are not the
    # published ones.
    np.testing.assert_allclose(running.truth()["T_world_flange"], T_goal, atol=1e-9)
    assert np.abs(UR16E.forward(there.joints) - T_goal)[:3, 3].max() > 1e-3
    assert arm.warnings == []
    assert arm.greeting is not None and arm.greeting.serial.isdigit()


def test_without_a_calibration_it_says_so(running: Running) -> None:
    arm = UrArm(UrOptions(running.host))
    assert arm.dh == UR16E and "calibration.conf" in arm.warnings[0]
    with pytest.raises(OptionError, match="no-such"):
        UrArm(UrOptions(running.host, calibration=Path("no-such.conf")))


def test_a_state_is_one_instant(arm: UrArm) -> None:
    states: list[Any] = []
    start = np.array(READY)
    mover = threading.Thread(
        target=arm.move_joints,
        args=(np.add(start, [0.8, 0.4, 0, 0, 0, 0]),),
        kwargs={"speed": 0.5, "acceleration": 2.0},
    )
    mover.start()
    while mover.is_alive():
        states.append(arm.state())
    mover.join()
    q = np.array([s.joints for s in states])
    moving = np.abs(np.array([s.velocities[0] for s in states]) - 0.5) < 1e-9
    stamps = np.array([s.stamp for s in states])
    assert moving.sum() > 20 and (np.diff(stamps) > 0).all()
    # At constant speed, joints and stamp of a state that did not belong together would not lie on
    # one line: a package is 8 ms, or 4 mrad.
    t, x = stamps[moving], q[moving, 0]
    np.testing.assert_allclose(x - x[0], 0.5 * (t - t[0]), atol=1e-9)
    np.testing.assert_allclose(q[:, 1] - start[1], 0.5 * (q[:, 0] - start[0]), atol=1e-9)
    for state in states[::10]:
        np.testing.assert_array_equal(state.T_base_flange, arm.dh.forward(state.joints))


def test_another_thread_stops_a_move(arm: UrArm) -> None:
    timer = threading.Timer(0.4, arm.stop)
    timer.start()
    with pytest.raises(ArmError, match="stopped"):
        arm.move_joints(np.add(READY, [2, 0, 0, 0, 0, 0]), speed=0.5, acceleration=2.0)
    timer.join()
    rest = arm.state()
    assert not rest.velocities.any() and 0.005 < rest.joints[0] - READY[0] < 1.5
    # And goes on afterwards.
    arm.move_joints(READY, speed=1.0, acceleration=2.0)
    with pytest.raises(ArmError, match="not connected"):
        UrArm(arm.options).state()
    UrArm(arm.options).stop()


@pytest.mark.parametrize(
    ("target", "says"),
    [
        ([np.nan, *READY[1:]], "finite"),
        (READY[:5], "5 numbers"),
        ([7.0, *READY[1:]], "shoulder_pan_joint 7.0000"),
        ([*READY[:2], -3.2, *READY[3:]], "elbow_joint -3.2000"),
        (["left"] * 6, "joints in rad"),
    ],
)
def test_no_bad_joints_leave_for_the_robot(arm: UrArm, target: list[float], says: str) -> None:
    with ends_in_time(), pytest.raises(ArmError, match=says) as error:
        arm.move_joints(target, speed=0.5, acceleration=2.0)
    one_line(error)
    np.testing.assert_array_equal(arm.state().joints, READY)


def test_no_bad_pose_or_speed_leaves_for_the_robot(arm: UrArm, running: Running) -> None:
    T = arm.state().T_base_flange
    far = se3.retract(T, [0, 1.5, 0, 0, 0, 0])
    inside = se3.make(T[:3, :3], [0.0, 0.03, 0.3])
    for bad, says in ((far, "straight line"), (inside, "straight line"), (np.nan * T, "rigid")):
        with ends_in_time(), pytest.raises(ArmError, match=says) as error:
            arm.move_linear(bad, speed=0.2, acceleration=1.0)
        one_line(error)
    for speed, acceleration in ((0.0, 1.0), (np.nan, 1.0), (9.0, 1.0), (0.5, -1.0)):
        with pytest.raises(ArmError, match=r"speed|acceleration"):
            arm.move_joints(READY, speed=speed, acceleration=acceleration)
    assert running.truth()["encoders"] == list(READY) and running.truth()["safety"] == "NORMAL"
