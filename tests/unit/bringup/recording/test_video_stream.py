# SPDX-License-Identifier: Apache-2.0
"""Video in recordings: H.264 and H.265 in the messages of Foxglove, ffmpeg_image_transport and sensor_msgs."""

from __future__ import annotations

import builtins
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.recording.frame_check import ImageMessage
from pipeprog_bringup.recording.h264_frames import FrameNumbers, codec_of
from pipeprog_bringup.recording.video_stream import DAMAGED, LOST, NO_KEY_FRAME
from pipeprog_camera.errors import InputError
from tests.unit.bringup.recordings import (
    START,
    STEP,
    camera_messages,
    coded_frames,
    info,
    mcap_bytes,
    pictures,
    sqlite_bytes,
    video_messages,
    write_bag,
)

needs_av = pytest.mark.skipif(find_spec("av") is None, reason="PyAV is not installed: make setup VIDEO=1")
COUNT = 24  # three groups of eight frames


def frames(path: Path, coded: list[bytes], type_name: str = cdr.COMPRESSED_VIDEO, codec: str = "h264") -> list:
    return list(Bag.open(write_bag(path, video_messages(coded, type_name, codec))))


def picture(frame: ImageMessage) -> np.ndarray:
    image = cdr.read_image(frame.data, cdr.IMAGE)
    return np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)


def faults(found: list[ImageMessage]) -> list[str]:
    return [frame.fault for frame in found]


@needs_av
@pytest.mark.parametrize(
    ("type_name", "codec", "encoder"),
    [
        (cdr.COMPRESSED_VIDEO, "h264", "libx264"),
        (cdr.COMPRESSED_VIDEO, "h265", "libx265"),
        (cdr.FFMPEG_PACKET, "h264_nvenc", "libx264"),
        (cdr.FFMPEG_PACKET, "libx265", "libx265"),
        (cdr.COMPRESSED_IMAGE, "h264", "libx264"),
    ],
)
def test_gives_the_frames_that_mcap_has_as_pictures(tmp_path: Path, type_name: str, codec: str, encoder: str) -> None:
    same = list(Bag.open(write_bag(tmp_path / "jpeg.mcap", camera_messages(COUNT))))
    found = frames(tmp_path / "video.mcap", coded_frames(COUNT, encoder), type_name, codec)
    assert [(one.stamp, one.frame_id, one.camera_info, one.fault) for one in found] == [
        (one.stamp, one.frame_id, one.camera_info, one.fault) for one in same
    ]
    for frame, expected in zip(found, pictures(COUNT), strict=True):
        assert np.abs(picture(frame).astype(int) - expected).mean() < 3.0  # coded, and colours at half the resolution


@needs_av
def test_a_recording_that_starts_between_key_frames(tmp_path: Path) -> None:
    found = frames(tmp_path / "video.mcap", coded_frames(COUNT)[5:])
    assert faults(found) == 3 * [NO_KEY_FRAME] + (COUNT - 8) * [""]


@needs_av
@pytest.mark.parametrize("encoder", ["libx264", "libx265"])
def test_after_a_lost_message_frames_are_left_out_up_to_the_next_key_frame(tmp_path: Path, encoder: str) -> None:
    coded = coded_frames(COUNT, encoder)
    found = frames(tmp_path / "video.mcap", coded[:10] + coded[11:], codec=encoder)
    assert faults(found)[:10] == 10 * [""]
    assert all(faults(found)[10:15])
    assert faults(found)[15:] == 8 * [""]
    assert np.abs(picture(found[15]).astype(int) - pictures(COUNT)[16]).mean() < 3.0


@needs_av
def test_a_damaged_frame_takes_those_that_follow_with_it(tmp_path: Path) -> None:
    coded = coded_frames(COUNT, "libx265")
    coded[10] = coded[10][:6] + bytes(len(coded[10]) - 6)
    found = frames(tmp_path / "video.mcap", coded, codec="h265")
    assert faults(found) == 10 * [""] + [DAMAGED] + 5 * [LOST] + 8 * [""]


