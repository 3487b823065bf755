"""Types of the variables that a controller sends and takes by RTDE, by their names, as ur-rtde decodes them."""

import re
import struct
from collections.abc import Sequence

_CODES = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "UINT64": "Q"}
_CODES |= {"VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i"}
_TYPES = (
    (r"robot_mode|safety_mode|(input|output)_int_register_\d+", "INT32"),
    (r"runtime_state|robot_status_bits|safety_status_bits|output_bit_registers\d+_to_\d+", "UINT32"),
    (r"actual_digital_(in|out)put_bits", "UINT64"),
    (r"actual_tool_accelerometer|payload_cog", "VECTOR3D"),
    (r"joint_mode", "VECTOR6INT32"),
    (r"actual_robot_(current|voltage)|actual_main_voltage", "DOUBLE"),
    (r"(actual|target)_(q|qd|qdd|current|moment|TCP_\w+)|actual_current_as_torque|actual_joint_voltage", "VECTOR6D"),
    (r"joint_(control_output|temperatures)|ft_raw_wrench|payload_inertia", "VECTOR6D"),
    (r"\w+", "DOUBLE"),
)


def variable_type(name: str) -> str:
    """Return the type of a variable."""
    return next(kind for pattern, kind in _TYPES if re.fullmatch(pattern, name))


def recipe_layout(types: Sequence[str]) -> struct.Struct:
    """Return the layout of the values of a recipe; KeyError for an unknown type."""
    return struct.Struct(">" + "".join(_CODES[kind] for kind in types))


def n_values(kind: str) -> int:
    """Return how many values a variable of a type has."""
    return int(_CODES[kind][:-1] or 1)
