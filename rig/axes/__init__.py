"""Linear axes, as of a gantry: one small interface, and the controllers behind it."""

from rig.axes.axes import Axes, AxesState, Axis

__all__ = ["Axes", "AxesState", "Axis"]
