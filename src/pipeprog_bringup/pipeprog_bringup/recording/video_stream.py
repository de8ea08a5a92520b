# SPDX-License-Identifier: Apache-2.0
"""Video in a recording: messages of one coded frame each become images, each under its own stamp.

Read are H.264 and H.265 of foxglove_msgs/CompressedVideo, ffmpeg_image_transport's FFMPEGPacket and CompressedImage.
Frames that refer to ones that are not there, before the first key frame or after a message that was lost, are told as
faults up to the next key frame: what a decoder makes of them looks like a picture and shows things in wrong places.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from itertools import islice
from typing import Any

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.frame_check import FrameCheck, ImageMessage
from pipeprog_bringup.recording.h264_frames import H264, HEVC, FrameNumbers, codec_of, is_key_frame
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_PIXELS, MAX_TRIED_IMAGES
from pipeprog_camera.outside_text import shown

VIDEO_TYPES = (cdr.COMPRESSED_VIDEO, cdr.FFMPEG_PACKET)
NO_KEY_FRAME = "video before its first key frame"
LOST = "video after a lost frame, up to the next key frame"
DAMAGED = "damaged video"
_INSTALL = "video in a recording needs PyAV: `pip install av==17.1.0` (or `make setup VIDEO=1`)"


def video_codec(topic: str, type_name: str, messages: Iterator[bytes]) -> str:
    """The codec of a topic, as the first of its messages that can be read says; empty where they are pictures.

    Raises InputError where they are video that is not read.
    """
    if type_name == cdr.IMAGE:
        return ""
    named = ""
    for data in islice(messages, MAX_TRIED_IMAGES):
        with contextlib.suppress(ValueError):
            named = cdr.read_image(data, type_name).encoding
            break
    codec = codec_of(named)
    if type_name in VIDEO_TYPES and not codec:
        raise InputError(f"{topic} is video coded as {shown(named)}: record it as h264 or h265")
    return codec


class VideoStream:
    """Decodes the video of a topic, message by message; raises InputError where PyAV is not installed."""

    def __init__(self, type_name: str, codec: str, check: FrameCheck) -> None:
        try:
            import av
        except ModuleNotFoundError:
            raise InputError(_INSTALL) from None
        self._av: Any = av
        self._type_name, self._codec, self._check = type_name, codec, check
        self._numbers = FrameNumbers()
        self._count = 0
        self._inside: dict[int, tuple[int, str]] = {}  # frames in the decoder: their number, stamp, camera's frame
        self._lack = NO_KEY_FRAME  # why frames up to the next key frame cannot be decoded; empty: they can

    def take(self, data: bytes, log_time: int) -> Iterator[ImageMessage]:
        """The images that a message completes, this one's or those of earlier ones, with what is wrong with them."""
        try:
            packet = cdr.read_image(data, self._type_name)
        except ValueError as error:
            fault = str(error) if isinstance(error, cdr.StampError) else "damaged message"
            yield self._check.left_out(log_time, "", fault)
            return
        coded = bytes(packet.data)
        follows = self._codec != H264 or self._numbers.follows(coded)
        if is_key_frame(coded, self._codec):
            if self._lack:
                self._open_decoder()
            self._lack = ""
        elif not follows and not self._lack:
            yield from self.finish()
            self._lack = LOST
        if self._lack:
            yield self._check.left_out(packet.stamp, packet.frame_id, self._lack)
            return
        self._count += 1
        self._inside[self._count] = packet.stamp, packet.frame_id
        yield from self._decoded(coded)

    def finish(self) -> Iterator[ImageMessage]:
        """The images that are still in the decoder, after which it takes no more."""
        if not self._lack:
            yield from self._decoded(b"")
        for stamp, frame_id in self._inside.values():
            yield self._check.left_out(stamp, frame_id, DAMAGED)
        self._inside.clear()

    def _open_decoder(self) -> None:
        self._decoder = self._av.CodecContext.create(self._codec, "r")
        self._decoder.thread_type = "SLICE"  # threads of whole frames would give each image late
        self._decoder.options = {"max_pixels": str(MAX_PIXELS)}
        if self._codec == HEVC:  # its decoder then reports a missing reference; that of H.264 does not
            self._decoder.options |= {"err_detect": "explode"}

    def _decoded(self, coded: bytes) -> Iterator[ImageMessage]:
        """What the decoder gives for a coded frame; for none, what it still has."""
        packet = self._av.Packet(coded) if coded else None
        if packet is not None:
            packet.pts = self._count
        try:
            frames = self._decoder.decode(packet)
        except self._av.error.FFmpegError:
            self._lack = LOST
            if self._count in self._inside:
                yield self._check.left_out(*self._inside.pop(self._count), DAMAGED)
            return
        for frame in frames:
            if frame.pts in self._inside:
                stamp, frame_id = self._inside.pop(frame.pts)
                image = cdr.write_image(stamp, frame_id, "bgr8", frame.to_ndarray(format="bgr24"))
                yield self._check.image(image, stamp)
