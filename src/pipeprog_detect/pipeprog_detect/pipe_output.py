# SPDX-License-Identifier: Apache-2.0
"""Pipes as the detector publishes them: messages and markers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.markers import LABEL_HEIGHT, PipeMarker, pipe_markers
from pipeprog_detect.product.pipe_runs import PipeRun
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Pipe
from pipeprog_msgs import msg
from pipeprog_node import messages, qos
from pipeprog_node.received.maps import ReceivedStatus


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
