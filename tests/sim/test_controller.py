from __future__ import annotations

import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import numpy as np
import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from depthba import se3
from depthba.errors import OptionError
from depthba.kinematics import UR16E
from depthba.straight import straight
from sim.controller import protocol
from sim.controller.camera import SimulatedCamera
from sim.controller.motion import SPEED_LIMITS, JointPath, LinePath, Motion
from sim.controller.options import ControllerOptions
from sim.controller.protocol import Recipe, message, messages
from sim.controller.robot import pose_matrix, pose_vector
from sim.controller.surroundings import Surroundings
from sim.errors import NoAnswer, SimulationError
from sim.robots.ur16e import T_FLANGE_CAMERA
from tests.sim.controllers import BOXED, READY, ROOT, Running, address, boxed, controller, peer

pytest.importorskip("rtde_control")

GOAL = np.array([-1.6, -1.4, 1.5, -1.7, -1.5, 0.1])


@pytest.fixture(scope="module")
def bare() -> Iterator[Running]:
    with controller("--speed", "4", "--joint-offset", "0.001", "--seed", "3") as running:
        yield running


@pytest.fixture(scope="module")
def pillar() -> Iterator[Running]:
    with controller("--scene", BOXED, "--seed", "5") as running:
        yield running


# The unmodified client


def test_the_client_drives_the_arm_and_gets_its_own_kinematics(bare: Running) -> None:
    T_line = se3.retract(UR16E.forward(GOAL), [0.1, -0.05, 0.08, 0.1, 0.2, -0.1])
    found = peer("tour", bare.host, GOAL.tolist(), pose_vector(T_line).tolist())
    assert found["version"].startswith("URSoftware 5.15") or found["version"].startswith("5.15")
    assert found["serial"].isdigit() and found["remote"] and found["program"] is True
    assert found["safety"].endswith("NORMAL") and found["robotmode"].endswith("RUNNING")
    assert found["moved"] and found["lined"] and found["running"] and found["over"]
    assert found["joints"] == GOAL.tolist()
    np.testing.assert_allclose(pose_matrix(found["pose"]), UR16E.forward(GOAL), atol=1e-12)
    np.testing.assert_allclose(pose_matrix(found["line"]), T_line, atol=1e-9)
    # Stopped on its way, and on the way.
    way = [*GOAL[:5], GOAL[5] + 3.0] - np.array(found["from"])
    gone = np.subtract(found["stopped"], found["from"])
    assert found["steady"] and 0.01 < gone[5] / way[5] < 0.9
    np.testing.assert_allclose(gone, gone[5] / way[5] * way, atol=1e-9)
    assert found["tcp"] == [0, 0, 0.1, 0, 0, 0]
    tool = UR16E.forward(GOAL) @ se3.make(np.eye(3), [0, 0, 0.1])
    np.testing.assert_allclose(pose_matrix(found["forward"]), tool, atol=1e-12)
    np.testing.assert_allclose(found["inverse"], GOAL, atol=1e-8)
    assert found["allowed"] == [True, False, True, False]
    assert found["path"] and found["end"] == GOAL.tolist()
    # The truth is elsewhere than the encoders say, by as much as their zeros are off.
    truth = bare.truth()
    off = np.subtract(truth["encoders"], truth["joints"])
    assert truth["encoders"] == GOAL.tolist() and 1e-4 < np.abs(off).max() < 5e-3
    T_true = UR16E.forward(truth["joints"])
    np.testing.assert_allclose(truth["T_world_flange"], T_true, atol=1e-12)


def test_a_target_that_is_no_number_ends_the_program_one_beyond_a_limit_stops_the_arm(
    bare: Running,
) -> None:
    found = peer("mistakes", bare.host, READY)
    bare.fault("protective-stop", False)
    assert found == {
        "nan": False,
        "nan_stop": False,
        "again": True,
        "beyond": True,
        "refused": False,
    }


