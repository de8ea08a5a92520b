# SPDX-License-Identifier: Apache-2.0
"""Messages on keyframes between the nodes: what is taken of them, and under which kind one is dropped."""

from __future__ import annotations

from typing import Any

import pytest
from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from pipeprog_camera.limits import MAX_POSES
from pipeprog_msgs.msg import ImageOverlap, ImageOverlapArray, KeyframesRetired
from pipeprog_node import messages
from pipeprog_node.intake import InvalidMessageError
from pipeprog_node.received import keyframes as received_keyframes


def overlaps(**changes: Any) -> ImageOverlapArray:
    image = ImageOverlap(stamp=Time(sec=3), registered=True, overlap=0.5, cell_overlap=0.25)
    for name, value in changes.items():
        setattr(image, name, value)
    return ImageOverlapArray(
        header=messages.header(17, "camera"), keyframes_considered=4, retirements_considered=1, images=[image]
    )


def test_overlaps_are_taken_as_they_are() -> None:
    image = received_keyframes.ReceivedOverlap(3_000_000_000, True, 0.5, 0.25, 0, 0)
    assert received_keyframes.image_overlaps(overlaps()) == received_keyframes.ReceivedOverlaps(17, 4, 1, (image,))


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"overlap": float("nan")}, "overlap"),
        ({"overlap": float("inf")}, "overlap"),
        ({"cell_overlap": -0.1}, "overlap"),
        ({"cell_overlap": 1.1}, "overlap"),
        ({"stamp": Time(sec=-1)}, "stamp"),
    ],
)
def test_overlaps_that_are_no_shares_are_refused(changes: dict[str, Any], kind: str) -> None:
    with pytest.raises(InvalidMessageError) as raised:
        received_keyframes.image_overlaps(overlaps(**changes))
    assert raised.value.kind == kind


def test_the_readout_in_use_is_taken() -> None:
    message = overlaps()
    message.readout = 0.015
    assert received_keyframes.image_overlaps(message).readout == 0.015


@pytest.mark.parametrize("readout", [float("nan"), -0.01, 1.0])
def test_a_readout_that_no_camera_has_is_refused(readout: float) -> None:
    message = overlaps()
    message.readout = readout
    with pytest.raises(InvalidMessageError) as raised:
        received_keyframes.image_overlaps(message)
    assert raised.value.kind == "read-out"


def test_more_answers_than_a_survey_has_keyframes_are_refused() -> None:
    message = overlaps()
    message.keyframes_considered = 2**32 - 1
    with pytest.raises(InvalidMessageError, match="answer to 4294967295 keyframes"):
        received_keyframes.image_overlaps(message)


def test_a_retirement_names_keyframes_that_a_survey_can_have() -> None:
    header = Header(frame_id="camera")
    message = KeyframesRetired(header=header, keyframes_published=3, stamps=[Time(sec=1), Time(sec=2, nanosec=5)])
    assert received_keyframes.retirement(message) == received_keyframes.ReceivedRetirement(
        0, "camera", 3, (10**9, 2 * 10**9 + 5)
    )
    for changed, kind in (
        (KeyframesRetired(keyframes_published=MAX_POSES + 1), "count"),
        (KeyframesRetired(keyframes_published=2**32 - 1), "count"),
        (KeyframesRetired(stamps=[Time()] * (MAX_POSES + 1)), "count"),
        (KeyframesRetired(stamps=[Time(sec=-1)]), "stamp"),
    ):
        with pytest.raises(InvalidMessageError) as caught:
            received_keyframes.retirement(changed)
        assert caught.value.kind == kind
