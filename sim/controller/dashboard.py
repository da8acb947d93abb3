"""The dashboard server: one line asks, one line answers."""

from __future__ import annotations

from collections.abc import Callable

from sim.controller.robot import Robot, RobotMode, Runtime, SafetyMode

PORT = 29999
BANNER = "Connected: Universal Robots Dashboard Server"
SERIAL = "20225300001"

_NOT_ALLOWED = (
    "Command is not allowed due to safety reasons, please switch robot to Remote Control mode and"
    " reconnect to port 29999"
)
_LOCAL_ONLY = frozenset({"play", "stop", "pause", "power on", "power off", "brake release"})


def answer(line: str, robot: Robot, version: tuple[int, int, int, int]) -> str:
    """What the dashboard says to a line."""
    command = line.strip().lower()
    if command == "polyscopeversion":
        return f"URSoftware {'.'.join(map(str, version))} (Jun 01 2023)"
    if command in _LOCAL_ONLY and not robot.remote:
        return _NOT_ALLOWED
    if command not in _ANSWERS:
        return f"could not understand: '{line.strip()}'"
    return _ANSWERS[command](robot)


def _power_off(robot: Robot) -> str:
    robot.halt_program()
    robot.robot_mode = RobotMode.POWER_OFF
    return "Powering off"


def _power_on(robot: Robot) -> str:
    if robot.safety == SafetyMode.NORMAL:
        robot.robot_mode = RobotMode.RUNNING
    return "Powering on"


def _stop(robot: Robot) -> str:
    robot.halt_program()
    return "Stopped"


def _unlock(robot: Robot) -> str:
    if robot.safety != SafetyMode.PROTECTIVE_STOP:
        return "Failed to execute: unlock protective stop"
    robot.release()
    return "Protective stop releasing"


def _restart(robot: Robot) -> str:
    robot.release()
    return "Restarting safety"


_ANSWERS: dict[str, Callable[[Robot], str]] = {
    "get serial number": lambda robot: SERIAL,
    "get robot model": lambda robot: "UR16",
    "is in remote control": lambda robot: str(robot.remote).lower(),
    "robotmode": lambda robot: f"Robotmode: {robot.robot_mode.name}",
    "safetymode": lambda robot: f"Safetymode: {robot.safety.name}",
    "safetystatus": lambda robot: f"Safetystatus: {robot.safety.name}",
    "running": lambda robot: f"Program running: {str(robot.runtime == Runtime.PLAYING).lower()}",
    "programstate": lambda robot: f"{robot.runtime.name} <unnamed>",
    "play": lambda robot: "Failed to execute: play",
    "pause": lambda robot: "Failed to execute: pause",
    "stop": _stop,
    "power on": _power_on,
    "power off": _power_off,
    "brake release": lambda robot: "Brake releasing",
    "unlock protective stop": _unlock,
    "close safety popup": lambda robot: "closing safety popup",
    "restart safety": _restart,
}