def test_an_arm_that_runs_into_something_stops_there(pillar: Running) -> None:
    pillar.channel.ask("place", joints=list(READY))
    found = peer("into", pillar.host, [READY[0] - 2.0, *READY[1:]])
    assert found["stopped"] and not found["moved"] and found["back"]
    assert READY[0] - 1.2 < found["joints"][0] < READY[0] - 0.3
    # At the pillar, and not in it.
    gap, names = Surroundings(boxed(0).compile(), UR16E)._clearance.nearest(
        np.array(found["joints"])
    )
    assert "pillar" in names and -0.001 < gap < 0.02


def test_many_at_once_each_on_its_own_address() -> None:
    goals = [(GOAL + 0.1 * k).tolist() for k in range(4)]
    with ExitStack() as stack, ThreadPoolExecutor(4) as threads:
        words = ("--speed", "10")
        start = [threads.submit(lambda: stack.enter_context(controller(*words))) for _ in goals]
        running = [one.result() for one in start]
        hosts = [one.host for one in running]
        assert len(set(hosts)) == 4
        found = list(threads.map(lambda h, g: peer("joints", h, g), hosts, goals))
        assert found == goals
        assert [one.truth()["encoders"] for one in running] == goals


# Sockets


def test_nothing_listens_but_on_loopback(bare: Running) -> None:
    listening = [
        c.laddr for c in psutil.Process(bare.process.pid).net_connections() if c.status == "LISTEN"
    ]
    assert {a.port for a in listening} >= {29999, 30003, 30004, 29990}
    assert {
        a.ip for a in psutil.Process(bare.process.pid).net_connections() for a in [a.laddr]
    } == {bare.host}
    for host in ("0.0.0.0", "192.168.56.101", "::1", "localhost", ""):
        with pytest.raises(OptionError, match="loopback"):
            ControllerOptions(host=host)


def test_the_verb_refuses_an_address_of_the_network_in_one_line() -> None:
    words = [sys.executable, "-m", "depthba", "simulate-controller", "--host", "0.0.0.0"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and done.stdout == ""
    assert "0.0.0.0" in done.stderr and done.stderr.count("\n") == 1


def test_signals_end_it_cleanly_and_its_ports_are_free_again() -> None:
    host = address()
    for number in (signal.SIGINT, signal.SIGTERM):
        with controller(host=host) as running:
            with socket.create_connection((host, 30004), 10.0) as client:
                client.sendall(message(protocol.VERSION, struct.pack(">H", 2)))
                assert client.recv(16)
                running.process.send_signal(number)
                assert running.process.wait(30) == 0
                assert client.recv(1) == b""
            with pytest.raises(SimulationError, match="expected a running"):
                running.truth()


def test_who_sends_rubbish_is_hung_up_on_and_nobody_else(bare: Running) -> None:
    with socket.create_connection((bare.host, 30004), 10.0) as client:
        for rubbish in (b"\x00\x01\x02", struct.pack(">HB", 5, 200) + b"ab"):
            with socket.create_connection((bare.host, 30004), 10.0) as other:
                other.sendall(rubbish)
                assert other.recv(1) == b""
        client.sendall(message(protocol.VERSION, struct.pack(">H", 2)))
        assert client.recv(16) == message(protocol.VERSION, b"\x01")
    with pytest.raises(SimulationError, match="choose from"):
        bare.channel.ask("dance")


def stamps(host: str, rate: float, count: int) -> np.ndarray:
    with socket.create_connection((host, 30004), 10.0) as client:
        client.settimeout(20.0)
        client.sendall(message(protocol.OUTPUTS, struct.pack(">d", rate) + b"timestamp"))
        client.sendall(message(protocol.START))
        found, buffer = [], bytearray()
        while len(found) < count:
            buffer += client.recv(4096)
            found += [
                struct.unpack(">d", content[1:])[0]
                for kind, content in messages(buffer)
                if kind == protocol.DATA
            ]
    return np.array(found[:count])


def test_packages_come_as_often_as_asked_for_and_allowed() -> None:
    with controller("--version", "3", "15", "8", "0") as running:
        # By the controller's own clock, so that a busy machine does not matter.
        assert np.diff(stamps(running.host, 500.0, 60)).mean() > 0.0075
        assert np.diff(stamps(running.host, 50.0, 20)).mean() > 0.019


# Protocol


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=40)), max_size=8), st.integers(1, 9)
)
def test_messages_come_out_whole_however_they_are_cut(
    sent: list[tuple[int, bytes]], cut: int
) -> None:
    data = b"".join(message(kind, content) for kind, content in sent)
    buffer, found = bytearray(), []
    for k in range(0, len(data), cut):
        buffer += data[k : k + cut]
        found += list(messages(buffer))
    assert found == sent and not buffer


