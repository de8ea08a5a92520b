# SPDX-License-Identifier: Apache-2.0
"""The access policy of SROS2 for the nodes of pipeprog.launch.py: the topics, services and actions of each."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

from pipeprog_camera.errors import InputError

POLICY_VERSION = "0.2.0"  # of the format; the sros2 of Jazzy takes no other
# A name of ROS, of one part or several. In a policy, `*` and `?` would match other names, too.
_NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_STAGES = ("frames", "sfm", "detect")  # nodes whose services a survey calls
_EVENTS = "/parameter_events"  # topic; rclpy publishes on it in every node
_TYPES = "~/get_type_description"  # service; rclpy offers it in every node
_PARAMETERS = (
    *("describe_parameters", "get_parameter_types", "get_parameters"),
    *("list_parameters", "set_parameters", "set_parameters_atomically"),
)
_LIFECYCLE = (
    *("change_state", "get_available_states", "get_available_transitions"),
    *("get_state", "get_transition_graph"),
)
_KEYFRAMES = ("keyframes/image/compressed", "keyframes/camera_info")
_MAP = ("map_points", "keyframe_poses", "keyframe_velocities", "keyframes/refined_camera_info", "sfm_status")
_TRANSFORMS = ("/tf", "/tf_static")


@dataclass(frozen=True)
class GraphNames:
    """What decides which topics the nodes use: arguments of pipeprog.launch.py, by their names there, and settings.

    Topics that do not begin with a slash are in the namespace. Raises InputError where a name is none of ROS.

    Attributes:
        namespace: of the nodes; empty: the root.
        enclaves: folder of the enclaves in the keystore.
        image: topic of raw images.
        compressed_image: topic of JPEG or PNG images; empty: `image`/compressed.
        camera_info: topic of the calibration.
        cameras: what the topics of a rig's cameras begin with; none: one camera.
        odometry: topic of the odometry.
        imu: topic of the IMU.
        image_transport: raw or compressed: which topics of images `frames` subscribes to.
        use_sim_time: whether the nodes subscribe to /clock.
        record: whether `survey` subscribes to what the robot sends.
        publish_tf: as the parameter of `sfm`: whether it publishes on /tf.
    """

    namespace: str = ""
    enclaves: str = "/pipeprog"
    image: str = "image"
    compressed_image: str = ""
    camera_info: str = "camera_info"
    cameras: Sequence[str] = ()
    odometry: str = "odometry"
    imu: str = "imu"
    image_transport: str = "compressed"
    use_sim_time: bool = False
    record: bool = False
    publish_tf: bool = False

    def __post_init__(self) -> None:
        for argument in ("image", "camera_info", "odometry", "imu"):
            _require_name(argument, getattr(self, argument))
        for argument in ("namespace", "compressed_image"):
            if getattr(self, argument):
                _require_name(argument, getattr(self, argument))
        for camera in self.cameras:
            _require_name("cameras", camera)
        _require_name("enclaves", self.enclaves)
        if not self.enclaves.startswith("/"):
            raise InputError(f"enclaves: {self.enclaves!r} is relative: begin it with a slash, as in /pipeprog")

    @property
    def root(self) -> str:
        """The namespace as ROS writes it, `/` or `/robot7`."""
        return f"/{self.namespace.strip('/')}"


@dataclass(frozen=True)
class Profile:
    """What one node may do; names are relative to the namespace, `~/` stands for the node's own name.

    Attributes:
        node: name of the node.
        publish: topics.
        subscribe: topics.
        reply: services that it offers.
        request: services that it calls.
        execute: actions that it offers.
    """

    node: str
    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    reply: tuple[str, ...] = ()
    request: tuple[str, ...] = ()
    execute: tuple[str, ...] = ()


def profiles(names: GraphNames) -> dict[str, list[Profile]]:
    """The profiles of each enclave, by its name below `names.enclaves`.

    All nodes of a process are in one enclave: `frames`, `sfm` and `detect` each with a hidden node that offers `renew`,
    `survey` with the node `survey_listener`, which exists during a survey.
    """
    clock = ("/clock",) if names.use_sim_time else ()
    is_raw = names.image_transport == "raw"
    cameras = _camera_topics(names, raw=is_raw, compressed=not is_raw)
    keyframes = (*_KEYFRAMES, "keyframes/retired")
    return {
        "frames": _stage(
            "frames",
            publish=("frame_decisions", *keyframes),
            subscribe=(*cameras, "image_overlap", "survey/paused", *clock),
        ),
        "sfm": _stage(
            "sfm",
            publish=("image_overlap", *_MAP, *(("/tf",) if names.publish_tf else ())),
            subscribe=(*keyframes, names.odometry, names.imu, *_TRANSFORMS, *clock),
        ),
        "detect": _stage("detect", publish=("pipes", "pipe_markers"), subscribe=(*keyframes, *_MAP, *clock)),
        "survey": [_survey(names, clock), _survey_listener()],
    }


def policy_xml(names: GraphNames) -> str:
    """The policy as a file that `ros2 security create_permission` takes, the same bytes for the same names."""
    policy = ElementTree.Element("policy", version=POLICY_VERSION)
    enclaves = ElementTree.SubElement(policy, "enclaves")
    for name, nodes in profiles(names).items():
        enclave = ElementTree.SubElement(enclaves, "enclave", path=f"{names.enclaves}/{name}")
        parent = ElementTree.SubElement(enclave, "profiles")
        for node in nodes:
            _add_profile(parent, node, names.root)
    ElementTree.indent(policy)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(policy, encoding="unicode")}\n'


def _require_name(argument: str, value: str) -> None:
    if not _NAME.fullmatch(value):
        raise InputError(
            f"{argument}: {value!r} is no name of ROS: use letters, digits and _, parts between single slashes, as in "
            "/camera/image_raw"
        )


def _camera_topics(names: GraphNames, *, raw: bool = True, compressed: bool = True) -> tuple[str, ...]:
    """The topics of images, `raw` and `compressed` ones, and calibrations; those of a rig as `frames` has them."""
    if not names.cameras:
        encoded = names.compressed_image or f"{names.image}/compressed"
        return (names.image,) * raw + (encoded,) * compressed + (names.camera_info,)
    ends = ("image",) * raw + ("image/compressed", "compressed") * compressed + ("camera_info",)
    return tuple(f"{camera}/{end}" for camera in names.cameras for end in ends)


def _stage(name: str, publish: tuple[str, ...], subscribe: tuple[str, ...]) -> list[Profile]:
    """A node whose services a survey calls, and the hidden node in its process."""
    return [
        Profile(
            name,
            publish=("/rosout", _EVENTS, "/diagnostics", *publish),
            subscribe=subscribe,
            reply=("~/finish", _TYPES, *_own(_PARAMETERS)),
        ),
        Profile(f"_{name}_renewal", publish=(_EVENTS,), reply=(f"{name}/renew", _TYPES)),
    ]


def _survey(names: GraphNames, clock: tuple[str, ...]) -> Profile:
    recorded = (*_camera_topics(names), names.odometry, names.imu, *_TRANSFORMS) if names.record else ()
    return Profile(
        "survey",
        publish=("/rosout", _EVENTS, "progress", "~/transition_event"),
        subscribe=(*recorded, *clock),
        reply=("~/end", "~/pause", _TYPES, *_own(_PARAMETERS), *_own(_LIFECYCLE)),
        execute=("survey",),
    )


def _survey_listener() -> Profile:
    """The node of one survey. It reads parameters alone; rclpy's AsyncParameterClient has clients of all services."""
    services = ("finish", "renew", *_PARAMETERS)
    return Profile(
        "survey_listener",
        publish=("/rosout", _EVENTS, "survey/paused"),
        subscribe=("frame_decisions", "image_overlap", *_KEYFRAMES, *_MAP, "pipes", "pipe_markers", "/diagnostics"),
        reply=(_TYPES, *_own(_PARAMETERS)),
        request=tuple(f"{stage}/{service}" for stage in _STAGES for service in services),
    )


def _own(services: Iterable[str]) -> tuple[str, ...]:
    return tuple(f"~/{service}" for service in services)


def _add_profile(parent: ElementTree.Element, node: Profile, namespace: str) -> None:
    profile = ElementTree.SubElement(parent, "profile", ns=namespace, node=node.node)
    for kind, rule, allowed in (
        ("topic", "publish", node.publish),
        ("topic", "subscribe", node.subscribe),
        ("service", "reply", node.reply),
        ("service", "request", node.request),
        ("action", "execute", node.execute),
    ):
        if allowed:
            group = ElementTree.SubElement(profile, f"{kind}s", {rule: "ALLOW"})
            for name in sorted(set(allowed)):
                ElementTree.SubElement(group, kind).text = name
