# SPDX-License-Identifier: Apache-2.0
"""Settings dataclasses as ROS parameters."""

from __future__ import annotations

from collections.abc import Collection
from typing import TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.node import Node
from rclpy.parameter import Parameter

from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import shown
from pipeprog_node.settings import Setting, build, check, describe, unknown

Config = TypeVar("Config")
Fixed = TypeVar("Fixed", bool, str)

# Parameters that rclpy itself declares, and prefixes of those that it reads.
_OF_ROS = ("use_sim_time", "start_type_description_service")
_PREFIXES_OF_ROS = ("qos_overrides.",)
_TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
}


def declare(node: Node, config_type: type[Config], extra: Collection[str] = ()) -> Config:
    """Declares every setting of the dataclass as a read-only parameter of the node and returns their values.

    Parameters given by a file or the command line that are neither a setting nor in `extra` (those that the node
    declares itself) are an InputError that names the nearest known one; so are values of a wrong type or out of range.
    """
    # rclpy gives no public access to the overrides, and silently ignores those that are not declared.
    overrides: dict[str, Parameter] = node._parameter_overrides
    settings = {setting.name: setting for setting in describe(config_type)}
    values: dict[str, object] = {}
    try:
        for name, override in overrides.items():
            if name in settings:
                values[name] = check(settings[name], override.value)
                overrides[name] = Parameter(name, value=values[name])  # 1 where a number is wanted becomes 1.0
            elif name not in extra and name not in _OF_ROS and not name.startswith(_PREFIXES_OF_ROS):
                raise unknown(name, [*settings, *extra])
    except InputError as error:
        raise InputError(f"parameter of node {node.get_fully_qualified_name()}: {error}") from None
    for setting in settings.values():
        initial = _TYPES[setting.type] if setting.default is None else setting.default
        node.declare_parameter(setting.name, initial, _descriptor(setting))
    return build(config_type, values)


def declare_fixed(node: Node, name: str, default: Fixed, description: str) -> Fixed:
    """Declares a parameter that is no setting (a file, how the node is run); it is read at the start alone.

    Raises InputError for a value of another type than the default.
    """
    descriptor = ParameterDescriptor(description=description, read_only=True)
    try:
        value: Fixed = node.declare_parameter(name, default, descriptor).value
    except InvalidParameterTypeException:
        given = shown(node._parameter_overrides[name].value)
        kind = "true or false" if isinstance(default, bool) else "text"
        raise InputError(
            f"parameter of node {node.get_fully_qualified_name()}: {name} = {given}: it takes {kind}"
        ) from None
    return value


def _descriptor(setting: Setting) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=setting.description, read_only=True)
    if setting.unit:
        descriptor.description += f" [{setting.unit}]"
    if setting.choices is not None:
        descriptor.additional_constraints = "one of " + ", ".join(str(choice) for choice in setting.choices)
    if setting.range is not None and setting.type is int:
        low, high = (int(bound) for bound in setting.range)
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    elif setting.range is not None:
        low_value, high_value = (float(bound) for bound in setting.range)
        descriptor.floating_point_range = [FloatingPointRange(from_value=low_value, to_value=high_value)]
    return descriptor
