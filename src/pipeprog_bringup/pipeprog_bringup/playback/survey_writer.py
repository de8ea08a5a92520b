# SPDX-License-Identifier: Apache-2.0
"""Writes the results of a replay: the files of the survey, and out.mcap for viewers."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import ColorRGBA
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import ImageMarker, Marker

from pipeprog_bringup.playback.frame_log import FrameLog
from pipeprog_bringup.playback.listener import LastMessages
from pipeprog_bringup.playback.outline_marker import outline_marker
from pipeprog_bringup.playback.player import calibration
from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_bringup.results import result_files
from pipeprog_bringup.results.atomic_output import OutputFolder
from pipeprog_bringup.results.cloud_io import write_las, write_ply
from pipeprog_bringup.results.lives import Lives, lives_after
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RowVelocities
from pipeprog_detect.coverage.survey import SurveyCoverage, survey_coverage, views_of
from pipeprog_detect.product.boq import PlannedPipe
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.pipe_runs import Joint, PipeRun
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe, PipeEnd, View
from pipeprog_msgs import msg
from pipeprog_node import messages
from pipeprog_sfm.alignment.map_file import MAP_FILE, read_map, write_map
from pipeprog_sfm.alignment.survey_map import MappedPipe, SurveyMap

_SURVEY_TOPICS = {
    "cloud": "map_points",
    "poses": "keyframe_poses",
    "velocities": "keyframe_velocities",
    "pipes": "pipes",
    "markers": "pipe_markers",
}


def write_survey(
    folder: OutputFolder,
    survey: LastMessages,
    log: FrameLog,
    seen: Seen,
    with_cloud: bool,
    reference: SurveyMap | None = None,
) -> Product:
    """Write pipes.json, progress.csv, trajectory.tum, frames.csv, cloud.ply and .las if wanted; returns the product.

    The map.npz that the SfM has written gets the pipes; `reference`: the survey in whose frame it was to lie.
    """
    product, coverage = product_from_msg(survey.pipes), seen.coverage
    scale = result_files.Scale(survey.pipes.scale_source, survey.pipes.scale_sigma)
    lives = complete_map(folder.file(MAP_FILE), product, seen.views, reference)
    result_files.write_pipes(folder.file("pipes.json"), product, scale, coverage, lives)
    result_files.write_progress(folder.file("progress.csv"), product, coverage)
    if with_cloud:
        points, normals = messages.points_from_cloud(survey.cloud)
        colors = messages.colors_from_cloud(survey.cloud)
        write_ply(folder.file("cloud.ply"), points, colors, normals)
        write_las(folder.file("cloud.las"), points, colors, normals)
    poses = [pose.pose for pose in survey.poses.poses]
    result_files.write_trajectory(
        folder.file("trajectory.tum"),
        [messages.stamp_ns(pose.header.stamp) for pose in survey.poses.poses],
        np.array([[p.position.x, p.position.y, p.position.z] for p in poses]),
        np.array([[p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w] for p in poses]),
    )
    result_files.write_frames(folder.file("frames.csv"), log.rows())
    return product


@dataclasses.dataclass(frozen=True)
class Seen:
    """What the keyframes had in view: they themselves, with depths, and what that tells of pipes and walls."""

    views: list[View]
    coverage: SurveyCoverage


def seen_by(survey: LastMessages, cameras: Mapping[int, Camera], planned: Sequence[PlannedPipe]) -> Seen:
    """What the keyframes had in view, whose cameras are given by stamp; `planned` are the pipes that have places."""
    product = product_from_msg(survey.pipes)
    points = messages.points_from_cloud(survey.cloud)[0].astype(float)
    stamps, poses = messages.poses_from_path(survey.poses)
    kept = [row for row, stamp in enumerate(stamps.tolist()) if stamp in cameras]
    views = views_of([cameras[int(stamps[row])] for row in kept], poses[kept], points)
    radii = [entry.outer_radius for entry in product.classes]
    return Seen(views, survey_coverage(product.pipes, planned, radii, points, views))


def complete_map(
    path: Path, product: Product, views: Sequence[View], reference: SurveyMap | None
) -> dict[str, str] | None:
    """Gives the map that the SfM has written the pipes of the survey; returns their lives where it was aligned."""
    if not path.is_file():  # the SfM died while it wrote
        return None
    survey_map = read_map(path)
    is_aligned = reference is not None and survey_map.aligned_by
    lives = lives_after(reference, product, views) if reference is not None and is_aligned else Lives({})
    own = [
        MappedPipe(
            lives.of.get(pipe.id, pipe.id),
            pipe.class_name or "",
            np.stack([pipe.cylinder.start, pipe.cylinder.end]),
            pipe.cylinder.radius,
            product.length_sigma(pipe),
        )
        for pipe in product.pipes
    ]
    write_map(path, dataclasses.replace(survey_map, pipes=(*own, *lives.unseen)))
    return lives.of if is_aligned else None


def record_survey(recording: BagWriter, survey: LastMessages, status: msg.SfmStatus) -> None:
    """Write the results into out.mcap, at the time of the first keyframe: a viewer shows them from the start."""
    stamp = messages.stamp_ns(survey.poses.poses[0].header.stamp)
    recorded = [(topic, getattr(survey, name)) for name, topic in _SURVEY_TOPICS.items()] + [("sfm_status", status)]
    for topic, message in recorded:
        if message is None:
            continue
        recording.write(f"/{topic}", type_name(type(message)), serialize_message(message), stamp, latched=True)


def record_keyframes(recording: BagWriter, bag: Bag, log: FrameLog, survey: LastMessages) -> dict[int, Camera]:
    """Write the keyframes into out.mcap, each with the calibration that was used and its camera's transform.

    Returns their cameras by stamp.
    """
    infos = {}
    chosen = {row.stamp for row in log.rows() if row.chosen}
    for frame in bag:
        if frame.stamp not in chosen or frame.fault:
            continue
        chosen.remove(frame.stamp)
        data = frame.data
        if bag.image_type == cdr.IMAGE:
            encoded = messages.encode_jpeg(messages.image_from_msg(deserialize_message(data, Image)))
            data = cdr.write_compressed_image(frame.stamp, frame.frame_id, "jpeg", encoded)
        infos[frame.stamp] = calibration(frame)
        recording.write("/keyframes/image/compressed", cdr.COMPRESSED_IMAGE, data, frame.stamp)
    return record_cameras(recording, survey, infos)


def record_cameras(recording: BagWriter, survey: LastMessages, infos: Mapping[int, CameraInfo]) -> dict[int, Camera]:
    """Write calibration, transform and pipes' outlines of the keyframes in out.mcap; returns their cameras by stamp.

    `infos`: the calibrations that were sent with them, by stamp; what the survey has refined goes before.
    """
    cameras = {}
    stamps, poses = messages.poses_from_path(survey.poses)
    rows = {stamp: row for row, stamp in enumerate(stamps.tolist())}
    pipes = _colored(survey)
    velocities = None
    if survey.velocities is not None:
        rates = messages.row_rates(survey.velocities)
        if all(len(rate) == len(stamps) for rate in rates):
            velocities = RowVelocities(survey.velocities.readout, *rates)
    refined = None if survey.refined is None else messages.camera_from_info(survey.refined)
    for stamp, sent in infos.items():
        used = messages.info_from_camera(refined, stamp, sent.header.frame_id) if refined else sent
        cameras[stamp] = messages.camera_from_info(used)
        recording.write("/keyframes/camera_info", cdr.CAMERA_INFO, serialize_message(used), stamp)
        if stamp in rows:
            pose = poses[rows[stamp]]
            moved = TFMessage(transforms=[messages.transform(stamp, "map", sent.header.frame_id, pose)])
            recording.write("/tf", cdr.TF, serialize_message(moved), stamp)
            rolled = velocities.rolled(rows[stamp], cameras[stamp]) if velocities else None
            outlines = outline_marker(stamp, sent.header.frame_id, cameras[stamp], pose, pipes, rolled)
            recording.write("/keyframes/outlines", type_name(ImageMarker), serialize_message(outlines), stamp)
    return cameras


def _colored(survey: LastMessages) -> list[tuple[Cylinder, ColorRGBA]]:
    """The pipes with the colours of their markers; black without one."""
    colors = {marker.id: marker.color for marker in survey.markers.markers if marker.type == Marker.CYLINDER}
    black = ColorRGBA(a=1.0)
    return [(_pipe(pipe).cylinder, colors.get(number, black)) for number, pipe in enumerate(survey.pipes.pipes)]


def type_name(kind: type) -> str:
    """`package/msg/Name` of a message class."""
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


def product_from_msg(message: msg.PipeArray) -> Product:
    """The product in a message of the topic `pipes`."""
    return Product(
        [_pipe(pipe) for pipe in message.pipes],
        [_progress(entry) for entry in message.classes],
        [_run(run) for run in message.runs],
        message.scale_sigma,
    )


def _pipe(message: msg.Pipe) -> Pipe:
    start, end = (np.array([point.x, point.y, point.z]) for point in (message.start, message.end))
    return Pipe(
        message.id,
        Cylinder(start, end, message.radius),
        message.radius_sigma,
        message.class_name or None,
        message.class_probability,
        message.visible_arc,
        message.rmse,
        message.points,
        message.class_kmeans,
        (PipeEnd(message.start_sigma, message.start_state), PipeEnd(message.end_sigma, message.end_state)),
        message.material,
        message.material_probability,
    )


def _progress(message: msg.ClassProgress) -> ClassProgress:
    planned, installed = message.planned_length, message.installed_length
    return ClassProgress(message.class_name, message.outer_radius, planned, installed, 100 * installed / planned)


def _run(message: msg.PipeRun) -> PipeRun:
    joints = tuple(
        Joint(joint.kind, (*joint.pipes,), joint.angle, joint.length, joint.miss) for joint in message.joints
    )
    return PipeRun(message.id, tuple(message.pipes), joints, message.barrel_length, message.centre_line_length)
