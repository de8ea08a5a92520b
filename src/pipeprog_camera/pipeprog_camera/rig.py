# SPDX-License-Identifier: Apache-2.0
"""Several cameras of one robot."""

from __future__ import annotations


def unique_stamp(stamp: int, number: int) -> int:
    """The stamp [ns] of an image of the camera of this number, from 0 on.

    Cameras that are triggered together stamp their images alike, and stamps are what all nodes know keyframes by. A
    nanosecond for each camera changes nothing that is measured.
    """
    return stamp + number
