"""Known errors of the simulator."""

from __future__ import annotations

from depthba.errors import DepthbaError


class SimulationError(DepthbaError):
    """A scene, a sensor or a stage is unknown, or a scene cannot be built; names the choices."""


class NoAnswer(SimulationError, TimeoutError):
    """Something simulated did not answer in time; a second try may succeed."""
