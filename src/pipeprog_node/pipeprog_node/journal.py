# SPDX-License-Identifier: Apache-2.0
"""The commands that a process was given, on disk, so that another process can take its place."""

from __future__ import annotations

import os
import pickle
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import IO, Any


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
                yield pickle.load(file)


class Journal:
    """Picklable commands by ascending numbers, in a file without a name: it is gone with the process."""

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._offsets: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._offsets)

    def write(self, number: int, command: Any) -> None:
        """Writes a command; raises OSError where there is no place for it."""
        if self._file is None:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115  # open as long as the journal
        offset = self._file.seek(0, os.SEEK_END)
        pickle.dump(command, self._file)
        self._file.flush()
        self._offsets[number] = offset

    def remove(self, number: int) -> None:
        """Removes a command, where it was written."""
        self._offsets.pop(number, None)

    def read(self, number: int) -> Any:
        """A command that was written and not removed; raises KeyError for others."""
        return next(iter(self._of((self._offsets[number],))))

    def record(self, end: int) -> Record:
        """The commands with numbers below `end`."""
        return self._of(tuple(offset for number, offset in self._offsets.items() if number < end))

    def close(self) -> None:
        """Closes and so deletes the file."""
        if self._file is not None:
            self._file.close()

    def _of(self, offsets: tuple[int, ...]) -> Record:
        # The name of an open file that has none (Linux).
        return Record(f"/proc/{os.getpid()}/fd/{self._file.fileno()}" if self._file is not None else "", offsets)
