"""Optional packages of the extra ``convert``, imported when they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from depthba.errors import MissingPackage


def package(name: str, what: str) -> Any:  # a module without types
    """Import a package; `MissingPackage` says what brings it.

    Args:
        name: import name.
        what: what needs it, such as "E57".

    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise MissingPackage(
            f"{what} needs {error.name}, which is not installed: pip install 'depthba[convert]'"
        ) from error
