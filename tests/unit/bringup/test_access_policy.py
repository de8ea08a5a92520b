# SPDX-License-Identifier: Apache-2.0
"""The access policy of SROS2: its format, its names, mistakes in them, and the command that writes it.

What the nodes of a running graph use is compared with it in tests/integration/test_survey.py.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import typer

from pipeprog_bringup.access_policy import GraphNames, policy_xml
from pipeprog_bringup.cli import app
from pipeprog_bringup.commands.policy import Transport
from pipeprog_camera.errors import InputError
from tests.access import Access, allowed
from tests.unit.bringup.launch_description import described

NODES = ["frames", "sfm", "detect", "survey"]
SETTINGS = {"publish_tf"}  # of the parameter file, not of the launch file
# Parts of the format of SROS2: element -> attributes, elements within it.
FORMAT: dict[str, tuple[set[str], set[str]]] = {
    "policy": ({"version"}, {"enclaves"}),
    "enclaves": (set(), {"enclave"}),
    "enclave": ({"path"}, {"profiles"}),
    "profiles": (set(), {"profile"}),
    "profile": ({"ns", "node"}, {"topics", "services", "actions"}),
    "topics": ({"publish", "subscribe"}, {"topic"}),
    "services": ({"reply", "request"}, {"service"}),
    "actions": ({"call", "execute"}, {"action"}),
}
REQUIRED = {"version", "path", "ns", "node"}


def publishers(policy: set[Access], topic: str) -> set[str]:
    return {node for _, node, rule, name in policy if (rule, name) == ("publish", topic)}


def subscriptions(policy: set[Access], node: str) -> set[str]:
    return {name for _, each, rule, name in policy if (each, rule) == (node, "subscribe")}


def test_the_file_has_the_format_of_sros2() -> None:
    root = ElementTree.fromstring(policy_xml(GraphNames()))
    assert (root.tag, root.attrib) == ("policy", {"version": "0.2.0"})
    for element in root.iter():
        attributes, parts = FORMAT.get(element.tag, (set(), set()))
        assert set(element.attrib) <= attributes
        assert set(element.attrib) >= attributes & REQUIRED
        assert {part.tag for part in element} <= parts
        assert len(element) or (element.text or "").strip()


def test_each_node_of_the_graph_has_an_enclave_in_the_folder_of_the_keystore() -> None:
    root = ElementTree.fromstring(policy_xml(GraphNames(enclaves="/site/robot7")))
    assert [enclave.attrib["path"] for enclave in root.iter("enclave")] == [f"/site/robot7/{name}" for name in NODES]


def test_each_output_has_one_node_that_may_publish_it() -> None:
    policy = allowed(policy_xml(GraphNames(record=True, publish_tf=True)))
    outputs = {name for _, _, rule, name in policy if rule == "publish"}
    shared = {"/rosout", "/parameter_events", "/diagnostics"}
    assert {topic for topic in outputs if len(publishers(policy, topic)) > 1} == shared
    assert publishers(policy, "/keyframes/image/compressed") == publishers(policy, "/frame_decisions") == {"/frames"}
    assert publishers(policy, "/pipes") == {"/detect"}


def test_one_camera_has_the_topics_that_the_launch_file_gives_it() -> None:
    camera: dict[str, Any] = {"image": "/camera/image_raw", "camera_info": "camera/info"}
    compressed = allowed(policy_xml(GraphNames(**camera)))
    own = {"/image_overlap", "/survey/paused"}
    assert subscriptions(compressed, "/frames") == {"/camera/image_raw/compressed", "/camera/info"} | own
    raw = allowed(policy_xml(GraphNames(**camera, image_transport="raw", namespace="robot7")))
    assert subscriptions(raw, "/robot7/frames") == {"/camera/image_raw", "/robot7/camera/info"} | {
        f"/robot7{name}" for name in own
    }
    recorded = allowed(policy_xml(GraphNames(**camera, compressed_image="/camera/jpeg", record=True)))
    assert subscriptions(recorded, "/survey") == {
        *("/camera/image_raw", "/camera/jpeg", "/camera/info"),
        *("/odometry", "/imu", "/tf", "/tf_static"),
    }


@pytest.mark.parametrize(
    ("argument", "value", "problem"),
    [
        ("image", "/camera/*", "image: '/camera/*' is no name of ROS: use letters, digits and _"),
        ("compressed_image", "a b", "compressed_image: 'a b' is no name of ROS"),
        ("camera_info", "", "camera_info: '' is no name of ROS"),
        ("namespace", "robot7/", "namespace: 'robot7/' is no name of ROS"),
        ("cameras", ("left", "7up"), "cameras: '7up' is no name of ROS"),
        ("enclaves", "pipeprog", "enclaves: 'pipeprog' is relative: begin it with a slash"),
    ],
)
def test_what_is_no_name_is_refused(argument: str, value: Any, problem: str) -> None:
    with pytest.raises(InputError) as error:
        GraphNames(**{argument: value})
    assert problem in str(error.value)


def test_the_command_takes_the_arguments_of_the_launch_file_with_their_defaults() -> None:
    declared = {each.arguments[0]: each.named for each in described() if each.kind == "DeclareLaunchArgument"}
    group = typer.main.get_command(app)
    options = {option.name: option.default for option in group.commands["policy"].params}  # type: ignore[attr-defined]
    names = {field.name for field in dataclasses.fields(GraphNames)}
    assert names - SETTINGS <= set(declared)
    assert set(options) == names | {"out", "force"}
    for name in names - SETTINGS - {"compressed_image"}:  # made of `image` in both
        default = getattr(options[name], "value", options[name])
        assert str(default).lower() == declared[name]["default_value"], name
    assert [choice.value for choice in Transport] == declared["image_transport"]["choices"]
    assert not any(options[name] for name in SETTINGS)


def test_the_command_writes_the_policy_of_its_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "policy.xml"
    options = ["--cameras", "/left right", "--namespace", "robot7", "--imu", "/imu", "--image-transport", "raw"]
    app(["policy", *options, "--record", "--out", str(out)], standalone_mode=False)
    names = GraphNames(cameras=("/left", "right"), namespace="robot7", imu="/imu", image_transport="raw", record=True)
    assert out.read_text() == policy_xml(names)
    assert str(out) in capsys.readouterr().out
