# SPDX-License-Identifier: Apache-2.0
"""The detector as a ROS 2 node: map points, poses and keyframes in; pipes and their markers out."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from nav_msgs.msg import Path
from numpy.typing import NDArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.product.boq import BillOfQuantities, load_boq
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.markers import LABEL_HEIGHT, PipeMarker, pipe_markers
from pipeprog_detect.product.pipe_runs import PipeRun
from pipeprog_detect.types import Pipe
from pipeprog_detect.worker import Keyframe, Map, PipesReady, serve
from pipeprog_msgs import msg, srv
from pipeprog_node import messages, qos
from pipeprog_node.diagnostics import Diagnostics
from pipeprog_node.main import run
from pipeprog_node.parameters import declare
from pipeprog_node.worker import WorkerProcess

MAX_PENDING = 16  # stamps of which one message of three has arrived: poses come after each keyframe, maps rarely


class DetectNode(Node):
    """Adapter around the worker process that runs the detector."""

    def __init__(self) -> None:
        super().__init__("detect")
        config = declare(self, DetectConfig, extra=("boq", "intermediate"))
        path = str(self.declare_parameter("boq", "").value)
        if not path:
            raise InputError("no bill of quantities: set the parameter boq to its file")
        self._boq: BillOfQuantities = load_boq(path)
        self._intermediate = bool(self.declare_parameter("intermediate", True).value)
        self._worker = WorkerProcess(self, serve, (config, self._boq), self._on_event, self._on_death)
        self._images: dict[int, CompressedImage] = {}
        self._cameras: dict[int, Camera] = {}
        self._parts: OrderedDict[int, dict[type, Any]] = OrderedDict()  # of maps, by stamp
        self._maps: dict[int, msg.SfmStatus] = {}  # handed to the worker, by revision
        self._received: set[int] = set()  # stamps of keyframes handed to the worker
        self._uncalibrated: set[int] = set()  # stamps of keyframes whose CameraInfo is no calibration
        self._revision = self._pipes = 0
        self._finish: tuple[int, Future] | None = None

        self._array = self.create_publisher(msg.PipeArray, "pipes", qos.latched())
        self._markers = self.create_publisher(MarkerArray, "pipe_markers", qos.latched())
        self.create_subscription(CompressedImage, "keyframes/image/compressed", self._on_image, qos.reliable(50))
        self.create_subscription(CameraInfo, "keyframes/camera_info", self._on_camera_info, qos.reliable(50))
        self.create_subscription(PointCloud2, "map_points", self._on_map_part, qos.latched())
        self.create_subscription(Path, "keyframe_poses", self._on_map_part, qos.latched())
        self.create_subscription(msg.SfmStatus, "sfm_status", self._on_status, qos.latched())
        # In a group of its own: while it waits for the end, the other callbacks must run.
        self.create_service(srv.Finish, "~/finish", self._on_finish, callback_group=ReentrantCallbackGroup())
        self._diagnostics = Diagnostics(self, "pipes", self._health)

    def destroy_node(self) -> None:
        """Ends the worker with the node."""
        self._worker.close()
        super().destroy_node()

    def _on_image(self, message: CompressedImage) -> None:
        stamp = messages.stamp_ns(message.header.stamp)
        self._images[stamp] = message
        self._pair(stamp)

    def _on_camera_info(self, message: CameraInfo) -> None:
        stamp = messages.stamp_ns(message.header.stamp)
        try:
            self._cameras[stamp] = messages.camera_from_info(message)
        except InputError as error:
            self.get_logger().error(f"a keyframe is left out: {error}", once=True)
            self._uncalibrated.add(stamp)
        self._pair(stamp)

    def _pair(self, stamp: int) -> None:
        if stamp in self._uncalibrated:
            self._images.pop(stamp, None)
            self._hand_over()
        elif stamp in self._images and stamp in self._cameras:
            self._worker.send(Keyframe(stamp, bytes(self._images.pop(stamp).data), self._cameras.pop(stamp)))
            self._received.add(stamp)
            self._hand_over()

    def _on_map_part(self, message: PointCloud2 | Path) -> None:
        self._keep(messages.stamp_ns(message.header.stamp), message)

    def _on_status(self, message: msg.SfmStatus) -> None:
        if message.map_revision:
            self._keep(messages.stamp_ns(message.map_stamp), message)

    def _keep(self, stamp: int, part: PointCloud2 | Path | msg.SfmStatus) -> None:
        self._parts.setdefault(stamp, {})[type(part)] = part
        while len(self._parts) > MAX_PENDING:
            self._parts.popitem(last=False)
        self._hand_over()

    async def _on_finish(self, request: srv.Finish.Request, response: srv.Finish.Response) -> srv.Finish.Response:
        done: Future = Future()
        self._finish = (request.expected_inputs, done)
        self._finish_when_published()
        self._hand_over()
        await done
        response.success = True
        response.outputs = self._revision
        return response

    def _finish_when_published(self) -> None:
        if self._finish is not None and self._revision >= self._finish[0]:
            self._finish[1].set_result(None)
            self._finish = None

    def _hand_over(self) -> None:
        """Sends the newest map to the worker once its cloud, poses, status and keyframes are all there."""
        for stamp, parts in reversed(self._parts.items()):
            if len(parts) < 3:
                continue
            status = parts[msg.SfmStatus]
            final = self._finish is not None and status.map_revision >= self._finish[0]
            stamps, map_from_camera = messages.poses_from_path(parts[Path])
            if (self._intermediate or final) and self._uncalibrated.union(self._received).issuperset(stamps.tolist()):
                points, normals = messages.points_from_cloud(parts[PointCloud2])
                self._maps[status.map_revision] = status
                self._worker.send(Map(status.map_revision, points, normals, stamps, map_from_camera, final))
                for earlier in [other for other in self._parts if other <= stamp]:
                    del self._parts[earlier]
            return

    def _on_event(self, event: PipesReady) -> None:
        status = self._maps.pop(event.revision)
        for earlier in [revision for revision in self._maps if revision < event.revision]:
            del self._maps[earlier]  # skipped by the worker: a newer map had come
        header = messages.header(messages.stamp_ns(status.map_stamp), "map")
        product = event.product
        self._revision, self._pipes = event.revision, len(product.pipes)
        self._array.publish(
            msg.PipeArray(
                header=header,
                map_revision=event.revision,
                scale_source=status.scale_source,
                scale_sigma=status.scale_sigma,
                pipes=[_pipe_msg(pipe) for pipe in product.pipes],
                classes=[_progress_msg(row, self._boq) for row in product.classes],
                runs=[_run_msg(run) for run in product.runs],
            )
        )
        markers = [Marker(header=header, action=Marker.DELETEALL)]
        for number, marker in enumerate(pipe_markers(product.pipes, self._boq)):
            markers += _marker_msgs(number, marker, header)
        self._markers.publish(MarkerArray(markers=markers))
        self._finish_when_published()

    def _on_death(self, exit_code: int) -> None:
        self.get_logger().fatal(f"the detection process died (exit code {exit_code})")
        raise SystemExit(1)

    def _health(self) -> tuple[bytes, str, dict[str, Any]]:
        values = {
            "keyframes": len(self._received),
            "keyframes without calibration": len(self._uncalibrated),
            "map revision": self._revision,
            "pipes": self._pipes,
        }
        if self._uncalibrated:
            return DiagnosticStatus.WARN, "keyframes without a calibration are left out", values
        return DiagnosticStatus.OK, "detecting" if self._revision else "waiting for a map", values


def _pipe_msg(pipe: Pipe) -> msg.Pipe:
    return msg.Pipe(
        id=pipe.id,
        start=_point(pipe.cylinder.start),
        end=_point(pipe.cylinder.end),
        radius=pipe.cylinder.radius,
        radius_sigma=pipe.radius_sigma,
        class_name=pipe.class_name or "",
        class_probability=pipe.class_probability,
        class_kmeans=pipe.class_kmeans,
        visible_arc=pipe.visible_arc,
        rmse=pipe.rmse,
        points=pipe.points,
    )


def _run_msg(run: PipeRun) -> msg.PipeRun:
    return msg.PipeRun(
        id=run.id,
        pipes=list(run.pipes),
        barrel_length=run.barrel,
        centre_line_length=run.centre_line,
        joints=[
            msg.PipeJoint(kind=joint.kind, pipes=list(joint.pipes), angle=joint.angle, length=joint.length)
            for joint in run.joints
        ],
    )


def _marker_msgs(number: int, marker: PipeMarker, header: Header) -> list[Marker]:
    x, y, z, w = marker.orientation.tolist()
    red, green, blue = marker.color
    cylinder = Marker(
        header=header,
        ns="pipes",
        id=number,
        type=Marker.CYLINDER,
        pose=Pose(position=_point(marker.centre), orientation=Quaternion(x=x, y=y, z=z, w=w)),
        scale=Vector3(x=2.0 * marker.radius, y=2.0 * marker.radius, z=marker.length),
        color=ColorRGBA(r=red, g=green, b=blue, a=1.0),
    )
    label = Marker(
        header=header,
        ns="labels",
        id=number,
        type=Marker.TEXT_VIEW_FACING,
        pose=Pose(position=_point(marker.text_position)),
        scale=Vector3(z=LABEL_HEIGHT),
        color=ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0),
        text=marker.text,
    )
    return [cylinder, label]


def _point(position: NDArray[np.float64]) -> Point:
    x, y, z = position.tolist()
    return Point(x=x, y=y, z=z)


def _progress_msg(row: ClassProgress, boq: BillOfQuantities) -> msg.ClassProgress:
    color = next(planned.color for planned in boq.classes if planned.name == row.name)
    return msg.ClassProgress(
        class_name=row.name,
        outer_radius=row.outer_radius,
        planned_length=row.planned,
        installed_length=row.installed,
        color=ColorRGBA(r=color[0], g=color[1], b=color[2], a=1.0),
    )


def main() -> None:
    """Entry point of detect_node."""
    run(DetectNode)


if __name__ == "__main__":
    main()