def test_a_recipe_writes_what_it_reads_and_names_what_there_is_not() -> None:
    names = ("input_int_register_0", "input_double_register_7", "actual_q", "robot_mode")
    recipe = Recipe.of(names)
    values = {names[0]: -3, names[1]: 0.1, names[2]: [1.0] * 6, names[3]: 7}
    packed = recipe.pack(values)
    assert len(packed) == 4 + 8 + 48 + 4
    assert recipe.unpack(packed) == {names[0]: -3, names[1]: 0.1, names[3]: 7}
    assert not Recipe.of(("nonsense",)).valid
    assert Recipe.of(names, frozenset(names[:1])).described() == b"IN_USE,DOUBLE,VECTOR6D,INT32"
    with pytest.raises(SimulationError, match="63"):
        recipe.unpack(packed[:-1])


# Motion


def driven(motion: Motion, dt: float = 0.002) -> tuple[np.ndarray, np.ndarray]:
    q, qd, over = [], [], False
    while not over:
        joints, speeds, over = motion.advance(dt)
        q.append(joints)
        qd.append(speeds)
    return np.array(q), np.array(qd)


@pytest.mark.parametrize("speed", [0.1, 1.0, 30.0])
def test_joints_start_and_stop_within_their_acceleration(speed: float) -> None:
    start, dt = np.array(READY), 0.002
    q, qd = driven(Motion(JointPath(start, GOAL), speed, 2.0))
    assert q[-1].tolist() == GOAL.tolist() and not qd[-1].any()
    rate = np.diff(np.concatenate([[start], q]), axis=0) / dt
    assert np.abs(rate).max() <= speed + 1e-9
    assert (np.abs(rate) <= np.array(SPEED_LIMITS) + 1e-9).all()
    # A joint's acceleration is its share of the leading one's.
    jerkless = np.diff(rate, axis=0) / dt
    assert np.abs(jerkless).max() <= 2.0 + 1e-6
    np.testing.assert_allclose(qd[:-1], np.gradient(q, dt, axis=0)[:-1], atol=2.0 * dt)


def test_a_line_is_straight_and_a_brake_stays_on_it() -> None:
    start = np.array(READY)
    T = UR16E.forward(start)
    T_goal = se3.retract(T, [0.2, 0.1, -0.1, 0.2, -0.3, 0.4])
    line = straight(UR16E, start, T_goal)
    q, _ = driven(Motion(LinePath(line), 0.25, 1.2))
    places = UR16E.forward(q)[:, :3, 3] - T[:3, 3]
    way = T_goal[:3, 3] - T[:3, 3]
    along = places @ way / (way @ way)
    np.testing.assert_allclose(places, along[:, None] * way, atol=1e-6)
    turn = se3.log_so3(T[:3, :3].T @ T_goal[:3, :3])
    turned = se3.log_so3(T[:3, :3].T @ UR16E.forward(q)[:, :3, :3])
    np.testing.assert_allclose(turned, along[:, None] * turn, atol=1e-6)
    np.testing.assert_allclose(UR16E.forward(q[-1]), T_goal, atol=1e-9)
    braked = Motion(LinePath(line), 0.25, 1.2)
    for _ in range(300):
        joints, _, _ = braked.advance(0.002)
    braked.brake(3.0)
    rest, _ = driven(braked)
    # v^2 / 2a along the path, whose measure is the angle here.
    speed = 0.25
    stop = np.linalg.norm(UR16E.forward(rest[-1])[:3, 3] - UR16E.forward(joints)[:3, 3])
    share = np.linalg.norm(way) / max(line.length, line.angle)
    assert stop == pytest.approx(share * speed**2 / 6.0, rel=0.01)


