# SPDX-License-Identifier: Apache-2.0
"""What the launch file gives the nodes that it starts."""

from __future__ import annotations

from typing import Any

from tests.unit.bringup.launch_description import Made, described


def in_words(value: Any) -> Any:
    """A substitution as launch files in XML write it."""
    if isinstance(value, list):
        return "".join(map(in_words, value))
    return f"$(var {value.arguments[0]})" if isinstance(value, Made) else value


def test_every_node_has_its_enclave_and_the_severity_of_logs() -> None:
    nodes = [each for each in described() if each.kind in ("Node", "LifecycleNode")]
    assert {node.named["name"] for node in nodes} == {"frames", "sfm", "detect", "survey"}
    for node in nodes:
        given = [in_words(word) for word in node.named["ros_arguments"]]
        enclave = f"$(var enclaves)/{node.named['name']}"
        assert given == ["--log-level", "$(var log_level)", "--enclave", enclave], node.named["name"]
