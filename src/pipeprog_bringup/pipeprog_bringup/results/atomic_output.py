# SPDX-License-Identifier: Apache-2.0
"""The folder of a run's results: all new files appear in it together, or none does."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from pipeprog_bringup.results.folder_lock import locked
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.json_file import read_json

_STAGE_PREFIX = ".pipeprog-"
JOURNAL = "journal"  # folder among the new files that is no result: it is there until these have their names
_FULL = (errno.ENOSPC, errno.EDQUOT)
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class OutputFolder:
    """Context in which a run writes its files.

    Files are written into a hidden folder within `path`, which is on the same disk, and move to their names when the
    context ends well; when it ends with an exception, nothing of the run is left. With `force` the results of an
    earlier run are replaced at that moment and not before; files that pipeprog did not write stay where they are.
    """

    def __init__(self, path: Path, force: bool = False, left: Path | None = None) -> None:
        """`left`: the hidden folder of a run that was killed, which this one goes on with; see `left_behind`."""
        self.path = path
        self._force = force
        self._left = left
        self._made: list[Path] = []
        self._stage = path
        self._lock = -1

    def __enter__(self) -> OutputFolder:
        try:
            if self._left is None:
                self._make_stage()
            else:
                self._stage = self._left
            self._lock = locked(self._stage)
            self._stage.joinpath(".probe").write_bytes(bytes(4096))
            self._stage.joinpath(".probe").unlink()
        except OSError as error:
            self._discard()
            raise _explained(self.path, error) from None
        except InputError:
            self._discard()
            raise
        return self

    def file(self, name: str) -> Path:
        """Where to write the file that will be `path`/`name`; the name may lead into a folder."""
        return self._stage / name

    def names(self) -> list[str]:
        """The files written so far, relative to the folder."""
        files = [file.relative_to(self._stage) for file in self._stage.rglob("*") if file.is_file()]
        return sorted(str(file) for file in files if file.parts[0] != JOURNAL)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                with _uninterrupted():
                    self._publish()
        except OSError as failure:
            raise _explained(self.path, failure) from None
        finally:
            self._discard(keep_folder=error is None)
        if isinstance(error, OSError) and error.errno in _FULL:
            raise _explained(self.path, error) from None

    def _make_stage(self) -> None:
        self._make_folders()
        self._remove_leftovers()
        if not self._force and any(self.path.iterdir()):
            raise InputError(f"{self.path} is not empty: choose another --out, or replace its results with --force")
        self._stage = Path(tempfile.mkdtemp(prefix=_STAGE_PREFIX, dir=self.path))

    def _make_folders(self) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"{self.path} is a file: choose a folder for --out")
        missing = [self.path, *self.path.parents]
        for folder in reversed([folder for folder in missing if not folder.exists()]):
            folder.mkdir()
            self._made.append(folder)

    def _remove_leftovers(self) -> None:
        """Remove what a killed run left; a run that still writes here holds its lock."""
        if sys.platform == "win32":
            return  # without locks the two are not told apart
        for stage in self.path.glob(f"{_STAGE_PREFIX}*"):
            try:
                os.close(locked(stage))
            except BlockingIOError:
                raise InputError(
                    f"another run is writing to {self.path}: wait for it, or choose another --out"
                ) from None
            shutil.rmtree(stage)

    def _publish(self) -> None:
        """Move the new files to their names and remove those of the earlier run that have no successor."""
        names = self.names()
        for name in names:
            with (self._stage / name).open("rb+") as stream:
                os.fsync(stream.fileno())
        stale = set(self._earlier_files()) - set(names)
        for name in names:
            (self.path / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(self._stage / name, self.path / name)
        for name in stale:
            (self.path / name).unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                (self.path / name).parent.rmdir()  # a folder that is empty now

    def _earlier_files(self) -> list[str]:
        """The files that the run.json in the folder lists as its own."""
        try:
            names = read_json(self.path / "run.json")["files"]
            return [name for name in names if isinstance(name, str) and self._is_inside(name)]
        except (InputError, KeyError, TypeError):
            return []

    def _is_inside(self, name: str) -> bool:
        """Whether a name is that of a file in this folder: not outside, nor in a folder that a link leads to."""
        try:
            path = self.path / name
            return path.is_file() and path.parent.resolve().is_relative_to(self.path.resolve())
        except (OSError, ValueError):  # a name that no file system has: NUL, too long
            return False

    def _discard(self, keep_folder: bool = False) -> None:
        if self._stage != self.path:
            shutil.rmtree(self._stage, ignore_errors=True)
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1
        if not keep_folder:
            for folder in reversed(self._made):
                with contextlib.suppress(OSError):
                    folder.rmdir()


def left_behind(path: Path) -> Iterator[Path]:
    """The hidden folders that killed runs have left in the folder `path`; those of runs that still write, without."""
    for stage in path.glob(f"{_STAGE_PREFIX}*"):
        with contextlib.suppress(OSError):
            os.close(locked(stage))
            yield stage


@contextlib.contextmanager
def output_file(path: Path, force: bool = False) -> Iterator[Path]:
    """A temporary path beside `path` that takes its name when the context ends well and vanishes otherwise."""
    if path.is_dir():
        raise InputError(f"{path} is a folder: choose a file for --out")
    if path.exists() and not force:
        raise InputError(f"{path} exists: choose another --out, or replace it with --force")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(prefix=_STAGE_PREFIX, suffix=path.suffix, dir=path.parent)
    except OSError as error:
        raise _explained(path.parent, error) from None
    os.close(descriptor)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes files that only their owner may read.
        temporary.chmod(0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        raise _explained(path.parent, error) from None
    finally:
        temporary.unlink(missing_ok=True)


def _explained(folder: Path, error: OSError) -> InputError:
    if error.errno in _FULL:
        return InputError(f"no space left for the results in {folder}: free some, or choose another --out")
    return InputError(f"cannot write to {folder}: {error.strerror or error}: choose another --out")


def _umask() -> int:
    value = os.umask(0)
    os.umask(value)
    return value


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back for the few renames that must happen together."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pending: list[int] = []
    previous = {number: signal.signal(number, lambda caught, _: pending.append(caught)) for number in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        for caught in pending:
            signal.raise_signal(caught)