@needs_av
def test_frames_that_come_out_in_another_order_keep_their_stamps(tmp_path: Path) -> None:
    import av

    context = av.CodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt, context.gop_size = 64, 48, "yuv444p", 8
    context.time_base = 1
    context.options = {"bf": "2", "b_strategy": "0", "crf": "10"}
    packets = []
    for number, one in enumerate(pictures(COUNT)):
        frame = av.VideoFrame.from_ndarray(one, format="bgr24")
        frame.pts = number
        packets += context.encode(frame)
    packets += context.encode(None)
    numbers = [packet.pts for packet in packets]
    assert numbers != sorted(numbers)
    messages = video_messages([b""] * COUNT)
    coded = dict(zip(numbers, (bytes(packet) for packet in packets), strict=True))
    in_order = video_messages([coded[number] for number in range(COUNT)])
    written = [one for number in numbers for one in in_order[2 * number : 2 * number + 2]]
    stream = [(*one[:2], START + at, one[3]) for at, one in enumerate(written)]
    found = list(Bag.open(write_bag(tmp_path / "video.mcap", stream)))
    assert len(messages) == 2 * len(found)
    assert [frame.stamp for frame in found] == [START + number * STEP for number in range(COUNT)]
    for frame, expected in zip(found, pictures(COUNT), strict=True):
        assert np.abs(picture(frame).astype(int) - expected).mean() < 3.0


@needs_av
def test_a_torn_recording_gives_the_frames_before_the_tear(tmp_path: Path) -> None:
    coded = coded_frames(COUNT)
    for name, whole in (
        ("torn.mcap", mcap_bytes(video_messages(coded))),
        ("torn.db3", sqlite_bytes(video_messages(coded))),
    ):
        (tmp_path / name).write_bytes(whole[: int(0.7 * len(whole))])
        bag = Bag.open(tmp_path / name)
        found = list(bag)
        assert 0 < len(found) < COUNT
        assert "torn" in bag.losses[0]


@needs_av
def test_noise_in_place_of_video_is_refused(tmp_path: Path) -> None:
    noise = [np.random.default_rng(n).bytes(500) for n in range(4)]
    keys = [b"\0\0\1\x67" + one + b"\0\0\1\x65" + one for one in noise]
    for content, reason in ((noise, "before its first key frame"), (keys, "damaged video")):
        with pytest.raises(InputError, match=f"none of the 4 images on /camera/video can be used: .*{reason}"):
            frames(tmp_path / "video.mcap", content)


@needs_av
def test_a_stream_that_declares_a_size_it_has_not_is_refused(tmp_path: Path) -> None:
    """A sequence parameter set of 65 536 x 65 536 px, and a slice of ten bytes."""

    def exponential(number: int) -> str:
        bits = f"{number + 1:b}"
        return "0" * (len(bits) - 1) + bits

    fields = [0, 0, 0, 1, 4095, 4095]  # set, frame number, order of output, references (1, then no gaps), size
    text = "".join(map(exponential, fields[:4])) + "0" + "".join(map(exponential, fields[4:])) + "1" + "1" + "0" + "01"
    text += "0" * (-len(text) % 8)
    parameters = b"\x67\x42\0\x1e" + int(text, 2).to_bytes(len(text) // 8, "big")
    huge = b"\0\0\0\1" + parameters + b"\0\0\0\1\x68\xce\x3c\x80" + b"\0\0\0\1\x65\x88\x84" + bytes(10)
    started = time.monotonic()
    with pytest.raises(InputError, match="none of the 4 images"):
        frames(tmp_path / "video.mcap", 4 * [huge])
    assert time.monotonic() - started < 2.0


def test_other_codecs_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"/camera/video is video coded as 'vp9': record it as h264 or h265"):
        frames(tmp_path / "video.mcap", 4 * [b"x"], codec="vp9")
    assert [codec_of(name) for name in ("H265", "hevc_vaapi", "libx264rgb", "jpeg", "av1")] == [
        *("hevc", "hevc", "h264", "", "")
    ]


def test_without_pyav_the_error_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest, **options):
        if name == "av":
            raise ModuleNotFoundError(name)
        return real(name, *rest, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"pip install av==.*make setup VIDEO=1"):
        frames(tmp_path / "video.mcap", 4 * [b"\0\0\1\x65"])


@needs_av
def test_pictures_are_read_rather_than_the_video_of_them(tmp_path: Path) -> None:
    video = [("/camera/image/ffmpeg", *one[1:]) for one in video_messages(coded_frames(8))[1::2]]
    bag = Bag.open(write_bag(tmp_path / "both.mcap", camera_messages(8) + video))
    assert bag.image_topic == "/camera/image/compressed"
    alone = [("/camera/camera_info", cdr.CAMERA_INFO, START, info(0)), *video]
    assert Bag.open(write_bag(tmp_path / "alone.mcap", alone)).image_topic == "/camera/image/ffmpeg"


@needs_av
def test_frame_numbers_tell_each_missing_frame() -> None:
    coded = coded_frames(40, key_every=100)
    for missing in (None, 1, 17, 38):
        numbers = FrameNumbers()
        follows = [numbers.follows(frame) for at, frame in enumerate(coded) if at != missing]
        assert follows.count(False) == (missing is not None)
        if missing is not None:
            assert not follows[missing]
