"""What can go wrong with hardware. Each is one line: who, what was found, what was expected."""

from depthba.errors import DepthbaError


class RigError(DepthbaError):
    """The rig cannot do what was asked of it, or answers in a way it should not."""


class ArmError(RigError):
    """The arm cannot be reached, refuses, or is not where it was sent."""


class Stopped(ArmError):
    """A safety stop holds the arm: a person must look at the robot before it moves on."""


class ProtectiveStop(Stopped):
    """The arm ran against something, or was asked for more than its limits allow."""


class EmergencyStop(Stopped):
    """Somebody pressed the button."""


class AxesError(RigError):
    """The gantry cannot be reached, refuses, or is not where it was sent."""


class CameraError(RigError):
    """The camera cannot be opened, or gives something that is no frame."""


class CameraTimeout(CameraError):
    """No frame came in time; a second try may succeed."""
