"""The process that owns a camera: ``python -m rig.cameras.apart_child``.

Vendors' libraries block, keep the interpreter from running anything else, and crash; here they can
be ended. Requests and answers are pickles over stdin and stdout, between this process and the one
that started it alone. It ends when its stdin closes.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import sys
import threading
from typing import Any

from depthba.errors import DepthbaError, MissingPackage
from rig.cameras.camera import CameraInfo, Capture, moment_of
from rig.cameras.finding import make
from rig.errors import CameraTimeout

_PARTING = 2.0
"""A camera may take so long to close once nobody wants it any more, s."""


class Owner:
    """The camera, once it is made."""

    def __init__(self) -> None:
        """Nothing is made yet."""
        self._camera: Any = None

    def open(self, kind: str, values: dict[str, Any]) -> CameraInfo:
        """Make it and start it."""
        self._camera = make(kind, values)
        found = self._camera.open()
        # A camera may bring classes of its own: the other side knows ours.
        known = [name for name in CameraInfo.__dataclass_fields__ if hasattr(found, name)]
        return CameraInfo(**{name: getattr(found, name) for name in known})

    def capture(self, timeout: float) -> Capture:
        """One frame."""
        found = self._camera.capture(timeout)
        truth = getattr(found, "T_world_camera_true", None)
        return Capture(found.depth, found.stamp, found.rgb, truth, moment_of(found.stamp))

    def close(self) -> None:
        """Let go of it."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None


def _answer(owner: Owner, request: tuple[str, tuple[Any, ...]]) -> tuple[str, Any]:
    do, arguments = request
    try:
        return "done", getattr(owner, do)(*arguments)
    except (CameraTimeout, TimeoutError) as error:
        return "timeout", " ".join(str(error).split())
    except MissingPackage as error:
        return "missing", str(error)
    except DepthbaError as error:
        return "error", str(error)
    except Exception as error:  # whatever a library throws is for the other side to judge
        return "error", f"{type(error).__name__}: {' '.join(str(error).split())}"


def main() -> None:
    """Serve until stdin closes."""
    # The parent hears of Ctrl-C too, and says what is to be done.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries print; their words must not get among the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def hear() -> None:
        while True:
            try:
                requests.put(pickle.load(sys.stdin.buffer))
            except (EOFError, OSError, pickle.UnpicklingError):
                break
        requests.put(None)
        threading.Event().wait(_PARTING)
        os._exit(0)

    threading.Thread(target=hear, daemon=True).start()
    owner = Owner()
    while (request := requests.get()) is not None:
        try:
            pickle.dump(_answer(owner, request), answers, protocol=5)
            answers.flush()
        except OSError:
            break  # nobody hears it any more
    _answer(owner, ("close", ()))
    os._exit(0)


if __name__ == "__main__":
    main()
