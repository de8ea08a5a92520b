# SPDX-License-Identifier: Apache-2.0
"""What the frames node and the SfM tell each other of keyframes, checked: values, or InvalidMessageError."""

from __future__ import annotations

from dataclasses import dataclass

from pipeprog_camera.limits import (
    MAX_OVERLAP,
    MAX_POSES,
)
from pipeprog_msgs.msg import ImageOverlap, ImageOverlapArray, KeyframesRetired
from pipeprog_node.intake import InvalidMessageError
from pipeprog_node.received.header import checked_stamp, stamp_and_frame
from pipeprog_node.received.readout import checked_readout


@dataclass(frozen=True)
class ReceivedRetirement:
    """Stamps [ns] of keyframes that leave the map once `keyframes_published` keyframes have come."""

    stamp: int
    frame_id: str
    keyframes_published: int
    stamps: tuple[int, ...]


@dataclass(frozen=True)
class ReceivedOverlap:
    """Overlap of one keyframe; fields as in pipeprog_msgs/ImageOverlap, the stamp in ns."""

    stamp: int
    registered: bool
    overlap: float
    cell_overlap: float
    matches_previous: int
    matches_next: int
    place_overlap: float = 0.0


@dataclass(frozen=True)
class ReceivedOverlaps:
    """One answer of the SfM: stamp [ns] of the newest keyframe it has considered, counts, overlaps that changed.

    readout: of the rolling shutter in use, s; 0: none, or none known yet.
    """

    stamp: int
    keyframes: int
    retirements: int
    images: tuple[ReceivedOverlap, ...]
    readout: float = 0.0


def retirement(message: KeyframesRetired) -> ReceivedRetirement:
    """Keyframes to be retired: numbers that a survey can reach, and stamps that are times."""
    stamp, frame_id = stamp_and_frame(message.header)
    if max(message.keyframes_published, len(message.stamps)) > MAX_POSES:
        raise InvalidMessageError(
            "count",
            f"{len(message.stamps)} keyframes are to be retired after {message.keyframes_published}: "
            f"{MAX_POSES} at most are taken",
        )
    stamps = tuple(checked_stamp(each) for each in message.stamps)
    return ReceivedRetirement(stamp, frame_id, message.keyframes_published, stamps)


def image_overlaps(message: ImageOverlapArray) -> ReceivedOverlaps:
    """Overlaps from 0 to 1, of no more keyframes than a survey can reach, and a read-out that a camera has."""
    stamp, _ = stamp_and_frame(message.header)
    counts = message.keyframes_considered, message.retirements_considered, len(message.images)
    if max(counts) > MAX_POSES:
        raise InvalidMessageError(
            "count",
            "an answer to {} keyframes and {} retirements with the overlaps of {}".format(*counts)
            + f": {MAX_POSES} at most are taken",
        )
    readout = checked_readout(message.readout)
    return ReceivedOverlaps(stamp, *counts[:2], tuple(_overlap(image) for image in message.images), readout)


def _overlap(image: ImageOverlap) -> ReceivedOverlap:
    for value in (image.overlap, image.cell_overlap, image.place_overlap):
        if not 0.0 <= value <= MAX_OVERLAP:  # false for NaN
            raise InvalidMessageError("overlap", f"an overlap of {value:g}: it is a share of the image, from 0 to 1")
    return ReceivedOverlap(
        checked_stamp(image.stamp),
        image.registered,
        image.overlap,
        image.cell_overlap,
        image.matches_previous,
        image.matches_next,
        image.place_overlap,
    )
