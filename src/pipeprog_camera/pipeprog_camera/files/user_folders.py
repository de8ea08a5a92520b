# SPDX-License-Identifier: Apache-2.0
"""Where libraries keep files between runs for a user whose home folder is missing, full or read-only.

Numba keeps compiled functions beside their sources or, where those are read-only, in the user's cache folder, and ends
the program where it can write neither; Matplotlib and ROS need a folder of the user's as well. All of them ask
environment variables for it, and child processes inherit these.
"""

from __future__ import annotations

import os
import shutil
import stat
from pathlib import Path

from pipeprog_camera.errors import InputError

# Variable -> its default in the home folder, as the XDG base directory specification and ROS have them.
_DEFAULTS = {"XDG_CACHE_HOME": ".cache", "XDG_CONFIG_HOME": ".config", "ROS_HOME": ".ros"}
_ROOM = 1 << 25  # bytes; 32 MB: all compiled functions take 6, Matplotlib's list of fonts and logs less than 1
_PREFIX = "pipeprog-home-"


def provide_user_folders() -> None:
    """Sets each variable whose folder cannot be written to a private temporary folder, the same for the next run.

    Variables whose folder can be written stay as they are. Raises InputError where compiled functions can be kept
    nowhere: not beside the sources, in no folder of the user's and in no temporary one.
    """
    unusable = [name for name, default in _DEFAULTS.items() if not _usable(_folder(name, default))]
    home = _private_folder() if unusable else None
    if home is not None:
        os.environ.update({name: str(home / _DEFAULTS[name]) for name in unusable})
    elif "XDG_CACHE_HOME" in unusable and not _usable(Path(__file__).parent):
        raise InputError(
            "compiled functions can be kept nowhere: neither the installation nor the home folder nor one for "
            f"temporary files can be written and has {_ROOM >> 20} MB left: let TMPDIR name a folder that has them"
        )


def _folder(variable: str, default: str) -> Path:
    """The folder of a variable; a relative path where the user has no home, as a container's may."""
    return Path(os.environ.get(variable) or Path(os.path.expanduser("~"), default))


def _usable(folder: Path) -> bool:
    """Whether files can be made in a folder, which is made itself where it does not exist."""
    if not folder.is_absolute():
        return False
    existing = next((path for path in (folder, *folder.parents) if os.path.lexists(path)), Path("/"))
    try:
        return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK) and shutil.disk_usage(existing).free > _ROOM
    except OSError:
        return False


def _private_folder() -> Path | None:
    """A folder in the temporary one that nobody else can write or foresee: an earlier run's, or a new one.

    Numba's files are programs: they are read from a folder of our own alone.
    """
    import tempfile

    try:
        temporary = Path(tempfile.gettempdir())
        if not _usable(temporary):
            return None
        earlier = sorted(path for path in temporary.glob(f"{_PREFIX}*") if _is_private(path))
        return earlier[0] if earlier else Path(tempfile.mkdtemp(prefix=_PREFIX))
    except OSError:
        return None


def _is_private(path: Path) -> bool:
    status = path.lstat()
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o077
