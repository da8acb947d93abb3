"""RTDE, the real-time data exchange of Universal Robots' controllers, as the controller speaks it.

A message is its size and its kind (``>HB``) and what they announce, big-endian. A client says which
variables it wants and how often, which it will set, and then both stream packages of values.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from sim.errors import SimulationError

PORT = 30004
HEADER = struct.Struct(">HB")

VERSION, CONTROLLER_VERSION = ord("V"), ord("v")
OUTPUTS, INPUTS, DATA = ord("O"), ord("I"), ord("U")
START, PAUSE = ord("S"), ord("P")

Value = float | int | Sequence[float] | Sequence[int]

_FORMATS = {
    "DOUBLE": "d",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
    "UINT8": "B",
    "BOOL": "?",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}

_TYPES = {
    name: kind
    for kind, names in {
        "DOUBLE": """timestamp actual_execution_time speed_scaling target_speed_fraction
            actual_momentum actual_main_voltage actual_robot_voltage actual_robot_current
            standard_analog_input0 standard_analog_input1 standard_analog_output0
            standard_analog_output1 payload speed_slider_fraction""",
        "INT32": "robot_mode safety_mode",
        "UINT32": "runtime_state robot_status_bits safety_status_bits speed_slider_mask",
        "UINT64": "actual_digital_input_bits actual_digital_output_bits",
        "VECTOR3D": "actual_tool_accelerometer payload_cog",
        "VECTOR6D": """target_q target_qd target_qdd target_current target_moment actual_q actual_qd
            actual_current joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force
            target_TCP_pose target_TCP_speed joint_temperatures actual_joint_voltage ft_raw_wrench
            payload_inertia actual_current_as_torque external_force_torque""",
        "VECTOR6INT32": "joint_mode",
    }.items()
    for name in names.split()
}
_TYPES |= {
    f"{way}_{kind}_register_{k}": {"int": "INT32", "double": "DOUBLE"}[kind]
    for way in ("input", "output")
    for kind in ("int", "double")
    for k in range(48)
}

_LARGEST = 4096
"""Bytes of the values of one recipe: all variables of a kind together have fewer."""

NOT_FOUND, IN_USE = "NOT_FOUND", "IN_USE"


def message(kind: int, content: bytes = b"") -> bytes:
    """A whole message."""
    return HEADER.pack(len(content) + HEADER.size, kind) + content


def messages(buffer: bytearray) -> Iterator[tuple[int, bytes]]:
    """Take the whole messages out of a buffer: kind and content. SimulationError: not RTDE."""
    while len(buffer) >= HEADER.size:
        size, kind = HEADER.unpack_from(buffer)
        if size < HEADER.size:
            raise SimulationError(
                f"RTDE: a message of {size} bytes, expected {HEADER.size} or more"
            )
        if len(buffer) < size:
            return
        content = bytes(buffer[HEADER.size : size])
        del buffer[:size]
        yield kind, content


def names_in(content: bytes) -> tuple[str, ...]:
    """The variables of a comma-separated list."""
    return tuple(name for name in content.decode("latin1").split(",") if name)


@dataclass(frozen=True)
class Recipe:
    """Variables that travel together."""

    names: tuple[str, ...]
    types: tuple[str, ...]
    """Of each; NOT_FOUND where there is none of that name, IN_USE where it is taken."""
    layout: struct.Struct
    counts: tuple[int, ...]
    """How many numbers each variable has."""

    @classmethod
    def of(cls, names: Sequence[str], taken: frozenset[str] = frozenset()) -> Recipe:
        """Look the variables up."""
        types = tuple(IN_USE if n in taken else _TYPES.get(n, NOT_FOUND) for n in names)
        layout = struct.Struct(">" + "".join(_FORMATS.get(t, "") for t in types))
        counts = tuple(int(_FORMATS.get(t, "")[:-1] or 1) for t in types)
        if layout.size > _LARGEST:
            raise SimulationError(
                f"RTDE: {len(names)} variables of {layout.size} bytes, expected {_LARGEST} at most"
            )
        return cls(tuple(names), types, layout, counts)

    @property
    def valid(self) -> bool:
        """Whether all its variables can be had."""
        return not {NOT_FOUND, IN_USE} & set(self.types)

    def described(self) -> bytes:
        """Its types, as the answer to a client has them."""
        return ",".join(self.types).encode()

    def pack(self, values: Mapping[str, Value]) -> bytes:
        """Write the values; what is not in the mapping is 0."""
        flat: list[float] = []
        for name, count in zip(self.names, self.counts, strict=True):
            value = values.get(name)
            if value is None:
                flat.extend([0] * count)
            elif isinstance(value, int | float):
                flat.append(value)
            else:
                flat.extend(value)
        return self.layout.pack(*flat)

    def unpack(self, content: bytes) -> dict[str, float]:
        """Read the values; only variables of one number. SimulationError: another size."""
        if len(content) != self.layout.size:
            raise SimulationError(
                f"RTDE: a package of {len(content)} bytes, expected {self.layout.size}"
            )
        values = self.layout.unpack(content)
        found, at = {}, 0
        for name, count in zip(self.names, self.counts, strict=True):
            if count == 1:
                found[name] = values[at]
            at += count
        return found
