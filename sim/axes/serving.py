"""What simulated controllers that run as processes of their own share: how they start and end."""

from __future__ import annotations

import ipaddress
import os
import sys
from collections.abc import Callable
from typing import TypeVar

from depthba.errors import DepthbaError, OptionError

Options = TypeVar("Options")


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
