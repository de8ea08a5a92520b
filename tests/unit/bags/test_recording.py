# SPDX-License-Identifier: Apache-2.0
import hashlib
import json
from pathlib import Path

import cv2
import make_site
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from typer.testing import CliRunner

from sitegen.render import Lens, build_scene
from sitegen.robot import mounted
from sitegen.sensor import Sensor, develop, expose
from sitegen.site import CONCRETE, LAB_RADII, Site
from sitegen.walk import Walk

OPTIONS = ["--size", "480p", "--seconds", "0.4", "--allow-hidden", "--seed", "5", "--focal-error", "1"]


def run(out: Path, *options: str) -> None:
    result = CliRunner().invoke(make_site.app, ["lab", str(out), *OPTIONS, *options])
    assert result.exit_code == 0, result.output


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site") / "lab.mcap"
    run(out, "--distortion", "-0.1,0.02,0.001,0,0")
    return out


def messages(path: Path) -> dict[str, list]:
    found: dict[str, list] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for _, channel, message, decoded in reader.iter_decoded_messages():
            assert channel.message_encoding == "cdr"
            stamp = decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec
            assert message.log_time == stamp
            found.setdefault(channel.topic, []).append((stamp, decoded))
    return found


def test_images_and_calibration_come_in_pairs(recording: Path) -> None:
    found = messages(recording)
    images, infos = found["/camera/image/compressed"], found["/camera/camera_info"]
    assert [s for s, _ in images] == [s for s, _ in infos]
    assert np.diff([s for s, _ in images]).tolist() == [200_000_000]
    for _, image in images:
        assert image.format == "jpeg"
        decoded = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
        assert decoded is not None
        assert decoded.shape == (480, 854, 3)


def test_calibration_agrees_with_the_truth_but_for_the_error_asked_for(recording: Path) -> None:
    truth = json.loads(recording.with_suffix(".truth.json").read_text())
    info = messages(recording)["/camera/camera_info"][0][1]
    assert info.distortion_model == "plumb_bob"
    assert list(info.d) == truth["distortion"] == [-0.1, 0.02, 0.001, 0.0, 0.0]
    assert info.k[0] == pytest.approx(1.01 * truth["fx"])
    assert (info.k[2], info.k[5]) == (truth["cx"] - 0.5, truth["cy"] - 0.5) == (426.5, 239.5)


def test_truth_has_the_agreed_members(recording: Path) -> None:
    truth = json.loads(recording.with_suffix(".truth.json").read_text())
    assert {"width", "height", "fps", "fx", "fy", "cx", "cy", "planned_radii", "pipes", "ignore", "boards"} < set(truth)
    assert np.array(truth["camera_to_world"]).shape == (2, 4, 4)
    assert np.array(truth["boards"]).shape == (1, 5, 3)
    for pipe in truth["pipes"]:
        assert {"id", "start", "end", "radius", "length", "material"} <= set(pipe)
        assert pipe["length"] == pytest.approx(np.linalg.norm(np.subtract(pipe["end"], pipe["start"])))
        assert pipe["radius"] in truth["planned_radii"]


def test_the_truth_of_a_rig_has_a_pose_for_each_image_in_their_order(tmp_path: Path) -> None:
    out = tmp_path / "rig.mcap"
    run(out, "--rig", "3", "--drop", "0.4", "--size", "vga")
    images = sorted(
        (stamp, topic) for topic, sent in messages(out).items() if topic.endswith("compressed") for stamp, _ in sent
    )
    poses = np.array(json.loads(out.with_suffix(".truth.json").read_text())["camera_to_world"])
    assert 2 <= len(images) < 6
    assert len(poses) == len(images)
    # Cameras of one time are mounted as they are: a quarter metre and 20 degrees from the first at most.
    mounts = {f"/camera{number or ''}/image/compressed": mounted(number) for number in range(3)}
    bodies = [pose @ np.linalg.inv(mounts[topic]) for pose, (_, topic) in zip(poses, images, strict=True)]
    for (stamp, _), body in zip(images, bodies, strict=True):
        first = next(k for k, (other, _) in enumerate(images) if other == stamp)
        assert body == pytest.approx(bodies[first], abs=1e-9)


