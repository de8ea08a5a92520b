# SPDX-License-Identifier: Apache-2.0
"""The detector as a ROS 2 node: map points, poses and keyframes in; pipes and their markers out."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from time import monotonic
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from nav_msgs.msg import Path
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, PointCloud2
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CLOUD_POINTS, MAX_POSES
from pipeprog_camera.rolled_image import RowVelocities
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.look.colour_view import BoardCircles
from pipeprog_detect.product.boq import BillOfQuantities, load_boq
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.markers import LABEL_HEIGHT, PipeMarker, pipe_markers
from pipeprog_detect.product.pipe_runs import PipeRun
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe
from pipeprog_detect.worker import (
    Decoding,
    Event,
    Keyframe,
    KeyframeUnusable,
    Map,
    NoPipes,
    PipesReady,
    Ready,
    Retire,
    serve,
)
from pipeprog_msgs import msg
from pipeprog_node import messages, qos
from pipeprog_node.diagnostics import Diagnostics
from pipeprog_node.finish import FinishService
from pipeprog_node.intake import Intake, InvalidMessageError
from pipeprog_node.keyframe_input import IMAGES, REFINED_CALIBRATION, KeyframeInput
from pipeprog_node.main import run
from pipeprog_node.parameters import declare, declare_fixed
from pipeprog_node.processes.cores import limit_cores
from pipeprog_node.processes.journal import Journal, journal_of
from pipeprog_node.processes.supervision import Supervision
from pipeprog_node.processes.worker import WorkerProcess
from pipeprog_node.received import images as received_images
from pipeprog_node.received import maps as received_maps
from pipeprog_node.received.images import ReceivedCamera
from pipeprog_node.received.keyframes import ReceivedRetirement
from pipeprog_node.received.maps import ReceivedCloud, ReceivedPoses, ReceivedStatus, ReceivedVelocities
from pipeprog_node.retirement_input import RetirementInput

POINTS, POSES, VELOCITIES = "map_points", "keyframe_poses", "keyframe_velocities"
MAP_PARTS = (ReceivedStatus, ReceivedPoses, ReceivedCloud)
MAX_PENDING = 16  # stamps of which some messages have arrived: poses come after each keyframe, maps rarely
TICK = 1.0  # s
# Ticks without a keyframe that a map contains, until the map does without. Both come from this machine or its network
# within a second; ticks are counted, not seconds, so that a node that stood still first hears what waits for it.
PATIENCE = 10
# Since a keyframe came, after which a map that lacks the newest ones is not begun: one of all of them follows once the
# SfM has caught up, which detection would delay. It is the SfM's HOLD_SECONDS.
HOLD_SECONDS = 0.5
UNPLACED = 2  # newest keyframes that a map may lack without another one to follow: the SfM has found no pose for them


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
        """The complete map; there is one at the most, since it replaces those before it."""
        complete = map(_complete, self._parts.values())
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
            self._forget_before(part.stamp)
        while len(self._parts) > MAX_PENDING or (len(self._parts) > 1 and self._points() > MAX_CLOUD_POINTS):
            self._parts.popitem(last=False)
        self._use()

    def _forget_before(self, stamp: int) -> None:
        """Forgets the maps whose first part came before that of a complete one: it replaces them."""
        while next(iter(self._parts)) != stamp:
            self._parts.popitem(last=False)

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


def _map_command(whole: CompleteMap, final: bool) -> Map:
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
        None if velocities is None else _row_velocities(velocities),
        BoardCircles.of(status.circles),
    )


def _row_velocities(received: ReceivedVelocities) -> RowVelocities:
    velocities = received.linear, received.angular
    return RowVelocities(received.readout, *velocities, received.linear_acceleration, received.angular_acceleration)


class PipeOutput:
    """Publishes pipes and their markers."""

    def __init__(self, node: Node, boq: BillOfQuantities) -> None:
        self._boq = boq
        self._array = node.create_publisher(msg.PipeArray, "pipes", qos.latched())
        self._markers = node.create_publisher(MarkerArray, "pipe_markers", qos.latched())

    def publish(self, product: Product, status: ReceivedStatus) -> None:
        """The product of a map."""
        header = messages.header(status.stamp, "map")
        product = replace(product, scale_sigma=status.scale_sigma)
        self._array.publish(
            msg.PipeArray(
                header=header,
                map_revision=status.revision,
                scale_source=status.scale_source,
                scale_sigma=status.scale_sigma,
                pipes=[_pipe_msg(pipe, product) for pipe in product.pipes],
                classes=[_progress_msg(row, product, self._boq) for row in product.classes],
                runs=[_run_msg(run) for run in product.runs],
            )
        )
        markers = [Marker(header=header, action=Marker.DELETEALL)]
        for number, marker in enumerate(pipe_markers(product.pipes, self._boq)):
            markers += _marker_msgs(number, marker, header)
        self._markers.publish(MarkerArray(markers=markers))


class DetectNode(Node):
    """Adapter around the worker process that runs the detector."""

    def __init__(self, overrides: Sequence[Parameter] = ()) -> None:
        super().__init__("detect", parameter_overrides=list(overrides))
        config = declare(self, DetectConfig, extra=("boq", "intermediate", "journal"))
        limit_cores(config.cores, self.get_logger().warning)
        path = declare_fixed(self, "boq", "", "file of the bill of quantities")
        if not path:
            raise InputError("no bill of quantities: set the parameter boq to its file")
        boq = load_boq(path)
        self._arguments = config, boq
        self._intermediate = declare_fixed(self, "intermediate", True, "detect in every map, not in the last one alone")
        self._named: dict[str, Cylinder] = {}  # pipes by name, as they were published last
        self._numbers: dict[int, int] = {}  # of the keyframes handed to the worker, by stamp
        self._taken = 0  # keyframes handed to the worker, one that came again counted again
        self._heard = monotonic()  # when the last keyframe came
        self._retired: list[tuple[int, ...]] = []  # stamps of each retirement handed to the worker
        self._left_out: dict[int, None] = {}  # stamps of keyframes that no map waits for, in their order
        self._waited: dict[int, int] = {}  # ticks, by stamp of the keyframes that the newest map waits for
        self._in_work: ReceivedStatus | None = None  # of the map that the worker has
        self._revision = self._pipes = 0
        journal = journal_of(declare_fixed(self, "journal", "", "folder for the journal of a survey"), "detect")
        if journal is not None:
            self._take_up(journal)
        self._supervision = Supervision(self._start_worker, "the detection process", journal=journal)
        self._output = PipeOutput(self, boq)
        self._intake = Intake(self)
        known, retired = (None, None) if journal is None else (self._numbers, self._retired)
        self._keyframes = KeyframeInput(
            self._intake, self._on_keyframe, lambda stamp: self._leave_out([stamp]), known=known
        )
        self._retirements = RetirementInput(self._intake, self._retire, known=retired)
        self._retirements.keyframes_came(self._taken)
        self._maps = MapInput(self._intake, self._hand_over)
        self._finish = FinishService(self, lambda: self._maps.revision, self._on_finish)
        self._diagnostics = Diagnostics(self, "pipes", self._health)
        # Steady time: a paused recording stops ROS time.
        self._timer = self.create_timer(TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _take_up(self, journal: Journal) -> None:
        """Goes on from what a process before this one was given."""
        self._named |= journal.note or {}
        for number, command in journal.commands():
            if isinstance(command, Keyframe):
                self._numbers[command.stamp] = number
                self._taken += 1
            else:
                self._retired.append(command.stamps)

    def destroy_node(self) -> None:
        """Ends the worker with the node."""
        self._supervision.close()
        super().destroy_node()

    def _on_keyframe(self, stamp: int, encoded: bytes, camera: Camera, frame_id: str) -> None:
        keyframe = Keyframe(stamp, encoded, camera)
        if self._supervision.is_poison(keyframe):
            text = f"detection processes died of the image at {stamp} ns before: it is not tried again"
            self._intake.reject(IMAGES, InvalidMessageError("poison", text))
            self._leave_out([stamp])
            return
        self._left_out.pop(stamp, None)  # it was given up too early
        self._numbers[stamp] = self._supervision.keep(keyframe)
        self._taken += 1
        self._heard = monotonic()
        self._retirements.keyframes_came(self._taken)
        self._hand_over()

    def _retire(self, retirement: ReceivedRetirement) -> None:
        self._keyframes.forget(retirement.stamps)
        self._retired.append(retirement.stamps)
        self._supervision.keep(Retire(retirement.stamps))

    def _leave_out(self, stamps: Iterable[int]) -> None:
        """No map waits for these keyframes any more."""
        self._left_out |= dict.fromkeys(stamp for stamp in stamps if stamp not in self._numbers)
        for stamp in list(self._left_out)[:-MAX_POSES]:
            del self._left_out[stamp]
        self._hand_over()

    def _give_up(self, stamps: Sequence[int], why: str) -> None:
        """No map waits any more for these keyframes, whose images will not come."""
        for stamp in stamps:
            text = f"the pose of a keyframe at {stamp} ns has come, its image {why}: it is left out"
            self._intake.reject(POSES, InvalidMessageError("no image", text))
        if stamps:
            self._leave_out(stamps)

    def _missing(self, poses: ReceivedPoses) -> set[int]:
        return set(poses.stamps.tolist()).difference(self._numbers, self._left_out)

    def _hand_over(self) -> None:
        """Sends the newest map to the worker once its cloud, poses, status and keyframes are all there."""
        newest = self._maps.newest
        if newest is None or not self._supervision.takes_requests:
            return
        status, poses, velocities = newest.status, newest.poses, newest.velocities
        asked = self._finish.expected is not None and status.revision >= self._finish.expected
        final = status.final or asked  # the final map may come before the request to finish, and is the same then
        if not final and (not self._intermediate or self._is_followed(poses)):
            return
        missing = self._missing(poses)
        if missing:
            self._give_up(sorted(filter(self._keyframes.missed, missing)), "came before this node was there")
            return
        self._maps.discard(newest)
        if velocities is not None and len(velocities.linear) != len(poses.stamps):
            count = f"{len(velocities.linear)} velocities for {len(poses.stamps)} poses"
            self._refuse(status.revision, f"{VELOCITIES} has {count} of one map: each keyframe has one", VELOCITIES)
            return
        command = _map_command(newest, final)
        if self._supervision.is_poison(command):
            self._refuse(status.revision, "detection processes died of this map before: it is not tried again")
            return
        self._in_work = status
        self._supervision.request(command)

    def _is_followed(self, poses: ReceivedPoses) -> bool:
        """Whether a map of more keyframes is expected soon: the SfM is behind, and no keyframe comes any more.

        After PATIENCE it is not expected any more: the SfM may have missed keyframes.
        """
        silence = monotonic() - self._heard
        if not HOLD_SECONDS < silence < PATIENCE * TICK:
            return False
        newest = int(poses.stamps.max(initial=0))
        return sum(stamp > newest for stamp in self._numbers) > UNPLACED

    def _on_finish(self) -> None:
        self._answer_when_published()
        self._hand_over()

    def _answer_when_published(self) -> None:
        if self._finish.expected is not None and self._revision >= self._finish.expected:
            self._finish.answer(self._revision)

    def _refuse(self, revision: int, problem: str, topic: str = POINTS) -> None:
        """No pipes will come of a map, for what a topic brought."""
        self._intake.reject(topic, InvalidMessageError("no detection", problem))
        if self._finish.expected is not None and revision >= self._finish.expected:
            self._finish.answer(self._revision, problem)

    def _tick(self) -> None:
        """Gives up keyframes for which the newest map waits in vain."""
        self._supervision.wake()
        if self._supervision.problem:
            self._finish.answer(self._revision, self._supervision.problem)
        newest = self._maps.newest
        missing = self._missing(newest.poses) if newest is not None else set()
        self._waited = {stamp: self._waited.get(stamp, 0) + 1 for stamp in missing}
        lost = [stamp for stamp, ticks in self._waited.items() if ticks >= PATIENCE]
        self._give_up(lost, "has not")
        self._hand_over()

    def _start_worker(self, kept: Iterable[Keyframe | Retire]) -> WorkerProcess:
        return WorkerProcess(self, serve, (*self._arguments, kept, self._named), self._on_event, self._on_death)

    def _on_event(self, event: Event) -> None:
        if isinstance(event, Ready):
            self._supervision.ready()
        elif isinstance(event, Decoding):
            self._supervision.in_work = None if event.stamp is None else self._numbers.get(event.stamp)
        elif isinstance(event, KeyframeUnusable):
            self._intake.reject(IMAGES, InvalidMessageError("image", event.problem))
            self._left_out[event.stamp] = None
        else:
            self._supervision.fulfilled()
            if isinstance(event, NoPipes):
                self._refuse(event.revision, event.problem)
            else:
                self._publish(event)
            self._hand_over()

    def _publish(self, event: PipesReady) -> None:
        assert self._in_work is not None
        product = event.product
        self._named |= {pipe.id: pipe.cylinder for pipe in product.pipes}
        self._supervision.note(self._named)
        self._revision, self._pipes = event.revision, len(product.pipes)
        self._output.publish(product, self._in_work)
        self._answer_when_published()

    def _on_death(self, exit_code: int) -> None:
        death = self._supervision.restart(exit_code)
        self.get_logger().error(death.report)
        if isinstance(death.dropped, Keyframe):
            del self._numbers[death.dropped.stamp]
            self._leave_out([death.dropped.stamp])
        if death.failed is not None and self._in_work is not None:
            self._refuse(self._in_work.revision, death.report)
        self._hand_over()

    def _health(self) -> tuple[bytes, str, dict[str, Any]]:
        values = {
            "keyframes": len(self._numbers),
            "keyframes retired": sum(map(len, self._retired)),
            "keyframes left out": len(self._left_out),
            "map revision": self._revision,
            "pipes": self._pipes,
        }
        values |= self._intake.health() | self._supervision.health()
        if self._supervision.problem:
            return DiagnosticStatus.ERROR, self._supervision.problem, values
        if self._left_out or self._intake.rejected:
            return DiagnosticStatus.WARN, "keyframes or messages are left out: the values say of which kind", values
        return DiagnosticStatus.OK, "detecting" if self._revision else "waiting for a map", values


def _pipe_msg(pipe: Pipe, product: Product) -> msg.Pipe:
    start, end = pipe.ends
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
        length_sigma=product.length_sigma(pipe),
        start_sigma=start.sigma,
        end_sigma=end.sigma,
        start_state=start.state,
        end_state=end.state,
        material=pipe.material,
        material_probability=pipe.material_probability,
    )


def _run_msg(run: PipeRun) -> msg.PipeRun:
    return msg.PipeRun(
        id=run.id,
        pipes=list(run.pipes),
        barrel_length=run.barrel,
        centre_line_length=run.centre_line,
        joints=[
            msg.PipeJoint(
                kind=joint.kind, pipes=list(joint.pipes), angle=joint.angle, length=joint.length, miss=joint.miss
            )
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


def _progress_msg(row: ClassProgress, product: Product, boq: BillOfQuantities) -> msg.ClassProgress:
    color = next(planned.color for planned in boq.classes if planned.name == row.name)
    return msg.ClassProgress(
        class_name=row.name,
        outer_radius=row.outer_radius,
        planned_length=row.planned,
        installed_length=row.installed,
        installed_sigma=product.installed_sigma(row.name),
        color=ColorRGBA(r=color[0], g=color[1], b=color[2], a=1.0),
    )


def main() -> None:
    """Entry point of detect_node."""
    run(DetectNode, renewed=("boq", "journal"))


if __name__ == "__main__":
    main()
