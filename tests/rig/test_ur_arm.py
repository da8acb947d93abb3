from __future__ import annotations

import dataclasses
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from depthba import se3
from depthba.errors import OptionError
from depthba.kinematics import UR16E
from rig.arms import Arm, Safety
from rig.arms.ur import UrArm, UrOptions
from rig.arms.ur_preflight import preflight
from rig.cameras import CameraInfo, Capture
from rig.errors import ArmError, EmergencyStop, ProtectiveStop
from sim.controller.camera import SimulatedCapture, SimulatedInfo
from tests.sim.controllers import BOXED, READY, ROOT, Running, address, controller

pytest.importorskip("rtde_control")

BOUND = 5.0
"""Each fault ends within that, s: the issue's figure."""

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


@contextmanager
def ends_in_time() -> Iterator[None]:
    begin = time.monotonic()
    yield
    assert time.monotonic() - begin < BOUND


def one_line(error: pytest.ExceptionInfo[ArmError]) -> str:
    text = str(error.value)
    assert "\n" not in text and "expected" in text
    return text


# What it does


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


# What goes wrong


def moved_while(arm: UrArm, happens: Callable[[], object]) -> pytest.ExceptionInfo[ArmError]:
    """The error of a move during which something happens."""
    begin: list[float] = []

    def strike() -> None:
        begin.append(time.monotonic())
        happens()

    timer = threading.Timer(0.3, strike)
    timer.start()
    with pytest.raises(ArmError) as error:
        arm.move_joints(np.add(READY, [2.5, 0, 0, 0, 0, 0]), speed=0.3, acceleration=1.0)
    assert time.monotonic() - begin[0] < BOUND
    timer.join()
    one_line(error)
    return error


def test_a_protective_stop_ends_the_move_and_holds_until_released(
    arm: UrArm, running: Running
) -> None:
    error = moved_while(arm, lambda: running.fault("protective-stop"))
    assert error.type is ProtectiveStop
    assert arm.state().safety is Safety.PROTECTIVE_STOP
    with ends_in_time(), pytest.raises(ProtectiveStop):
        arm.move_joints(READY, speed=0.5, acceleration=2.0)
    with ends_in_time(), pytest.raises(ProtectiveStop):
        UrArm(arm.options).connect()
    running.fault("protective-stop", False)
    # The control script is started anew by itself.
    assert arm.move_joints(READY, speed=0.5, acceleration=2.0).safety is Safety.NORMAL


def test_an_emergency_stop_too(arm: UrArm, running: Running) -> None:
    error = moved_while(arm, lambda: running.fault("emergency-stop"))
    assert error.type is EmergencyStop
    assert arm.state().safety is Safety.EMERGENCY_STOP
    with ends_in_time(), pytest.raises(EmergencyStop):
        UrArm(arm.options).connect()
    running.fault("emergency-stop", False)
    arm.move_joints(READY, speed=0.5, acceleration=2.0)


def test_local_mode_is_named(arm: UrArm, running: Running) -> None:
    assert "local mode" in str(moved_while(arm, lambda: running.fault("local")).value)
    assert not arm.state().remote
    with ends_in_time(), pytest.raises(ArmError, match=r"29999.*local mode") as error:
        UrArm(arm.options).connect()
    one_line(error)
    running.fault("local", False)
    arm.move_joints(READY, speed=0.5, acceleration=2.0)


def test_a_stalled_controller_is_noticed(arm: UrArm, running: Running) -> None:
    assert "no new data" in str(moved_while(arm, lambda: running.fault("stalled")).value)
    with ends_in_time(), pytest.raises(ArmError, match=r"30004.*says nothing") as error:
        arm.connect()
    one_line(error)
    running.fault("stalled", False)
    arm.connect()
    arm.move_joints(READY, speed=0.5, acceleration=2.0)


def test_a_dropped_connection_is_noticed_and_made_anew(arm: UrArm, running: Running) -> None:
    error = moved_while(arm, lambda: running.channel.ask("drop"))
    assert "closed the connection" in str(error.value)
    with pytest.raises(ArmError, match="not connected"):
        arm.state()
    arm.connect()
    arm.move_joints(READY, speed=1.0, acceleration=2.0)


def test_a_controller_that_is_killed_during_a_move() -> None:
    host = address()
    with controller(host=host) as running:
        arm = UrArm(UrOptions(host))
        arm.connect()
        moved_while(arm, lambda: running.process.send_signal(signal.SIGKILL))
        with ends_in_time(), pytest.raises(ArmError, match=r"30004.*refused") as error:
            arm.connect()
        one_line(error)
    with controller(host=host):
        arm.connect()
        arm.move_joints(READY, speed=1.0, acceleration=2.0)
        arm.disconnect()


def test_a_slow_controller_is_waited_for(arm: UrArm, running: Running) -> None:
    running.fault("slow")
    goal = np.add(READY, [0.1, 0, 0, 0, 0, 0])
    there = arm.move_joints(goal, speed=1.0, acceleration=4.0)
    np.testing.assert_array_equal(there.joints, goal)


def test_registers_in_use_are_named_and_the_upper_ones_free(arm: UrArm, running: Running) -> None:
    arm.disconnect()
    running.fault("registers-taken")
    with ends_in_time(), pytest.raises(ArmError, match=r"already in use.*upper_registers") as error:
        arm.connect()
    one_line(error)
    upper = UrArm(dataclasses.replace(arm.options, upper_registers=True))
    upper.connect()
    goal = np.add(READY, 0.05)
    np.testing.assert_array_equal(upper.move_joints(goal, speed=1.0, acceleration=4.0).joints, goal)
    upper.disconnect()


