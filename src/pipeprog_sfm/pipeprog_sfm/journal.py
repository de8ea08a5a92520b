# SPDX-License-Identifier: Apache-2.0
"""The commands that a process was given, on disk, so that another process can take its place."""

from __future__ import annotations

import os
import pickle
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Record:
    """Where commands lie, for another process of this machine while the journal is open."""

    path: str
    offsets: Sequence[int]

    def __iter__(self) -> Iterator[Any]:
        """The commands, one at a time."""
        with open(self.path, "rb") as file:
            for offset in self.offsets:
                file.seek(offset)
                yield pickle.load(file)


class Journal:
    """Picklable commands in a file without a name: it is gone with the process, however that ends."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115  # open as long as the journal
        self._offsets: list[int] = []

    def __len__(self) -> int:
        return len(self._offsets)

    def append(self, command: Any) -> None:
        """Appends a command."""
        self._offsets.append(self._file.seek(0, os.SEEK_END))
        pickle.dump(command, self._file)
        self._file.flush()

    def remove(self, number: int) -> None:
        """Removes a command."""
        del self._offsets[number]

    def record(self, begin: int, end: int) -> Record:
        """Commands begin to end - 1."""
        # The name of an open file that has none (Linux).
        return Record(f"/proc/{os.getpid()}/fd/{self._file.fileno()}", tuple(self._offsets[begin:end]))

    def close(self) -> None:
        """Closes and so deletes the file."""
        self._file.close()
