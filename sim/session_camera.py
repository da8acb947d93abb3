"""The simulated camera as capture sessions take cameras: the entry point ``simulated``."""

from __future__ import annotations

from dataclasses import dataclass

from sim.controller.camera import SimulatedCamera, SimulatedCapture, SimulatedInfo
from sim.controller.options import CONTROL_PORT

Row = tuple[float, float, float, float]


@dataclass(frozen=True)
class SimulatedOptions:
    """See `SimulatedCamera`."""

    host: str = "127.0.0.2"
    """Address of the running `depthba simulate-controller`; a rehearsal fills it in."""
    control_port: int = CONTROL_PORT
    sensor: str | None = None
    """As `depthba generate` takes it. None: the scene's."""
    size: tuple[int, int] | None = None
    """Width and height, pixels. None: the sensor's."""
    T_flange_camera: tuple[Row, Row, Row, Row] | None = None
    """Where the camera truly sits. None: where the model of the arm has it."""
    seed: int = 0
    """Of the noise."""
    clean: bool = False
    """Leave all noise out."""
    rgb: bool = True


class SessionCamera:
    """A `SimulatedCamera` made from its options."""

    Options = SimulatedOptions

    def __init__(self, options: SimulatedOptions):
        self._camera = SimulatedCamera(
            host=options.host,
            control_port=options.control_port,
            sensor=options.sensor,
            size=options.size,
            T_flange_camera=options.T_flange_camera,
            seed=options.seed,
            clean=options.clean,
            rgb=options.rgb,
        )

    def open(self) -> SimulatedInfo:
        """Build the scene that the controller's arm stands in."""
        return self._camera.open()

    def capture(self, timeout: float) -> SimulatedCapture:
        """A frame from where the arm is now."""
        return self._camera.capture(timeout)

    def close(self) -> None:
        """Hang up."""
        self._camera.close()
