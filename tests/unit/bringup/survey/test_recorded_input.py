# SPDX-License-Identifier: Apache-2.0
"""With the parameter `record`, what the robot sends during a survey is a recording in its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage, Imu
from tf2_msgs.msg import TFMessage

from pipeprog_bringup.recording.bag import Bag, MotionMessage
from pipeprog_bringup.survey.survey_output import SurveyOutput
from pipeprog_node import messages, qos
from tests.unit.bringup.survey.fake_graph import CAMERA, JPEG, START
from tests.unit.bringup.survey.survey_stage import SurveyStage, survey_stage

HEADER = messages.header(START, "camera")
MOUNTED = TFMessage(transforms=[TransformStamped(header=messages.header(START, "body"), child_frame_id="camera")])
MOVED = TFMessage(transforms=[TransformStamped(header=messages.header(START, "odom"), child_frame_id="body")])
SENT: dict[str, Any] = {
    "camera_info": messages.info_from_camera(CAMERA, START, "camera"),
    "image/compressed": CompressedImage(header=HEADER, format="jpeg", data=JPEG),
    "odometry": Odometry(header=messages.header(START, "odom"), child_frame_id="body"),
    "imu": Imu(header=HEADER),
    "/tf": MOVED,
    "/tf_static": MOUNTED,
}


def send_all(stage: SurveyStage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each message once, when the survey listens; until all have come."""
    kept: list[str] = []
    keep = SurveyOutput.keep_input

    def count(output: SurveyOutput, topic: str, *content: Any) -> None:
        kept.append(topic)
        keep(output, topic, *content)

    monkeypatch.setattr(SurveyOutput, "keep_input", count)
    for topic, message in SENT.items():
        profile = qos.kept(1) if topic == "/tf_static" else qos.reliable(10)
        publisher = stage.robot.create_publisher(type(message), topic, profile)
        stage.until(publisher.get_subscription_count)
        publisher.publish(message)
    stage.until(lambda: len(kept) == len(SENT))


@pytest.mark.parametrize("is_cancelled", [False, True])
def test_the_robots_input_is_kept_as_a_recording_for_a_replay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_cancelled: bool
) -> None:
    with survey_stage(tmp_path / "surveys", record="true") as stage:
        stage.activate()
        handle = stage.film_a_map(survey_id="kept")
        send_all(stage, monkeypatch)
        stage.let_finish(keyframes=1, revision=1)
        if is_cancelled:
            stage.cancel(handle)
        else:
            stage.end()
        answer = stage.result(handle)
    assert answer.status == (GoalStatus.STATUS_CANCELED if is_cancelled else GoalStatus.STATUS_SUCCEEDED)
    bag = Bag.open(Path(answer.result.folder) / "recording.mcap")
    assert (bag.image_topic, bag.camera_info_topic, bag.image_count) == ("/image/compressed", "/camera_info", 1)
    (image,) = bag
    recorded = {"image/compressed": image.data, "camera_info": image.camera_info}
    recorded |= {each.topic: each.data for each in bag.with_motion() if isinstance(each, MotionMessage)}
    assert {topic: deserialize_message(data, type(SENT[topic])) for topic, data in recorded.items()} == SENT


def test_nothing_is_recorded_unless_it_is_asked_for(surveys: SurveyStage) -> None:
    surveys.activate()
    handle = surveys.film_a_map(survey_id="plain")
    surveys.cancel(handle)
    folder = Path(surveys.result(handle).result.folder)
    assert (folder / "out.mcap").is_file()
    assert not list(folder.glob("recording*"))
