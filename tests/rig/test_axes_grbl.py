"""What only the GRBL gantry does, against a simulated controller on a real pseudo-terminal."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("serial", reason="the extra rig is not installed")
if not hasattr(os, "openpty"):
    pytest.skip("no pseudo-terminals here", allow_module_level=True)

from rig.axes import Axis, GrblGantry, GrblOptions
from rig.axes.grbl_words import (
    HOMING,
    alarm_words,
    code_of,
    error_words,
    homing_time,
    parse_report,
)
from rig.errors import AxesError
from tests.rig.axes_devices import AXES, DEVICES, PATIENT, gantry
from tests.rig.peers import ends_in_time, peer

GRBL = DEVICES[1]
ORIGIN = (-0.8, -0.6)


@pytest.mark.parametrize("report", ["machine", "work"])
def test_moves_in_the_machines_frame_whatever_offset_was_left(report: str) -> None:
    with gantry(GRBL, "--report", report, home=False) as axes:
        assert axes.status().alarm == "locked until it is homed"
        # The switches are left by 4 mm.
        np.testing.assert_allclose(axes.home().position, 0.004, atol=1e-6)
        state = axes.move_to([0.7, 0.1], speed=0.4)
        np.testing.assert_allclose(state.position, [0.7, 0.1], atol=1e-4)
        axes.stop()
        # Held first, reset only then: the position is not lost.
        np.testing.assert_array_equal(axes.position(), state.position)


def test_the_controllers_own_limits_hold_where_ours_are_wrong() -> None:
    with gantry(GRBL) as axes:
        assert isinstance(axes, GrblGantry)
        wrong = GrblGantry(replace(axes._options, axes=(Axis("x", 0, 2, 1), AXES[1])))
        axes.disconnect()
        wrong.connect()
        wrong.home()
        with ends_in_time(), pytest.raises(AxesError, match=r"soft limit: .* \(ALARM:2\)"):
            wrong.move_to([1.0, 0.1], speed=0.1)
        wrong.home()
        wrong.move_to([0.1, 0.1], speed=0.4)
        wrong.disconnect()


def test_homing_that_stays_silent_ends_by_the_controllers_own_settings() -> None:
    mechanics = ("--mechanics.upper", "0.2", "0.1", "--mechanics.homing-speed", "2")
    words = (*mechanics, "--mechanics.creep-speed", "0.5", "--mute-homing")
    axes = (Axis("x", 0.0, 0.195, 0.5), Axis("y", 0.0, 0.095, 0.4))
    with peer("sim.axes.grbl_device", *words) as (_, port):
        found = GrblGantry(GrblOptions(port, axes, origin=(-0.2, -0.1), patience=PATIENT))
        found.connect()
        said = r"homing says nothing for 3\.\d+ s, longer than its travel and speed allow, and was"
        with ends_in_time(), pytest.raises(AxesError, match=said) as caught:
            found.home()
        assert "\n" not in str(caught.value)
        # It was reset: who connects anew finds no axes that still look for their switches.
        found.connect()
        state = found.status()
        assert not state.moving and state.alarm is not None
        found.disconnect()


def test_how_long_homing_may_take() -> None:
    # A metre and a half, 0.9 m, 0.2 m at 2 m/min: 1.5 times as far, then the switches anew.
    settings = {"$130": "1500.000", "$131": "900.000", "$132": "200.000"}
    settings |= {"$24": "100.000", "$25": "2000.000", "$27": "2.000"}
    assert homing_time(settings) == pytest.approx(1.2 * (1.5 * 2600 / 2000 + 0.6) * 60 + 3)
    assert homing_time({**settings, "$25": "0"}) == homing_time({}) == HOMING


def test_no_port_busy_silent_and_not_fit_for_it() -> None:
    options = GrblOptions("/dev/no-such-port", AXES, origin=ORIGIN)
    with ends_in_time(), pytest.raises(AxesError, match="cannot open the port: No such file"):
        GrblGantry(options).connect()
    ours, theirs = os.openpty()
    try:
        silent = GrblGantry(replace(options, port=os.ttyname(theirs), connect_timeout=1))
        with ends_in_time(), pytest.raises(AxesError, match="no greeting within 1 s"):
            silent.connect()
    finally:
        os.close(ours)
        os.close(theirs)
    with gantry(GRBL, home=False) as first:
        assert isinstance(first, GrblGantry)
        second = GrblGantry(first._options)
        with ends_in_time(), pytest.raises(AxesError, match="cannot open the port") as caught:
            second.connect()
        assert "\n" not in str(caught.value)
    unfit = pytest.raises(AxesError, match=r"\$22 is 0, expected 1: homing enabled")
    with unfit, gantry(GRBL, "--no-homing"):
        pass
    with pytest.raises(AxesError, match="axes u, expected some of x, y, z"):
        GrblGantry(replace(options, axes=(Axis("u", 0, 1, 1),), origin=None))
    with pytest.raises(AxesError, match="origin of 2 numbers, expected 1"):
        GrblGantry(replace(options, axes=AXES[:1]))


def test_reads_what_grbl_says() -> None:
    report = parse_report("<Hold:1|MPos:1.000,-2.500,0.000|Bf:15,128|FS:500,0|WCO:0.000,1.000,0.5>")
    assert report is not None
    assert report.moving
    assert report.blocked is None
    assert report.machine is not None
    assert report.offset is not None
    np.testing.assert_array_equal(report.machine, [1, -2.5, 0])
    np.testing.assert_array_equal(report.offset, [0, 1, 0.5])
    door = parse_report("<Door:2|WPos:0,0,0>")
    assert door is not None
    assert door.blocked == "the door is open"
    for line in ("ok", "<Idle>", "<Idle|FS:0,0>", "<Idle|MPos:0,x,0>", "<Idle|MPos:0,0", ""):
        assert parse_report(line) is None
    assert code_of("ALARM:3", "ALARM") == 3
    assert code_of("[MSG:ALARM:3]", "ALARM") is None
    assert error_words(99) == "unknown error (error:99)"
    assert alarm_words(3).endswith("(ALARM:3)")
