"""`UrArm` when something goes wrong: it ends in time, in one clear line, and leaves nothing."""

from __future__ import annotations

import dataclasses
import json
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

import numpy as np
import psutil
import pytest

from rig.arms import Safety
from rig.arms.ur import UrArm, UrOptions
from rig.arms.ur_preflight import preflight
from rig.cameras import CameraInfo, Capture
from rig.errors import ArmError, EmergencyStop, ProtectiveStop
from sim.controller.camera import SimulatedCapture, SimulatedInfo
from tests.rig.peers import LONGEST, ends_in_time, one_line
from tests.sim.controllers import BOXED, READY, ROOT, Running, address, controller

pytest.importorskip("rtde_control")


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
    assert time.monotonic() - begin[0] < LONGEST
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
    released(arm)
    # The control script is started anew by itself.
    assert arm.move_joints(READY, speed=0.5, acceleration=2.0).safety is Safety.NORMAL


def released(arm: UrArm) -> None:
    """Wait until the arm's own stream tells of the release, which a loaded machine delays."""
    until = time.monotonic() + LONGEST
    while arm.state().safety is not Safety.NORMAL and time.monotonic() < until:
        time.sleep(0.01)


def test_an_emergency_stop_too(arm: UrArm, running: Running) -> None:
    error = moved_while(arm, lambda: running.fault("emergency-stop"))
    assert error.type is EmergencyStop
    assert arm.state().safety is Safety.EMERGENCY_STOP
    with ends_in_time(), pytest.raises(EmergencyStop):
        UrArm(arm.options).connect()
    running.fault("emergency-stop", False)
    released(arm)
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
        running.process.wait()  # its ports are closed from here on
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


def test_an_arm_whose_program_dies_before_it_is_answered_brakes(
    running: Running, arm: UrArm
) -> None:
    arm.disconnect()
    with subprocess.Popen(
        [sys.executable, "-m", "rig.arms.ur_child"],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as child:
        assert child.stdin is not None and child.stdout is not None

        def ask(number: int, do: str, **arguments: object) -> None:
            assert child.stdin is not None
            request = {"number": number, "do": do, "limit": 60.0, "arguments": arguments}
            child.stdin.write(json.dumps(request) + "\n")
            child.stdin.flush()

        ask(0, "connect", host=running.host, frequency=125.0, upper_registers=False)
        assert json.loads(child.stdout.readline())["value"]
        goal = np.add(READY, [2.5, 0, 0, 0, 0, 0]).tolist()
        child.stdout.close()
        ask(1, "move_joints", joints=goal, speed=0.3, acceleration=1.0)
        assert child.wait(20.0) == 0
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
