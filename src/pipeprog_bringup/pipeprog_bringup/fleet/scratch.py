# SPDX-License-Identifier: Apache-2.0
"""The scratch folder of a local cluster; that of one that was killed is removed by the next."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from pipeprog_bringup.results.folder_lock import locked

_PREFIX = "pipeprog-fleet-"


@contextlib.contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder that is locked as long as the context lasts, and removed at its end.

    Folders beside it that nobody holds locked are removed before: the kernel gives up the locks of a killed process.
    """
    for left in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):  # locked, another user's, or gone
            os.close(locked(left))
            shutil.rmtree(left, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
    lock = locked(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)