def test_every_brake_comes_to_an_end() -> None:
    # Speeds and decelerations whose quotients do not come out even.
    rng = np.random.default_rng(0)
    for _ in range(300):
        motion = Motion(JointPath(np.array(READY), GOAL), rng.uniform(0.1, 2), rng.uniform(0.5, 4))
        motion.advance(rng.uniform(0.02, 0.2))
        motion.brake(rng.uniform(0.5, 8.0))
        for _ in range(2000):
            if motion.advance(rng.uniform(0.001, 0.01))[2]:
                break
        else:
            pytest.fail(f"{motion} never ends")


def test_looking_rarely_misses_nothing() -> None:
    model = boxed(0).compile()
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(12):
        goal = np.array(READY) + rng.uniform(-1.5, 1.5, 6)
        rare, always = Surroundings(model, UR16E), Surroundings(model, UR16E)
        for share in np.linspace(0.0, 1.0, 800):
            q = READY + share * (goal - READY)
            always._q = None
            met, expected = rare.met(q), always.met(q)
            assert (met is None) == (expected is None)
            if met is not None:
                hits += 1
                break
    assert 2 < hits < 12


# The camera


def test_the_camera_sees_the_scene_from_where_the_arm_truly_is(pillar: Running) -> None:
    X = se3.retract(T_FLANGE_CAMERA, [0.005, -0.004, 0.003, 0.01, -0.02, 0.03])
    camera = SimulatedCamera(
        pillar.host, sensor="zed2", size=(80, 45), T_flange_camera=X.tolist(), clean=True
    )
    with pytest.raises(SimulationError, match="open"):
        camera.capture(1.0)
    info = camera.open()
    for shift in (0.0, 0.3):
        q = np.add(READY, [shift, 0.0, 0.0, shift, 0.0, shift])
        pillar.channel.ask("place", joints=q.tolist())
        frame = camera.capture(20.0)
        np.testing.assert_array_equal(frame.joints_true, q)
        T_true = frame.T_world_camera_true
        np.testing.assert_allclose(T_true, UR16E.forward(q) @ X, atol=1e-12)
        points = info.camera.backproject(frame.depth) @ T_true[:3, :3].T + T_true[:3, 3]
        # All that is neither pillar nor arm is the floor, to half a count of the stored depth.
        pillar_x, pillar_y = np.abs(points[:, :2] - [0.36, 0.36]).T
        floor = (np.maximum(pillar_x, pillar_y) > 0.06) & (points[:, 2] < 0.05)
        floor &= np.linalg.norm(points[:, :2], axis=1) > 0.12
        assert floor.sum() > 1500
        np.testing.assert_allclose(points[floor, 2], 0.0, atol=1e-4)
        assert frame.rgb is not None and frame.rgb.shape == (45, 80, 3)
        assert frame.depth.dtype == np.float32
    camera.close()
    camera.close()


def test_noise_belongs_to_the_pose_and_to_how_often_it_was_taken(pillar: Running) -> None:
    pillar.channel.ask("place", joints=list(READY))
    frames = []
    for _ in range(2):
        camera = SimulatedCamera(pillar.host, sensor="zed2", size=(80, 45), rgb=False)
        camera.open()
        frames.append([camera.capture(20.0).depth for _ in range(2)])
        camera.close()
    for k in range(2):
        np.testing.assert_array_equal(frames[0][k], frames[1][k])
    assert not np.array_equal(*frames[0], equal_nan=True)


def test_a_blind_camera_says_so_in_time(pillar: Running) -> None:
    camera = SimulatedCamera(pillar.host, sensor="zed2", size=(80, 45), rgb=False)
    camera.open()
    pillar.fault("blind")
    with pytest.raises(NoAnswer, match="no answer"):
        camera.capture(0.2)
    pillar.fault("blind", False)
    assert np.isfinite(camera.capture(20.0).depth).any()
    camera.close()


def test_the_camera_says_what_it_lacks(bare: Running) -> None:
    with pytest.raises(SimulationError, match="no scene"):
        SimulatedCamera(bare.host).open()
    with pytest.raises(SimulationError, match="expected a running"):
        SimulatedCamera(address()).open()
    with pytest.raises(OptionError, match="rigid"):
        SimulatedCamera(bare.host, T_flange_camera=np.ones((4, 4)).tolist())
