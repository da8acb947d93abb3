"""MuJoCo without a screen: the one place where it is imported.

With MUJOCO_GL naming a library that is not there, importing mujoco itself fails. Nothing here
draws with OpenGL, so the variable is set to `disable` before the import.
"""

from __future__ import annotations

import os

os.environ["MUJOCO_GL"] = "disable"

try:
    import mujoco
except ImportError as error:  # pragma: no cover - only without the package
    from depthba.errors import MissingPackage

    raise MissingPackage(
        f"mujoco is not installed ({error}): pip install 'depthba[sim]'"
    ) from error

__all__ = ["mujoco"]
