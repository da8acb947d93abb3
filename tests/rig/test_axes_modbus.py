"""The Modbus gantry against a moving device behind pymodbus' own server, over real sockets."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("pymodbus", reason="the extra rig is not installed")

from depthba.errors import OptionError
from rig.axes import Axes, Axis, ModbusGantry, ModbusOptions, Patience, RegisterMap, make
from rig.errors import AxesError
from tests.rig.peers import ROOT, ends_in_time, loopback, peer, silent_listener, unreachable

AXES = (Axis("x", 0.0, 0.8, 0.5), Axis("y", 0.0, 0.6, 0.4))
PATIENT = Patience(stall=1.0, settle=1.0)
NEAR = ("--mechanics.parked", "0.03", "0.02")
"""Close to the switches, so that homing takes little."""
FAST = (*NEAR, "--rate", "8", "--watchdog", "20")


@contextmanager
def gantry(*words: str, home: bool = True) -> Iterator[ModbusGantry]:
    words = ("--host", loopback(), "--port", "0", *(words or FAST))
    with peer("sim.axes.modbus_device", *words) as (_, where):
        host, port = where.split(":")
        options = ModbusOptions(host, AXES, port=int(port), patience=PATIENT, reply_timeout=2.0)
        found = ModbusGantry(options)
        found.connect()
        if home:
            found.home()
        try:
            yield found
        finally:
            found.disconnect()


def fault(kind: str) -> tuple[str, ...]:
    return (*FAST, "--mechanics.fault.kind", kind)


def test_homes_moves_stops_and_comes_back() -> None:
    with gantry(home=False) as axes:
        _: Axes = axes
        before = axes.status()
        assert not before.homed
        assert before.alarm is None
        with pytest.raises(AxesError, match="not homed, expected home"):
            axes.move_to([0.1, 0.1], speed=0.2)
        homed = axes.home()
        assert homed.homed
        np.testing.assert_allclose(homed.position, 0, atol=1e-6)
        # the second is shorter than its ramps, the third goes nowhere
        for target in ([0.7, 0.1], [0.7, 0.1001], [0.7, 0.1001], [0.0, 0.6]):
            state = axes.move_to(target, speed=0.4)
            assert not state.moving
            np.testing.assert_allclose(state.position, target, atol=1e-4)
            assert abs(state.stamp - time.time()) < 60
        # another client, as after a crash, finds it as it is
        axes.disconnect()
        axes.disconnect()
        with pytest.raises(AxesError, match="not connected"):
            axes.status()
        axes.connect()
        np.testing.assert_allclose(axes.position(), [0.0, 0.6], atol=1e-4)
        axes.move_to([0.1, 0.5], speed=0.4)


def test_moves_in_a_straight_line_and_brakes_when_told() -> None:
    with gantry("--watchdog", "20", *NEAR) as axes:
        seen: list[np.ndarray] = []
        told = threading.Event()

        def watch() -> None:
            while not told.is_set():
                seen.append(axes.position())
                if seen[-1][0] > 0.1:
                    axes.stop()
                    told.set()

        watcher = threading.Thread(target=watch)
        watcher.start()
        with pytest.raises(AxesError, match=r"stopped on request at x 0\.\d+ m, y"):
            axes.move_to([0.6, 0.3], speed=0.3)
        watcher.join()
        for place in seen:
            assert place[1] == pytest.approx(place[0] / 2, abs=3e-6)
        assert all(b[0] >= a[0] for a, b in pairwise(seen))
        time.sleep(0.3)  # braking from 0.3 m/s at 2 m/s^2 takes half of it
        rest = axes.status()
        assert not rest.moving
        assert rest.homed
        assert seen[-1][0] <= rest.position[0] < 0.5
        axes.move_to([0.2, 0.1], speed=0.4)


def test_refuses_targets_before_they_leave() -> None:
    with gantry() as axes:
        for target, speed, words in (
            ([np.nan, 0.1], 0.1, "axis x is nan, expected a finite"),
            ([0.1, np.inf], 0.1, "axis y is inf, expected a finite"),
            ([0.1, 0.6001], 0.1, "axis y is 0.6001 m, expected 0 m to 0.6 m"),
            ([-1e-6, 0.1], 0.1, "axis x is -1e-06 m, expected 0 m to 0.8 m"),
            ([0.1], 0.1, r"shape \(1,\), expected \(2,\): x, y"),
            (["a", "b"], 0.1, "expected 2 numbers"),
            ([0.1, 0.1], 0.0, "speed 0 m/s, expected above 0"),
            ([0.1, 0.1], 0.45, r"at most 0.4 m/s \(axis y\)"),
            ([0.1, 0.1], float("nan"), "speed nan m/s"),
        ):
            with ends_in_time(), pytest.raises(AxesError, match=words):
                axes.move_to(target, speed=speed)
        np.testing.assert_allclose(axes.position(), 0, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("stall", r"stuck: no nearer for 1 s at x 0\.[0-3]\d* m"),
        ("alarm", r"alarm during the move: limit switch \(code 2\), at x"),
        ("silent", "no answer for .* within 2 s"),
        ("drop", "the connection was lost"),
    ],
)
def test_faults_of_a_move_end_in_one_line(
    kind: str, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with gantry(*fault(kind)) as axes:
        with ends_in_time(), pytest.raises(AxesError, match=words) as caught:
            axes.move_to([0.4, 0.4], speed=0.4)
        assert "\n" not in str(caught.value)
        if kind in ("stall", "alarm"):
            assert not axes.status().moving
            axes.home()
            axes.move_to([0.1, 0.1], speed=0.4)
        else:
            with ends_in_time(), pytest.raises(AxesError, match="not connected"):
                axes.status()
            axes.stop()  # never raises
    assert "pymodbus" not in capfd.readouterr().err


def test_homing_that_finds_no_switch() -> None:
    with (
        gantry(*fault("no-switch"), home=False) as axes,
        ends_in_time(),
        pytest.raises(AxesError, match="alarm while homing: reference switch not found"),
    ):
        axes.home()


def test_nobody_there_refused_and_silent() -> None:
    options = ModbusOptions(loopback(), AXES, connect_timeout=1.0)
    with socket.create_server((loopback(), 0)) as server:
        closed = server.getsockname()[1]
    with (
        ends_in_time(),
        pytest.raises(AxesError, match="the connection is refused, expected a Mod"),
    ):
        ModbusGantry(replace(options, port=closed)).connect()
    for place, words in (
        (unreachable, "nobody answers within 1 s"),
        (silent_listener, "no answer"),
    ):
        with place() as (host, port):
            axes = ModbusGantry(replace(options, host=host, port=port))
            with ends_in_time(), pytest.raises(AxesError, match=words):
                axes.connect()
            axes.disconnect()


def test_a_frozen_controller_and_a_client_that_dies() -> None:
    """The link is up, but nobody is behind it: each side ends the move by itself."""
    words = ("--host", loopback(), "--port", "0", "--watchdog", "1.5", *NEAR)
    with peer("sim.axes.modbus_device", *words) as (process, where):
        host, port = where.split(":")
        axes = ModbusGantry(ModbusOptions(host, AXES, port=int(port), patience=PATIENT))
        axes.connect()
        axes.home()
        threading.Timer(0.3, lambda: os.kill(process.pid, signal.SIGSTOP)).start()
        with ends_in_time(), pytest.raises(AxesError, match="no answer"):
            axes.move_to([0.8, 0.1], speed=0.1)
        time.sleep(1)
        os.kill(process.pid, signal.SIGCONT)
        axes.connect()
        state = axes.status()
        assert not state.moving
        assert state.alarm is not None
        assert "no client for too long" in state.alarm
        assert state.position[0] < 0.4


def test_another_map_and_a_controller_without_it() -> None:
    with pytest.raises(AxesError, match="1 targets, expected 2"):
        ModbusGantry(ModbusOptions("127.0.0.1", AXES, registers=RegisterMap(targets=(4,))))
    with pytest.raises(AxesError, match="spans 907 registers, expected at most 125"):
        ModbusGantry(ModbusOptions("127.0.0.1", AXES, registers=RegisterMap(positions=(4, 905))))
    with pytest.raises(AxesError, match="expected lower below upper"):
        ModbusGantry(ModbusOptions("127.0.0.1", (Axis("x", 1, 0, 1),)))
    with gantry() as axes:
        options = axes._options
        other = ModbusGantry(replace(options, registers=RegisterMap(positions=(60, 62))))
        with ends_in_time(), pytest.raises(AxesError, match="refuses registers 0 to 63"):
            other.connect()
        other.disconnect()
        # words in the other order
        axes.move_to([0.1, 0.0], speed=0.4)
        swapped = ModbusGantry(replace(options, registers=RegisterMap(word_order="little")))
        swapped.connect()
        assert abs(swapped.position()[0]) > 1000  # 0.1 m comes out as that
        swapped.disconnect()


def test_ctrl_c_brakes() -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        pytest.skip("signals come to the main thread alone")
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with gantry("--watchdog", "20", *NEAR) as axes:
            signal.setitimer(signal.ITIMER_REAL, 0.3)
            with pytest.raises(KeyboardInterrupt):
                axes.move_to([0.8, 0.6], speed=0.1)
            time.sleep(0.2)
            state = axes.status()
            assert not state.moving
            assert state.position[0] < 0.8
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_axes_are_made_from_plain_values() -> None:
    axes = [
        {"name": "x", "lower": 0, "upper": 0.8, "speed": 0.5},
        {"name": "y", "lower": 0, "upper": 0.6, "speed": 0.4},
    ]
    values = {"host": "127.0.0.1", "axes": axes, "patience": {"stall": 2}}
    made = make("modbus", values)
    assert isinstance(made, ModbusGantry)
    assert made._options == ModbusOptions("127.0.0.1", AXES, patience=Patience(stall=2.0))
    assert make("grbl", {"port": "/dev/x", "axes": axes}).axes == AXES
    for name, changed, words in (
        ("plc", {}, "unknown axes 'plc'; choose from: grbl, modbus"),
        ("modbus", {"speed": 1}, "axes 'modbus': unknown option 'speed'; choose from: axes, conn"),
        (
            "modbus",
            {"axes": [{"name": "x"}]},
            r"axes 'modbus': axes\[0\]: option 'lower' is missing",
        ),
        ("modbus", {"port": "high"}, "option 'port' is 'high', expected int"),
        ("modbus", {"registers": {"word_order": "odd"}}, "registers: option 'word_order' is 'odd'"),
    ):
        with pytest.raises(OptionError, match=words):
            make(name, values | changed)


def test_the_device_listens_on_loopback_only() -> None:
    from sim.axes.serving import check_loopback

    check_loopback("127.3.4.5")
    for host in ("0.0.0.0", "192.168.1.4", "localhost", "", "::"):
        with pytest.raises(OptionError, match="expected a loopback address"):
            check_loopback(host)
    ended = subprocess.run(
        [sys.executable, "-m", "sim.axes.modbus_device", "--host", "0.0.0.0"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr.startswith("host '0.0.0.0', expected a loopback address")
    assert ended.stderr.count("\n") == 1
