# SPDX-License-Identifier: Apache-2.0
"""What a survey has changed since its reference, as a message: what `pipeprog compare` tells of the two folders."""

from __future__ import annotations

from pathlib import Path

from std_msgs.msg import Header

from pipeprog_bringup.comparison.comparison import compare
from pipeprog_bringup.results.results_reader import read_results
from pipeprog_msgs.msg import PipeChange, SiteProgress

_STATES = {name: getattr(PipeChange, name.upper()) for name in ("kept", "longer", "shorter", "new", "gone", "not_seen")}


def site_progress(earlier: Path, later: Path, header: Header) -> SiteProgress:
    """The changes from one folder of results to another in its frame; raises InputError where they cannot be told."""
    (step,) = compare([read_results(earlier), read_results(later)])
    return SiteProgress(
        header=header,
        earlier=step.earlier,
        later=step.later,
        pipes=[
            PipeChange(
                id=each.life,
                class_name=each.change.class_name,
                state=_STATES[each.change.state],
                pipes=list(each.change.after),
                length_before=each.change.length_before,
                length_after=each.change.length_after,
                counted=each.change.counted,
                grown=each.change.grown,
            )
            for each in step.pipes
        ],
    )
