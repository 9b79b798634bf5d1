"""RTDE version 2, the controller's side: packets, types and recipes.

Source: Universal Robots' documentation of the Real-Time Data Exchange. All numbers are big-endian; a packet is its size
(uint16, header included), its kind (uint8) and a payload.
"""

import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass

HEADER = struct.Struct(">HB")

PROTOCOL_VERSION, CONTROLLER_VERSION = ord("V"), ord("v")
OUTPUTS, INPUTS, START, PAUSE, DATA = ord("O"), ord("I"), ord("S"), ord("P"), ord("U")

N_REGISTERS = 48
FORMATS = {
    "DOUBLE": "d",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}
Value = float | int | tuple[float, ...]


def _register_types(direction: str) -> dict[str, str]:
    return {
        f"{direction}_{kind}_register_{index}": "INT32" if kind == "int" else "DOUBLE"
        for kind in ("int", "double")
        for index in range(N_REGISTERS)
    }


OUTPUT_TYPES = {
    **dict.fromkeys(
        (
            *("target_q", "target_qd", "target_qdd", "target_current", "target_moment", "actual_q", "actual_qd"),
            *("actual_current", "actual_current_as_torque", "joint_control_output", "actual_TCP_pose"),
            *("actual_TCP_speed", "actual_TCP_force", "target_TCP_pose", "target_TCP_speed", "joint_temperatures"),
            *("actual_joint_voltage", "ft_raw_wrench", "payload_inertia"),
        ),
        "VECTOR6D",
    ),
    **dict.fromkeys(("actual_tool_accelerometer", "payload_cog"), "VECTOR3D"),
    **dict.fromkeys(
        (
            *("timestamp", "actual_execution_time", "speed_scaling", "target_speed_fraction", "actual_momentum"),
            *("actual_main_voltage", "actual_robot_voltage", "actual_robot_current", "payload"),
            *("standard_analog_input0", "standard_analog_input1", "standard_analog_output0", "standard_analog_output1"),
        ),
        "DOUBLE",
    ),
    **dict.fromkeys(("actual_digital_input_bits", "actual_digital_output_bits"), "UINT64"),
    **dict.fromkeys(("robot_mode", "safety_mode"), "INT32"),
    **dict.fromkeys(("runtime_state", "robot_status_bits", "safety_status_bits"), "UINT32"),
    "joint_mode": "VECTOR6INT32",
    **_register_types("output"),
}
INPUT_TYPES = {"external_force_torque": "VECTOR6D", **_register_types("input")}


@dataclass(frozen=True)
class Recipe:
    """Named variables in the order in which a packet holds them."""

    names: tuple[str, ...]
    types: tuple[str, ...]

    @classmethod
    def parse(cls, text: bytes, known: dict[str, str]) -> "Recipe":
        """Make a recipe of a request's names; an unknown one gets the type NOT_FOUND."""
        names = tuple(name for name in text.decode("ascii").split(",") if name)
        return cls(names, tuple(known.get(name, "NOT_FOUND") for name in names))

    @property
    def is_known(self) -> bool:
        """Whether every variable exists."""
        return "NOT_FOUND" not in self.types

    @property
    def layout(self) -> struct.Struct:
        """The layout of the values in a packet."""
        return struct.Struct(">" + "".join(FORMATS[each] for each in self.types))

    def reply(self, recipe_id: int) -> bytes:
        """The answer's payload."""
        return bytes([recipe_id]) + ",".join(self.types).encode("ascii")

    def unpack(self, payload: bytes) -> dict[str, Value]:
        """Values by name. Raises `struct.error` where the length is wrong."""
        flat = iter(self.layout.unpack(payload))
        return {name: _take(flat, kind) for name, kind in zip(self.names, self.types, strict=True)}

    def pack(self, values: dict[str, Value]) -> bytes:
        """A packet's payload. Variables without a value are zero."""
        flat: list[float | int] = []
        for name, kind in zip(self.names, self.types, strict=True):
            value = values.get(name)
            if kind.startswith("VECTOR"):
                assert value is None or isinstance(value, tuple)
                flat.extend(value or (0,) * _length(kind))
            else:
                assert not isinstance(value, tuple)
                flat.append(value or 0)
        return self.layout.pack(*flat)


def _length(kind: str) -> int:
    return int(kind.removeprefix("VECTOR")[0])


def _take(flat: Iterator[float | int], kind: str) -> Value:
    if not kind.startswith("VECTOR"):
        return next(flat)
    return tuple(next(flat) for _ in range(_length(kind)))


def packet(kind: int, payload: bytes) -> bytes:
    """A whole packet."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def read_packets(connection: socket.socket) -> Iterator[tuple[int, bytes]]:
    """Kind and payload of each packet until the other side closes or sends what cannot be a packet."""
    stream = connection.makefile("rb")
    while len(header := stream.read(HEADER.size)) == HEADER.size:
        size, kind = HEADER.unpack(header)
        payload = stream.read(size - HEADER.size) if size >= HEADER.size else b""
        if size < HEADER.size or len(payload) < size - HEADER.size:
            return
        yield kind, payload
