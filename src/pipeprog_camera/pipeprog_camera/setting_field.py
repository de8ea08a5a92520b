# SPDX-License-Identifier: Apache-2.0
"""One setting of a settings dataclass, in two lines."""

from __future__ import annotations

from dataclasses import field
from typing import Any, TypeVar, cast

Value = TypeVar("Value")


def setting(
    default: Value,
    description: str,
    unit: str = "",
    limits: tuple[float, float] | None = None,
    *,
    choices: tuple[Any, ...] | None = None,
) -> Value:
    """A dataclass field with the metadata that pipeprog_node.settings reads.

    Args:
        default: the value where none is given.
        description: what it does, as docs/parameters.md says it.
        unit: of the value; empty where it has none.
        limits: least and largest value allowed, both inclusive.
        choices: the values allowed, where there are only some.
    """
    metadata: dict[str, Any] = {"description": description, "unit": unit}
    if limits is not None:
        metadata["range"] = limits
    if choices is not None:
        metadata["choices"] = choices
    return cast(Value, field(default=default, metadata=metadata))


def cores_setting() -> int:
    """The setting `cores`, which each node has."""
    return setting(
        0,
        "processor cores for the node and its worker, the first of those that it may use and the same for all nodes; "
        "0: all",
        "cores",
        (0, 1024),  # as many as Linux tells apart in one mask
    )
