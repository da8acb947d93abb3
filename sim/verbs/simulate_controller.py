"""The verb `simulate-controller`: a UR16e without the robot, for rehearsals and tests."""

from __future__ import annotations

import signal
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import tyro

from depthba.verbs import DONE
from depthba.verbs.output import note, print_json
from sim.controller.options import ControllerOptions

if TYPE_CHECKING:
    from types import FrameType


@dataclass(frozen=True)
class Arguments:
    """Run a simulated UR16e and its controller, which any client of a real one can connect to.

    It serves this machine only, on the real one's ports, until it is interrupted or terminated.
    """

    json: bool = False
    """Once ready, print one JSON object on stdout in place of text: host, ports, scene, seed, pid,
    seconds."""
    options: Annotated[ControllerOptions, tyro.conf.arg(name="")] = field(
        default_factory=ControllerOptions
    )


def run(arguments: Arguments) -> int:
    """Serve until a signal comes; return the exit status."""
    options, begin = arguments.options, time.perf_counter()
    from sim.controller.machine import Machine
    from sim.controller.server import Server

    server = Server(Machine(options))

    def end(number: int, frame: FrameType | None) -> None:
        server.end()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    seconds = time.perf_counter() - begin
    ports = {"rtde": 30004, "script": 30003, "dashboard": 29999, "control": options.control_port}
    if arguments.json:
        about = server.machine.about()
        print_json({"host": options.host, "ports": ports, **about, "seconds": seconds})
    else:
        listed = ", ".join(f"{name} {port}" for name, port in ports.items())
        where = "nothing around it" if options.scene is None else options.scene
        print(f"UR16e at {options.host} ({listed}), {where}, ready in {seconds:.1f} s", flush=True)
    try:
        server.serve(lambda line: note(f"{options.host}: {line}"))
    finally:
        server.close()
    return DONE
