"""What only the Modbus gantry does, against a moving device behind pymodbus' own server."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace

import pytest

pytest.importorskip("pymodbus", reason="the extra rig is not installed")

from depthba.errors import OptionError
from rig.axes import Axis, ModbusGantry, ModbusOptions, Patience, RegisterMap, make
from rig.errors import AxesError
from tests.rig.axes_devices import AXES, DEVICES, NEAR, PATIENT, gantry
from tests.rig.peers import ROOT, ends_in_time, loopback, peer, silent_listener, unreachable

MODBUS = DEVICES[0]


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
            axes.move_to([0.79, 0.1], speed=0.1)
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
    with gantry(MODBUS) as axes:
        assert isinstance(axes, ModbusGantry)
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


def test_axes_are_made_from_plain_values() -> None:
    axes = [
        {"name": "x", "lower": 0, "upper": 0.795, "speed": 0.5},
        {"name": "y", "lower": 0, "upper": 0.595, "speed": 0.4},
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
