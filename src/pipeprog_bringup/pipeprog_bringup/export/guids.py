# SPDX-License-Identifier: Apache-2.0
"""GUIDs that are made of names: the same results name the same objects in every file."""

from __future__ import annotations

import uuid

_NAMESPACE = uuid.UUID("5c1f0d0e-3a54-4a8e-9d1b-0f7f6c1f2b11")  # where all names of pipeprog's objects begin
_DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz_$"  # of buildingSMART, 6 bits each


def uuid_of(key: str) -> uuid.UUID:
    """The UUID of a key."""
    return uuid.uuid5(_NAMESPACE, key)


def ifc_guid(key: str) -> str:
    """The UUID of a key as IFC writes it: 22 digits of 6 bits."""
    number = uuid_of(key).int
    return "".join(_DIGITS[number >> shift & 63] for shift in range(126, -1, -6))


def pipe_guid(pipe_id: str) -> str:
    """The GUID of a pipe's IfcPipeSegment."""
    return ifc_guid(f"IfcPipeSegment/{pipe_id}/1")
