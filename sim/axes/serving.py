"""What simulated controllers that run as processes of their own share: how they start and end."""

from __future__ import annotations

import ipaddress
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import TypeVar

from depthba.errors import DepthbaError, OptionError

Options = TypeVar("Options")

_LOOK = 0.5
"""Between two looks whether the parent is still there, s."""


def check_loopback(host: str) -> None:
    """Refuse an address that others than this machine could reach. Raises OptionError."""
    try:
        loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise OptionError(
            f"host {host!r}, expected a loopback address, 127.0.0.1 to 127.255.255.254"
        )


def end_abruptly() -> None:
    """End this process as a power cut would: nothing is said to the client, nothing cleaned up."""
    os._exit(1)


def end_with_parent() -> None:
    """End this process as soon as the one that started it is gone."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        end_abruptly()

    threading.Thread(target=watch, daemon=True).start()


def run(kind: type[Options], serve: Callable[[Options], None]) -> None:
    """Parse the command line into options and serve; a known error is one line and status 1."""
    import tyro

    options = tyro.cli(kind)
    try:
        serve(options)
    except KeyboardInterrupt:
        pass
    except DepthbaError as error:
        print(error, file=sys.stderr)
        raise SystemExit(1) from None
