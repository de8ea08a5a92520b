# SPDX-License-Identifier: Apache-2.0
"""The other sides of a survey: the three nodes of the graph, with their topics and services. No computing."""

from __future__ import annotations

import itertools
from collections import Counter, deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import Path as Poses
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from pipeprog_bringup.survey.passage import CONFIGS
from pipeprog_camera.camera import Camera
from pipeprog_msgs import msg
from pipeprog_msgs.srv import Finish, Renew
from pipeprog_node import messages, qos
from pipeprog_node.diagnostics import PROCESS
from pipeprog_sfm.alignment.map_file import MAP_FILE, write_map
from pipeprog_sfm.alignment.survey_map import SurveyMap

TICK = 0.02  # s
START = 1_700_000_000_000_000_000  # ns, of the first image
PERIOD = 200_000_000  # ns between two images
CAMERA = Camera(64, 36, 45.0, 45.0, 31.5, 17.5)
JPEG = cv2.imencode(".jpg", np.full((CAMERA.height, CAMERA.width), 128, np.uint8))[1].tobytes()
MAP = SurveyMap(  # of one keyframe with one point
    frame="night1",
    aligned_by="",
    scale_sigma=1e-4,
    stamps=np.array([START]),
    cameras=(Camera(480, 270, 340.0, 340.0, 239.5, 134.5),),
    map_from_camera=np.eye(4)[None],
    offsets=np.array([0, 1]),
    pixels=np.zeros((1, 2), np.float32),
    descriptors=np.zeros((1, 128), np.uint8),
    point_of=np.array([0]),
    points=np.array([[0.0, 0.0, 2.0]]),
)


