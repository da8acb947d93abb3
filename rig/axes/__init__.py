"""Linear axes, as of a gantry: one small interface, and the controllers behind it.

`rig.axes.modbus.ModbusGantry` and `rig.axes.grbl.GrblGantry` import their packages when they
connect, so that this package needs neither.
"""

from rig.axes.axes import Axes, AxesState, Axis
from rig.axes.finding import make
from rig.axes.grbl import GrblGantry, GrblOptions
from rig.axes.limits import check_speed, check_target
from rig.axes.modbus import ModbusGantry, ModbusOptions
from rig.axes.modbus_map import RegisterMap
from rig.axes.watching import Patience

__all__ = [
    "Axes",
    "AxesState",
    "Axis",
    "GrblGantry",
    "GrblOptions",
    "ModbusGantry",
    "ModbusOptions",
    "Patience",
    "RegisterMap",
    "check_speed",
    "check_target",
    "make",
]
