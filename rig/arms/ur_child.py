"""The process that owns the client library: ``python -m rig.arms.ur_child``.

The library's constructors and some of its calls may block for ever and keep the interpreter from
running anything else, so they live in a process of their own that can be ended. It reads requests
from stdin and answers on stdout, one JSON object a line. When either closes, it brakes the arm and
ends; what hangs is ended from within by a timer that needs no interpreter.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any

DECELERATION = 3.0
"""Of a stop, rad/s^2."""

_LEAVING = 3.0
"""Nothing that is done at the end may take longer, s."""


class Client:
    """The library's two interfaces."""

    def __init__(self) -> None:
        """Nothing is reached yet."""
        self._receive: Any = None
        self._control: Any = None

    def connect(self, host: str, frequency: float, upper_registers: bool) -> bool:
        """Construct both interfaces; the control script runs then."""
        from rtde_control import RTDEControlInterface
        from rtde_receive import RTDEReceiveInterface

        flags = RTDEControlInterface.FLAG_UPLOAD_SCRIPT
        if upper_registers:
            flags |= RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS
        self._receive = RTDEReceiveInterface(host, frequency, [], False, upper_registers)
        self._control = RTDEControlInterface(host, frequency, flags)
        return True

    def state(self) -> dict[str, Any]:
        """One instant, all of one package."""
        receive = self._receive
        for _ in range(50):
            stamp = receive.getTimestamp()
            found = {
                "stamp": stamp,
                "joints": receive.getActualQ(),
                "velocities": receive.getActualQd(),
                "safety": receive.getSafetyStatusBits(),
                "mode": receive.getRobotMode(),
                "runtime": receive.getRuntimeState(),
            }
            if receive.getTimestamp() == stamp:
                break
        else:
            raise RuntimeError("no two readings of one instant")
        connected = receive.isConnected() and self._control.isConnected()
        found["connected"] = connected
        # The two interfaces have a connection each, and need not know of a start at one time.
        found["obeying"] = connected and self._control.isProgramRunning()
        found["busy"] = connected and (
            self._control.getAsyncOperationProgressEx().isAsyncOperationRunning()
        )
        return found

    def move_joints(self, joints: list[float], speed: float, acceleration: float) -> bool:
        """Start a move in the joints; False: refused."""
        return bool(self._control.moveJ(joints, speed, acceleration, True))

    def move_line(self, joints: list[float], speed: float, acceleration: float) -> bool:
        """Start a straight move of the tool that ends in these joints; False: refused."""
        return bool(self._control.moveL_FK(joints, speed, acceleration, True))

    def stop(self) -> bool:
        """Brake; returns once the arm stands."""
        self._control.stopJ(DECELERATION)
        return True

    def revive(self) -> bool:
        """Send the control script again where it was ended; it starts a moment later."""
        return bool(self._control.reuploadScript())

    def leave(self) -> bool:
        """Brake if need be and end the script; the end of the process hangs up."""
        control = self._control
        if control is not None and control.isConnected() and control.isProgramRunning():
            control.stopJ(DECELERATION)
            control.stopScript()
        return True


@contextlib.contextmanager
def _ended_after(seconds: float) -> Iterator[None]:
    """End this process if the block takes longer, whatever holds the interpreter; inf: never."""
    if seconds == float("inf"):
        yield
        return
    with open(os.devnull, "w") as nowhere:
        faulthandler.dump_traceback_later(seconds, exit=True, file=nowhere)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()


def main() -> None:
    """Serve until stdin closes."""
    # The parent hears of Ctrl-C too, and says what is to be done.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The library prints; its words must not get among the answers.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    client = Client()
    doers: dict[str, Callable[..., Any]] = {
        "connect": client.connect,
        "state": client.state,
        "move_joints": client.move_joints,
        "move_line": client.move_line,
        "stop": client.stop,
        "revive": client.revive,
        "leave": client.leave,
    }
    for line in sys.stdin:
        request = json.loads(line)
        answer: dict[str, Any] = {"number": request["number"]}
        try:
            # Readings are taken a hundred times a second, and wait for nobody.
            limit = float("inf") if request["do"] == "state" else request["limit"]
            with _ended_after(limit):
                answer["value"] = doers[request["do"]](**request["arguments"])
        except Exception as error:  # whatever the library throws is for the parent to judge
            answer["error"] = " ".join(str(error).split())
        try:
            print(json.dumps(answer), file=answers, flush=True)
        except OSError:  # who asked died while it was done: the arm may move all the same
            break
    # Nobody is there to be told any more, whatever the library throws.
    with contextlib.suppress(Exception), _ended_after(_LEAVING):
        client.leave()
    # The library's destructors may wait for threads that never end.
    os._exit(0)


if __name__ == "__main__":
    main()
