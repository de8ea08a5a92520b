# SPDX-License-Identifier: Apache-2.0
"""The temporary folder of a replay, and whether it has the room that a recording takes."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from pipeprog_bringup.playback.node_processes import NodeFailure
from pipeprog_camera.errors import InputError

_LOGS = 1 << 24  # bytes; 16 MB for logs, parameter files and the journal of keyframes that are still to be worked off


def check_room(recording: Path) -> None:
    """Raises InputError where temporary files can be made nowhere, or the recording's images have no room there."""
    try:
        folder = tempfile.gettempdir()
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise InputError(
            f"no folder for temporary files can be written ({error.strerror or error}): let TMPDIR name one that can"
        ) from None
    needed = _size(recording) + _LOGS
    if free < needed:
        raise InputError(
            f"{folder} has {free / 1e6:.0f} MB left, and a replay of {recording} takes {needed / 1e6:.0f} MB there: "
            "make room, or let TMPDIR name a folder that has it"
        )


@contextlib.contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder for parameter files and logs, removed at the end; kept where a node failed, for its log."""
    path = Path(tempfile.mkdtemp(prefix="pipeprog-"))
    try:
        yield path
    except NodeFailure:
        raise
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise
    shutil.rmtree(path, ignore_errors=True)


def _size(recording: Path) -> int:
    """Bytes of a file, or of the files in a folder; what is wrong with a recording its reader says."""
    files = recording.iterdir() if recording.is_dir() else [recording]
    return sum(file.stat().st_size for file in files if file.is_file())
