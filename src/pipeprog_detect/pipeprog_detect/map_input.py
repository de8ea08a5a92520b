# SPDX-License-Identifier: Apache-2.0
"""Maps as the detector receives them: their parts come under one stamp on several topics."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from nav_msgs.msg import Path
from sensor_msgs.msg import CameraInfo, PointCloud2

from pipeprog_camera.limits import MAX_CLOUD_POINTS
from pipeprog_detect.look.colour_view import BoardCircles
from pipeprog_detect.types import RowVelocities
from pipeprog_detect.worker import Map
from pipeprog_msgs import msg
from pipeprog_node import qos
from pipeprog_node.intake import Intake
from pipeprog_node.keyframe_input import REFINED_CALIBRATION
from pipeprog_node.received import images as received_images
from pipeprog_node.received import maps as received_maps
from pipeprog_node.received.images import ReceivedCamera
from pipeprog_node.received.maps import ReceivedCloud, ReceivedPoses, ReceivedStatus, ReceivedVelocities

POINTS, POSES, VELOCITIES = "map_points", "keyframe_poses", "keyframe_velocities"
MAP_PARTS = (ReceivedStatus, ReceivedPoses, ReceivedCloud)
MAX_PENDING = 16  # stamps of which some messages have arrived: poses come after each keyframe, maps rarely


class CompleteMap(NamedTuple):
    """The parts of a map.

    `camera` where the survey has refined the calibration, `velocities` where it was made with a rolling shutter.
    """

    status: ReceivedStatus
    poses: ReceivedPoses
    cloud: ReceivedCloud
    camera: ReceivedCamera | None
    velocities: ReceivedVelocities | None


class MapInput:
    """Subscribes to the parts of maps, which are one map when they have one stamp.

    Attributes:
        revision: the largest of the maps that are complete.
    """

    def __init__(self, intake: Intake, use: Callable[[], None]) -> None:
        """`use` is called when a part has come."""
        self._use = use
        self._parts: OrderedDict[int, dict[type, Any]] = OrderedDict()  # by stamp
        self.revision = 0
        intake.subscribe(PointCloud2, POINTS, received_maps.map_points, self._keep, qos.latched())
        intake.subscribe(Path, POSES, received_maps.keyframe_poses, self._keep, qos.latched())
        intake.subscribe(CameraInfo, REFINED_CALIBRATION, received_images.camera_info, self._keep, qos.latched())
        intake.subscribe(
            msg.KeyframeVelocities, VELOCITIES, received_maps.keyframe_velocities, self._keep, qos.latched()
        )
        intake.subscribe(msg.SfmStatus, "sfm_status", received_maps.sfm_status, self._on_status, qos.latched())

    @property
    def newest(self) -> CompleteMap | None:
        """The complete map whose first part came last."""
        complete = (_complete(parts) for parts in reversed(self._parts.values()))
        return next((parts for parts in complete if parts is not None), None)

    def discard(self, taken: CompleteMap) -> None:
        """Forgets a map and those before it."""
        for stamp in [stamp for stamp in self._parts if stamp <= taken.status.stamp]:
            del self._parts[stamp]

    def _on_status(self, status: ReceivedStatus) -> None:
        if status.revision:
            self._keep(status)

    def _keep(self, part: ReceivedCloud | ReceivedPoses | ReceivedStatus | ReceivedCamera | ReceivedVelocities) -> None:
        parts = self._parts.setdefault(part.stamp, {})
        parts[type(part)] = part
        complete = _complete(parts)
        if complete is not None:
            self.revision = max(self.revision, complete.status.revision)
        while len(self._parts) > MAX_PENDING or (len(self._parts) > 1 and self._points() > MAX_CLOUD_POINTS):
            self._parts.popitem(last=False)
        self._use()

    def _points(self) -> int:
        clouds = [parts[ReceivedCloud] for parts in self._parts.values() if ReceivedCloud in parts]
        return sum(len(cloud.points) for cloud in clouds)


def _complete(parts: Mapping[type, Any]) -> CompleteMap | None:
    """The map of these parts, None while some of what belongs to it are missing."""
    if not all(kind in parts for kind in MAP_PARTS):
        return None
    status, poses, cloud = (parts[kind] for kind in MAP_PARTS)
    camera = parts.get(ReceivedCamera) if status.camera_refined else None
    velocities = parts.get(ReceivedVelocities) if status.readout > 0.0 else None
    if (status.camera_refined and camera is None) or (status.readout > 0.0 and velocities is None):
        return None
    return CompleteMap(status, poses, cloud, camera, velocities)


def map_command(whole: CompleteMap, final: bool) -> Map:
    """The command to detect in a map."""
    status, poses, cloud, camera, velocities = whole
    return Map(
        status.revision,
        cloud.points,
        cloud.normals,
        poses.stamps,
        poses.map_from_camera,
        final,
        None if camera is None else camera.camera,
        None if velocities is None else RowVelocities(velocities.readout, velocities.linear, velocities.angular),
        BoardCircles.of(status.circles),
    )
