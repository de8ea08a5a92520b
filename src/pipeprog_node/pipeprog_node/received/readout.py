# SPDX-License-Identifier: Apache-2.0
"""Read-outs in messages from outside, checked, or InvalidMessageError."""

from __future__ import annotations

from pipeprog_camera.errors import InputError
from pipeprog_camera.rolling_shutter import check_readout
from pipeprog_node.intake import InvalidMessageError


def checked_readout(readout: float) -> float:
    """A read-out, s, that a rolling shutter can have; 0: none."""
    try:
        check_readout(readout)
    except InputError as error:
        raise InvalidMessageError("read-out", str(error)) from None
    return readout
