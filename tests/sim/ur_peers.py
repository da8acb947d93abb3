"""What the unmodified client library finds: ``python -m tests.sim.ur_peers NAME HOST ARGUMENTS``.

In a process of its own: some of the library's calls never return where a controller is wrong.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

from dashboard_client import DashboardClient
from rtde_control import Path, PathEntry, RTDEControlInterface
from rtde_receive import RTDEReceiveInterface


def tour(host: str, goal: list[float], line: list[float]) -> dict[str, Any]:
    """Most of what a session asks for; `goal` in joints, then a `line` to a pose."""
    dashboard = DashboardClient(host)
    dashboard.connect()
    found: dict[str, Any] = {
        "version": dashboard.polyscopeVersion(),
        "serial": dashboard.getSerialNumber(),
        "remote": dashboard.isInRemoteControl(),
        "safety": dashboard.safetystatus(),
        "robotmode": dashboard.robotmode(),
    }
    receive, control = RTDEReceiveInterface(host), RTDEControlInterface(host)
    found["program"] = dashboard.running()
    found["moved"] = control.moveJ(goal, 2.0, 4.0)
    found["joints"], found["pose"] = settled(receive), receive.getActualTCPPose()
    found["lined"] = control.moveL(line, 0.5, 2.0)
    found["from"] = settled(receive)
    found["line"] = receive.getActualTCPPose()
    # An asynchronous move, stopped on its way.
    control.moveJ([*goal[:5], goal[5] + 3.0], 0.5, 1.0, True)
    found["running"] = control.getAsyncOperationProgressEx().isAsyncOperationRunning()
    start = receive.getTimestamp()
    while receive.getTimestamp() < start + 0.4:
        time.sleep(0.001)
    control.stopJ(5.0)
    found["stopped"], found["steady"] = settled(receive), control.isSteady()
    found["over"] = not control.getAsyncOperationProgressEx().isAsyncOperationRunning()
    # What it computes.
    control.setTcp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    found["tcp"] = control.getTCPOffset()
    found["forward"] = control.getForwardKinematics(goal, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    found["inverse"] = control.getInverseKinematics(found["forward"], [q + 0.1 for q in goal])
    control.setTcp([0.0] * 6)
    found["allowed"] = [
        control.isJointsWithinSafetyLimits(goal),
        control.isJointsWithinSafetyLimits([7.0, *goal[1:]]),
        control.isPoseWithinSafetyLimits(line),
        control.isPoseWithinSafetyLimits([3.0, *line[1:]]),
    ]
    # A path of two legs.
    path = Path()
    for joints in ([*goal[:5], goal[5] + 0.2], goal):
        path.addEntry(
            PathEntry(PathEntry.MoveJ, PathEntry.PositionJoints, [*joints, 2.0, 4.0, 0.0])
        )
    found["path"], found["end"] = control.movePath(path), settled(receive)
    control.stopScript()
    control.disconnect()
    receive.disconnect()
    return found


def mistakes(host: str, goal: list[float]) -> dict[str, Any]:
    """What the library sends unchecked, and what becomes of it."""
    receive, control = RTDEReceiveInterface(host), RTDEControlInterface(host)
    control.moveJ([float("nan")] * 6, 1.0, 1.0)
    found = {"nan": control.isProgramRunning(), "nan_stop": receive.isProtectiveStopped()}
    found["again"] = revived(control) and control.moveJ(goal, 2.0, 4.0)
    control.moveJ([7.0, *goal[1:]], 1.0, 1.0)
    settled(receive)
    found["beyond"] = receive.isProtectiveStopped()
    found["refused"] = control.moveJ(goal, 2.0, 4.0)
    return found


def into(host: str, goal: list[float]) -> dict[str, Any]:
    """A move that something stands in the way of."""
    receive, control = RTDEReceiveInterface(host), RTDEControlInterface(host)
    moved = control.moveJ(goal, 1.0, 2.0)
    joints = settled(receive)
    stopped = receive.isProtectiveStopped()
    dashboard = DashboardClient(host)
    dashboard.connect()
    dashboard.unlockProtectiveStop()
    revived(control)
    # Back the way it came.
    back = control.moveJ([joints[0] + 0.3, *joints[1:]], 1.0, 2.0)
    return {"moved": moved, "stopped": stopped, "joints": joints, "back": back}


def joints(host: str, goal: list[float]) -> list[float]:
    """Where the arm is after a move."""
    receive, control = RTDEReceiveInterface(host), RTDEControlInterface(host)
    control.moveJ(goal, 2.0, 4.0)
    return settled(receive)


def revived(control: Any) -> bool:
    """Run the control script again; it takes a moment."""
    control.reuploadScript()
    for _ in range(2000):
        if control.isProgramRunning():
            return True
        time.sleep(0.001)
    return False


def settled(receive: Any) -> list[float]:
    """The joints of a package that came after this call."""
    start = receive.getTimestamp()
    while receive.getTimestamp() <= start + 0.005:
        time.sleep(0.001)
    return list(receive.getActualQ())


if __name__ == "__main__":
    print(json.dumps(globals()[sys.argv[1]](sys.argv[2], *json.loads(sys.argv[3]))), flush=True)
    # Interfaces that were left connected would be torn down in some order.
    os._exit(0)
