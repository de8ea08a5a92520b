# SPDX-License-Identifier: Apache-2.0
"""What a file is by its keys, where it is not what it was given for: files are swapped on command lines."""

from __future__ import annotations

from typing import Any

# Keys that a file of the kind has, and what it is; the first that fits.
_KINDS = (
    ({"pipes", "scale", "classes"}, "it holds results, a pipes.json"),
    ({"pipes", "camera_to_world"}, "it holds a site's ground truth"),
    ({"classes"}, "it is a bill of quantities, which --boq takes"),
    ({"boards"}, "it is a board file, which --board takes"),
    ({"marks"}, "it is a board file, which --board takes"),
    ({"camera_matrix"}, "it is a camera calibration, which --camera of `pipeprog ingest` takes"),
    ({"recordings"}, "it is a list of recordings, for `pipeprog fleet`"),
)


def kind_of(content: Any) -> str:
    """What a file with this content is, in words; empty where its keys do not tell."""
    if not isinstance(content, dict):
        return ""
    return next((words for keys, words in _KINDS if keys <= content.keys()), "")
