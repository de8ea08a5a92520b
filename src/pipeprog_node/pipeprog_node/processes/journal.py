# SPDX-License-Identifier: Apache-2.0
"""The commands that a process was given, on disk, so that another process can take its place."""

from __future__ import annotations

import contextlib
import os
import pickle
import stat
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from pipeprog_camera.errors import InputError

_COMMAND, _WAITING, _ANSWERED, _REMOVED, _NOTE = range(5)  # kinds of entries; a command that waits for its answer
_OTHERS = stat.S_IWGRP | stat.S_IWOTH  # who may not have written what is unpickled here


@dataclass(frozen=True)
class Record:
    """Where commands lie, for another process of this machine while the journal is open."""

    path: str
    offsets: Sequence[int]

    def __iter__(self) -> Iterator[Any]:
        """The commands, one at a time."""
        if not self.offsets:
            return
        with open(self.path, "rb") as file:
            for offset in self.offsets:
                file.seek(offset)
                yield pickle.load(file)[2]


def journal_of(folder: str, name: str) -> Journal | None:
    """The journal that a node of this name keeps in a folder of its survey; None without a folder."""
    return Journal(Path(folder) / f"{name}.journal") if folder else None


def written(path: Path) -> Iterator[Any]:
    """The commands in a journal that another process is writing, in their order; none where it is not there.

    Raises InputError where somebody else may have written it.
    """
    try:
        file = _own(path, os.O_RDONLY, "rb")
    except FileNotFoundError:
        return
    with file, contextlib.suppress(EOFError, pickle.UnpicklingError):  # the last one is not whole yet
        while True:
            kind, _, content = pickle.load(file)
            if kind in (_COMMAND, _WAITING):
                yield content


def _own(path: Path, flags: int, mode: str) -> IO[bytes]:
    """The file opened: what others may have written is not unpickled, since that could run their code."""
    number = os.open(path, flags | os.O_NOFOLLOW, stat.S_IRUSR | stat.S_IWUSR)
    file: IO[bytes] = os.fdopen(number, mode)
    status = os.fstat(number)
    if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & _OTHERS:
        file.close()
        raise InputError(f"{path}: others than this user may have written it: it is not taken for a journal")
    return file


class Journal:
    """Picklable commands by ascending numbers, and a note.

    Without a path the file has no name, and is gone with the process. With one, a process that is started in place of
    one that was killed takes up what that had written; an entry that was cut off by the kill is dropped.

    Attributes:
        note: what was noted last; None: nothing.
        waiting: numbers of commands without an answer, in their order.
    """

    def __init__(self, path: Path | None = None) -> None:
        """Raises InputError where there is no place for the file, or somebody else may have written it."""
        self._file: IO[bytes] | None = None
        self._offsets: dict[int, int] = {}
        self.note: Any = None
        self.waiting: dict[int, None] = {}
        if path is not None:
            self._open(path)

    def __len__(self) -> int:
        return len(self._offsets)

    @property
    def end(self) -> int:
        """The number after the last command's."""
        return next(reversed(self._offsets), -1) + 1

    def write(self, number: int, command: Any, waits: bool = False) -> None:
        """Writes a command, which may wait for an answer; raises OSError where there is no place for it."""
        self._offsets[number] = self._append((_WAITING if waits else _COMMAND, number, command))
        if waits:
            self.waiting[number] = None

    def answered(self, number: int) -> None:
        """Notes that a command waits no more; raises OSError."""
        if number in self.waiting:
            del self.waiting[number]
            self._append((_ANSWERED, number, None))

    def remove(self, number: int) -> None:
        """Removes a command, where it was written; raises OSError."""
        if number in self._offsets:
            del self._offsets[number]
            self.waiting.pop(number, None)
            self._append((_REMOVED, number, None))

    def write_note(self, note: Any) -> None:
        """Writes a note in place of the last one; raises OSError."""
        self._append((_NOTE, 0, note))
        self.note = note

    def commands(self) -> Iterator[tuple[int, Any]]:
        """Number and content of each command."""
        for number in self._offsets:
            yield number, self.read(number)

    def read(self, number: int) -> Any:
        """A command that was written and not removed; raises KeyError for others."""
        return next(iter(self._of((self._offsets[number],))))

    def record(self, end: int) -> Record:
        """The commands with numbers below `end`."""
        return self._of(tuple(offset for number, offset in self._offsets.items() if number < end))

    def close(self) -> None:
        """Closes the file; one without a name is deleted by it."""
        if self._file is not None:
            self._file.close()

    def _append(self, entry: tuple[int, int, Any]) -> int:
        if self._file is None:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115  # open as long as the journal
        offset = self._file.seek(0, os.SEEK_END)
        try:
            pickle.dump(entry, self._file)
            self._file.flush()
        except OSError:
            self._file.truncate(offset)
            raise
        return offset

    def _open(self, path: Path) -> None:
        try:
            self._file = _own(path, os.O_RDWR | os.O_CREAT, "r+b")
        except OSError as error:
            raise InputError(f"{path}: the journal of the survey cannot be opened: {error.strerror}") from None
        while True:
            offset = self._file.tell()
            try:
                kind, number, content = pickle.load(self._file)
            except (EOFError, pickle.UnpicklingError):
                self._file.truncate(offset)
                return
            self._take(kind, number, content, offset)

    def _take(self, kind: int, number: int, content: Any, offset: int) -> None:
        if kind == _NOTE:
            self.note = content
        elif kind == _ANSWERED:
            self.waiting.pop(number, None)
        elif kind == _REMOVED:
            self._offsets.pop(number, None)
            self.waiting.pop(number, None)
        else:
            self._offsets[number] = offset
            if kind == _WAITING:
                self.waiting[number] = None

    def _of(self, offsets: tuple[int, ...]) -> Record:
        # The name of an open file that has none (Linux).
        return Record(f"/proc/{os.getpid()}/fd/{self._file.fileno()}" if self._file is not None else "", offsets)