def test_turned_cameras_look_where_the_others_do_and_have_the_vertical_elsewhere() -> None:
    for number, degrees in enumerate((0, -102, -78, 180, 0)):
        straight, turned = mounted(number), mounted(number, is_turned=True)
        assert turned[:3, 2:] == pytest.approx(straight[:3, 2:])
        by = straight[:3, :3].T @ turned[:3, :3]
        assert np.degrees(np.arctan2(by[1, 0], by[0, 0])) % 360 == pytest.approx(degrees % 360)


def test_in_a_gap_no_camera_sends_an_image_for_a_second(tmp_path: Path) -> None:
    out = tmp_path / "gap.mcap"
    run(out, "--rig", "2", "--gaps", "1", "--size", "vga", "--fps", "2", "--seconds", "2", "--fisheye")
    sent = messages(out)
    stamps = {stamp for topic, images in sent.items() if topic.endswith("compressed") for stamp, _ in images}
    assert 0 < len(stamps) < 4
    info = sent["/camera/camera_info"][0][1]
    assert (info.distortion_model, len(info.d)) == ("equidistant", 4)
    truth = json.loads(out.with_suffix(".truth.json").read_text())
    assert truth["distortion_model"] == "equidistant"
    assert list(info.d) == truth["distortion"]


def test_boq_and_board_read_as_yaml(recording: Path) -> None:
    boq = yaml.safe_load(recording.with_suffix(".boq.yaml").read_text())
    assert [c["outer_radius_mm"] for c in boq["classes"]] == [8.6, 36.5, 57.5, 84.1, 109.5]
    assert all(c["planned_length_m"] > 0 for c in boq["classes"])
    (board,) = yaml.safe_load(recording.with_suffix(".board.yaml").read_text())["boards"]
    assert board["centres_mm"] == [[-240, 150], [240, 150], [0, 0], [-240, -150], [240, -150]]


def test_the_same_seed_gives_the_same_bytes_on_any_number_of_threads(tmp_path: Path) -> None:
    def digest(name: str, *options: str) -> str:
        run(tmp_path / name, "--fps", "5", "--noise", "2", *options)
        return hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()

    assert digest("a.mcap") == digest("b.mcap", "--jobs", "2")


def test_a_recording_that_misses_pipes_is_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(make_site.app, ["lab", str(tmp_path / "x.mcap"), "--seconds", "0.2"])
    assert result.exit_code == 1
    assert not list(tmp_path.iterdir())


def test_bad_distortion_is_a_usage_error(tmp_path: Path) -> None:
    result = CliRunner().invoke(make_site.app, ["lab", str(tmp_path / "x.mcap"), "--distortion", "0.1,zero"])
    assert result.exit_code == 2


def test_exposure_blurs_along_the_motion_only() -> None:
    site = Site(LAB_RADII)
    site.wall((0, 0, 1), (0, -1, 0), 20.0, 20.0, CONCRETE)
    scene = build_scene(site.primitives, [], 1.0, 1)
    walk = Walk([[0, -1, 1, 0, 0], [4, -1, 1, 0, 0]], 1.0, np.random.default_rng(0), closed=False, wobble=0.0)
    lens = Lens(160, 120, 320.0, 320.0, 79.5, 59.5)
    sharp, blurred = (expose(scene, lens, walk, Sensor(exposure=e), 1.0)[:, :, 1] for e in (0.0, 0.03))
    across, down = (np.abs(np.diff(blurred, axis=a)).mean() / np.abs(np.diff(sharp, axis=a)).mean() for a in (1, 0))
    assert across < 0.75 * down  # along the motion only the coarse mottle is left
    assert abs(float(sharp.mean() - blurred.mean())) < 0.01


def test_development_keeps_black_and_white_and_adds_the_noise_asked_for() -> None:
    grey = np.full((64, 64, 3), 0.2, np.float32)
    image = develop(grey, Sensor(noise=2.0, blur=0.0), np.random.default_rng(1)).astype(float)
    assert image.mean() == pytest.approx(255 * (1.055 * 0.2 ** (1 / 2.4) - 0.055), abs=0.1)
    assert image.std() == pytest.approx(2.0, rel=0.05)
    ends = np.stack([np.zeros((8, 8, 3)), np.full((8, 8, 3), 2.0)]).astype(np.float32)
    assert [develop(e, Sensor(noise=0.0), np.random.default_rng(1)).mean() for e in ends] == [0, 255]