class Graph:
    """What the three nodes offer and publish; `die` has one come back as another process.

    Attributes:
        nodes: to be spun.
        asked: what was called, in order: node, service, and the request's fields that count.
        answers: of each node's Finish, in order; a future: it works until that is done; None: it dies over it.
        map: what the SfM writes as map.npz when it finishes; None: nothing.
        dying: nodes that die over the next call of Renew.
        is_silent: whether no diagnostics are sent.
    """

    def __init__(self) -> None:
        self.node = Node("graph")
        settings = [Node(name, allow_undeclared_parameters=True) for name in CONFIGS]  # all as by default
        self.nodes = [self.node, *settings]
        self.map: SurveyMap | None = None
        self.asked: list[tuple[Any, ...]] = []
        self.dying: list[str] = []
        self.is_silent = False
        self.answers: dict[str, deque[Finish.Response | Future | None]] = {name: deque() for name in CONFIGS}
        self._processes: Counter[str] = Counter(dict.fromkeys(CONFIGS, 100))
        group = ReentrantCallbackGroup()
        for name in CONFIGS:
            self.node.create_service(Renew, f"{name}/renew", self._renew(name), callback_group=group)
            self.node.create_service(Finish, f"{name}/finish", self._finish(name), callback_group=group)
        self._diagnostics = self.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.node.create_timer(TICK, self._tell)
        publish = self.node.create_publisher
        self._decisions = publish(msg.FrameDecision, "frame_decisions", qos.reliable(1000))
        self._images = publish(CompressedImage, "keyframes/image/compressed", qos.reliable(50))
        self._infos = publish(CameraInfo, "keyframes/camera_info", qos.reliable(50))
        self._overlaps = publish(msg.ImageOverlapArray, "image_overlap", qos.kept(50))
        self._statuses = publish(msg.SfmStatus, "sfm_status", qos.latched())
        self._clouds = publish(PointCloud2, "map_points", qos.latched())
        self._poses = publish(Poses, "keyframe_poses", qos.latched())
        self._pipes = publish(msg.PipeArray, "pipes", qos.latched())
        self._markers = publish(MarkerArray, "pipe_markers", qos.latched())
        self._stamps = itertools.count(START, PERIOD)
        self._keyframes: list[int] = []
        self._folder = Path()  # of the survey's files

    def die(self, name: str) -> None:
        self._processes[name] += 1

    def leave(self, name: str) -> None:
        """The services of this node are not there any more."""
        for service in [each for each in self.node.services if each.srv_name.startswith(f"{name}/")]:
            self.node.destroy_service(service)

    @property
    def is_found(self) -> bool:
        """Whether a survey would hear the diagnostics."""
        return self._diagnostics.get_subscription_count() > 0

    @property
    def is_heard(self) -> bool:
        """Whether a survey has found all that the graph publishes."""
        topics = (self._decisions, self._images, self._infos, self._overlaps, self._statuses, self._poses, self._pipes)
        return all(topic.get_subscription_count() for topic in topics)

    def pass_over(self, reason: str) -> None:
        """An image that is no keyframe."""
        header = messages.header(next(self._stamps), "camera")
        self._decisions.publish(msg.FrameDecision(header=header, reason=reason))

    def add_keyframe(self, has_place: bool) -> None:
        """A keyframe that the SfM has worked off."""
        header = messages.header(next(self._stamps), "camera")
        self._keyframes.append(messages.stamp_ns(header.stamp))
        self._decisions.publish(msg.FrameDecision(header=header, chosen=True, reason="first"))
        self._images.publish(CompressedImage(header=header, format="jpeg", data=JPEG))
        self._infos.publish(messages.info_from_camera(CAMERA, self._keyframes[-1], "camera"))
        image = msg.ImageOverlap(stamp=header.stamp, registered=has_place, overlap=0.9)
        self._overlaps.publish(
            msg.ImageOverlapArray(header=header, keyframes_considered=len(self._keyframes), images=[image])
        )

    def report(self, **fields: Any) -> None:
        """A status of the SfM."""
        self._statuses.publish(msg.SfmStatus(**fields))

    def publish_poses(self, *places: tuple[float, float, float]) -> None:
        """Poses of as many keyframes, at these places [m]."""
        self._poses.publish(self._path(places))

    def publish_map(self, revision: int) -> None:
        """A map of all keyframes, with one pipe; the keyframes are at the origin."""
        path = self._path([(0.0, 0.0, 0.0)] * len(self._keyframes))
        points = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
        self._clouds.publish(messages.point_cloud(path.header, points, colors=np.zeros((1000, 3), np.uint8)))
        self._poses.publish(path)
        pipe = msg.Pipe(id="p01", radius=0.0365, class_name="DN65", class_probability=0.9, points=7)
        pipe.end.z = 2.0
        share = msg.ClassProgress(class_name="DN65", outer_radius=0.0365, planned_length=3.0, installed_length=2.0)
        scale = {"scale_source": "board", "scale_sigma": 0.0004}
        self._pipes.publish(
            msg.PipeArray(header=path.header, map_revision=revision, pipes=[pipe], classes=[share], **scale)
        )
        self._markers.publish(MarkerArray(markers=[Marker(header=path.header, action=Marker.DELETEALL)]))

    def _path(self, places: Sequence[tuple[float, float, float]]) -> Poses:
        poses = np.tile(np.eye(4), (len(places), 1, 1))
        poses[:, :3, 3] = places
        stamps = np.array(self._keyframes[: len(places)])
        return messages.path(messages.header(int(stamps[-1]), "map"), stamps, poses)

    def _tell(self) -> None:
        if self.is_silent:
            return
        told = [
            DiagnosticStatus(name=f"{name}: health", values=[KeyValue(key=PROCESS, value=str(number))])
            for name, number in self._processes.items()
        ]
        self._diagnostics.publish(DiagnosticArray(status=told))

    def _renew(self, name: str) -> Callable[..., Any]:
        async def renew(request: Renew.Request, response: Renew.Response) -> Renew.Response:
            self.asked.append((name, "renew", request.idle, Path(request.journal).name))
            if name in self.dying:
                self.dying.remove(name)
                self.die(name)
                await Future()
            if request.colmap:
                self._folder = Path(request.colmap).parent
            response.success = True
            return response

        return renew

    def _finish(self, name: str) -> Callable[..., Any]:
        async def finish(request: Finish.Request, response: Finish.Response) -> Finish.Response:
            self.asked.append((name, "finish", request.expected_inputs))
            answer = self.answers[name].popleft()
            if isinstance(answer, Future):
                answer = await answer
            if name == "sfm" and self.map is not None:
                write_map(self._folder / MAP_FILE, self.map)
            if answer is None:
                self.die(name)
                await Future()
            assert answer is not None
            return answer

        return finish
