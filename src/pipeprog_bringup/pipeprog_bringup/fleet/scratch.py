# SPDX-License-Identifier: Apache-2.0
"""The scratch folder of a local cluster; that of one that was killed is removed by the next."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

_PREFIX = "pipeprog-fleet-"


@contextlib.contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder that is locked as long as the context lasts, and removed at its end.

    Folders beside it that nobody holds locked are removed before: the kernel gives up the locks of a killed process.
    """
    for left in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):  # locked, another user's, or gone
            os.close(_locked(left))
            shutil.rmtree(left, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
    lock = _locked(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _locked(folder: Path) -> int:
    """Descriptor that holds a folder locked; raises OSError where another process does."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor
