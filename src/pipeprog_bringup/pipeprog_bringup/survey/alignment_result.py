# SPDX-License-Identifier: Apache-2.0
"""What the result of the action says of the frame of a survey that was to lie in that of an earlier one."""

from __future__ import annotations

from pathlib import Path

from pipeprog_msgs.action import Survey
from pipeprog_sfm.alignment.map_file import read_map

_BEFORE_ALIGNMENT = "not aligned with the reference, so the pipes are in a frame of their own: only the last map of a "
_BEFORE_ALIGNMENT += "survey is aligned, and this one was ended before"


def note_alignment(result: Survey.Result, path: Path) -> None:
    """Notes how well the survey lies in the frame of its reference, or NOT_ALIGNED and why.

    The code of a survey that has failed stays, since NOT_ALIGNED says that the pipes can be used.

    `path`: of the map.npz of a survey with pipes; it is there where the last map was made.
    """
    survey = read_map(path) if path.is_file() else None
    if survey is not None and survey.aligned_by:
        result.reference_covariance = survey.alignment_covariance[:6, :6].ravel()
        return
    reason = _BEFORE_ALIGNMENT if survey is None else result.sfm.message
    if result.error_code in (Survey.Result.NONE, Survey.Result.NO_SPACE):
        result.error_code = Survey.Result.NOT_ALIGNED
    result.error_msg = "; ".join(filter(None, (reason, result.error_msg)))


def is_aligned(result: Survey.Result) -> bool:
    """Whether the pipes of a survey that was written lie in the frame of its reference."""
    return bool(result.folder) and bool(result.reference_covariance.any())