def test_a_handshake_without_data_is_named(arm: UrArm, running: Running) -> None:
    arm.disconnect()
    running.fault("no-data")
    with ends_in_time(), pytest.raises(ArmError, match=r"30004.*sends no data") as error:
        arm.connect()
    one_line(error)


@contextmanager
def listeners(host: str, *ports: int, backlog: int = 8) -> Iterator[list[socket.socket]]:
    """Ports that accept connections, by the system's queue, and say nothing."""
    opened = []
    try:
        for port in ports:
            listener = socket.socket()
            opened.append(listener)
            listener.bind((host, port))
            listener.listen(backlog)
        yield opened
    finally:
        for listener in opened:
            listener.close()


def test_who_is_not_there_refuses_or_keeps_silent_is_told_apart() -> None:
    host = address()

    def fails(says: str) -> None:
        with ends_in_time(), pytest.raises(ArmError, match=says) as error:
            UrArm(UrOptions(host)).connect()
        one_line(error)

    fails(rf"{host}:30004: connection refused")
    with listeners(host, 30004):
        fails(rf"{host}:30004: .*says nothing")
    # A queue that is full: the system answers no one any more, as if nobody were there.
    with listeners(host, 30004, backlog=0), socket.socket() as first, socket.socket() as second:
        for filler in (first, second):
            filler.setblocking(False)
            filler.connect_ex((host, 30004))
        time.sleep(0.2)
        fails(rf"{host}:30004: unreachable")


def test_each_port_is_tried(arm: UrArm, running: Running) -> None:
    """With a controller's RTDE in front of ports that are something else."""
    host = address()
    with listeners(host, 30004) as (rtde,):
        forward = threading.Thread(target=relay, args=(rtde, running.host), daemon=True)
        forward.start()
        with pytest.raises(ArmError, match=rf"{host}:30003: connection refused.*script port"):
            preflight(host, 2.0)
        with listeners(host, 30003), pytest.raises(ArmError, match=rf"{host}:29999.*dashboard"):
            preflight(host, 2.0)
        with (
            listeners(host, 30003, 29999),
            ends_in_time(),
            pytest.raises(ArmError, match=rf"{host}:29999.*says nothing.*banner"),
        ):
            preflight(host, 2.0)
        rtde.shutdown(socket.SHUT_RDWR)
        forward.join(20.0)
        assert not forward.is_alive()


def relay(listener: socket.socket, host: str) -> None:
    """Hand each connection's bytes to and from a controller's RTDE, until the listener closes."""
    while True:
        try:
            near, _ = listener.accept()
        except OSError:
            return
        with near, socket.create_connection((host, 30004), 10.0) as far:
            back = threading.Thread(target=pump, args=(far, near), daemon=True)
            back.start()
            pump(near, far)
            back.join()


def pump(source: socket.socket, sink: socket.socket) -> None:
    with suppress(OSError):
        while data := source.recv(4096):
            sink.sendall(data)
    for end in (source, sink):
        with suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)


# Processes


def test_a_client_that_hangs_is_ended_and_none_is_left(arm: UrArm) -> None:
    link = arm._link
    assert link is not None
    os.kill(link.pid, signal.SIGSTOP)
    with ends_in_time(), pytest.raises(ArmError, match="no answer") as error:
        arm.state()
    one_line(error)
    assert not psutil.pid_exists(link.pid)
    arm.connect()
    assert arm._link is not None
    pid = arm._link.pid
    arm.disconnect()
    assert not psutil.pid_exists(pid)


def test_an_arm_whose_program_is_killed_brakes(running: Running, arm: UrArm) -> None:
    arm.disconnect()
    with subprocess.Popen(
        [sys.executable, "-m", "tests.rig.ur_mover", running.host],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    ) as mover:
        assert mover.stdout is not None and mover.stdout.readline() == "connected\n"
        children = psutil.Process(mover.pid).children()
        deadline = time.monotonic() + 20.0
        while not running.truth()["moving"]:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        mover.kill()
        gone, alive = psutil.wait_procs(children, 20.0)
        for process in alive:
            process.kill()
        assert len(gone) == 1
    truth = running.truth()
    assert not truth["moving"] and truth["encoders"][0] < READY[0] + 2.0


# The simulated camera, as a rig's


def test_the_simulated_camera_has_what_a_rigs_camera_has() -> None:
    for ours, theirs in ((SimulatedInfo, CameraInfo), (SimulatedCapture, Capture)):
        names = {field.name for field in dataclasses.fields(ours)}
        assert {field.name for field in dataclasses.fields(theirs)} <= names
    with (ROOT / "pyproject.toml").open("rb") as file:
        entry = tomllib.load(file)["project"]["entry-points"]["depthba.cameras"]["simulated"]
    module, _, name = entry.partition(":")
    camera = getattr(import_module(module), name)
    assert all(callable(getattr(camera, method)) for method in ("open", "capture", "close"))


def test_a_move_through_the_scene_ends_in_a_protective_stop() -> None:
    with controller("--scene", BOXED) as running:
        arm = UrArm(UrOptions(running.host))
        arm.connect()
        with pytest.raises(ProtectiveStop):
            arm.move_joints(np.add(READY, [-2, 0, 0, 0, 0, 0]), speed=2.0, acceleration=4.0)
        arm.disconnect()
