# SPDX-License-Identifier: Apache-2.0
"""One .db3 file of rosbag2, the format that ROS 2 Humble records by default: an SQLite database of two tables.

A torn or damaged file gives the messages that it still holds. The database is opened read-only and immutable: no file
is made beside it, and a journal that a crash has left there is not replayed.
"""

from __future__ import annotations

import contextlib
import sqlite3
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.recording.inflation import Allowance, plain_message
from pipeprog_bringup.recording.message_file import Channel, Message
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CHANNELS, MAX_CHUNK, MAX_NAME

MAGIC = b"SQLite format 3\0"
_COLUMNS = {"topics": {"id", "name", "type", "serialization_format"}, "messages": {"topic_id", "timestamp", "data"}}
_LISTING = (
    "SELECT timestamp, rowid, topic_id FROM messages WHERE rowid > ? AND typeof(timestamp) = 'integer' "
    "AND typeof(topic_id) = 'integer' AND typeof(data) = 'blob' ORDER BY rowid"
)
_MAX_FAULTS = 100  # damaged places that are stepped over; each costs up to _MAX_STEP queries
_MAX_STEP = 32  # doublings of the step over a damaged place: 2^32 messages


@dataclass
class SqliteFile:
    """Channels, message counts and losses of one file, and its messages; open it with `SqliteFile.open`."""

    path: Path
    channels: dict[int, Channel]
    counts: Counter[int]
    _size: int
    _rows: NDArray[np.int64]  # (N, 3): time [ns], row, channel; in the order of time
    _faults: int  # places in the database where rows cannot be listed
    _unreadable: set[int] = field(default_factory=set)  # rows whose data cannot be read, as far as they were asked for

    @classmethod
    def open(cls, path: Path) -> SqliteFile:
        """List the messages of `path`; raises InputError where it is no recording, or claims more than it can hold."""
        size = path.stat().st_size
        with _connection(path) as database:
            try:
                _require_tables(path, database)
                channels = _channels(path, database)
                rows, faults = _listed_rows(database, Allowance(path, size))
            except sqlite3.Error as error:
                raise InputError(f"{path} cannot be read ({error}): copy it again, or record it again") from None
        rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
        known = np.isin(rows[:, 2], list(channels))
        counts = Counter(rows[known, 2].tolist())
        file = cls(path, channels, counts, size, rows[known], faults)
        file._unreadable.update(rows[~known, 1].tolist())
        return file

    @property
    def message_count(self) -> int:
        """Messages of all channels that are listed."""
        return self.counts.total()

    def messages(self, channel_ids: set[int]) -> Iterator[Message]:
        """The messages of these channels in the order of their log times; holds one of them in memory.

        Raises InputError where they inflate to more than a file can hold.
        """
        allowance = Allowance(self.path, self._size)
        wanted = self._rows[np.isin(self._rows[:, 2], list(channel_ids))]
        with _connection(self.path) as database:
            for log_time, row, channel_id in wanted.tolist():
                data = _data(database, row)
                if data is None:
                    self._unreadable.add(row)
                    continue
                allowance.take_bytes(len(data))
                yield Message(log_time, channel_id, plain_message(data, allowance))

    def losses(self) -> list[str]:
        """The parts that cannot be read, one sentence each; messages with damaged data once they were read."""
        notes = []
        if self._faults:
            notes.append(
                f"{self.path} is torn or damaged: read {self.message_count} messages, lost those between and after them"
            )
        if self._unreadable:
            notes.append(f"{self.path} is damaged: {len(self._unreadable)} messages cannot be read")
        for journal in (self.path.with_name(self.path.name + suffix) for suffix in ("-wal", "-journal")):
            if journal.is_file() and journal.stat().st_size:
                notes.append(
                    f"{journal} holds messages that are not read: run `ros2 bag info` on the recording, which adds "
                    "them to the .db3 file"
                )
        return notes


@contextlib.contextmanager
def _connection(path: Path) -> Iterator[sqlite3.Connection]:
    try:
        # A replay may close its recording from another thread than the one that has read it.
        uri = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"
        database = sqlite3.connect(uri, uri=True, check_same_thread=False)
    except sqlite3.Error as error:
        raise InputError(f"{path} cannot be opened ({error}): copy it again") from None
    try:
        database.text_factory = lambda text: text.decode(errors="replace")
        # SQLite opens a file that is shorter than it says only so; nothing can be written.
        database.execute("PRAGMA writable_schema=ON")
        database.execute("PRAGMA trusted_schema=OFF")
        yield database
    finally:
        database.close()


def _require_tables(path: Path, database: sqlite3.Connection) -> None:
    """Raises InputError where a table is not as rosbag2 makes it: a view or a computed column could run for ever."""
    for table, columns in _COLUMNS.items():
        kinds = database.execute("SELECT type, sql LIKE 'CREATE TABLE%' FROM sqlite_master WHERE name = ?", (table,))
        described = database.execute(f"PRAGMA table_xinfo({table})").fetchmany(MAX_CHANNELS)
        stored = {name for _, name, _, _, _, _, hidden in described if not hidden}
        if kinds.fetchmany(2) != [("table", 1)] or not columns <= stored:
            raise InputError(
                f"{path} is an SQLite database but no rosbag2 recording (table {table} is missing or other than "
                "rosbag2's): give an .mcap file or a rosbag2 folder"
            )


def _channels(path: Path, database: sqlite3.Connection) -> dict[int, Channel]:
    columns = ", ".join(f"substr({name}, 1, {MAX_NAME + 1})" for name in ("name", "type", "serialization_format"))
    found = database.execute(f"SELECT id, {columns} FROM topics").fetchmany(MAX_CHANNELS + 1)
    if len(found) > MAX_CHANNELS:
        raise InputError(f"{path} has more than {MAX_CHANNELS} topics: it is no recording of a robot")
    return {
        number: Channel(topic, type_name, encoding)
        for number, topic, type_name, encoding in found
        if isinstance(number, int) and all(_is_name(text) for text in (topic, type_name, encoding))
    }


def _is_name(text: object) -> bool:
    return isinstance(text, str) and len(text) <= MAX_NAME and text.isprintable()


def _listed_rows(database: sqlite3.Connection, allowance: Allowance) -> tuple[NDArray[np.int64], int]:
    """(N, 3) time, row and channel of the messages, and the damaged places between which they lie."""
    rows = array("q")
    faults = step = 0
    start = -1
    while faults < _MAX_FAULTS and step < _MAX_STEP:
        try:
            for row in database.execute(_LISTING, (start + (1 << step >> 1),)):
                allowance.take_records(1)
                if row[1] <= start:  # in a sound table rows ascend
                    raise sqlite3.DatabaseError("rows out of order")
                rows.extend(row)
                start, step = row[1], 0
            return np.array(rows).reshape(-1, 3), faults
        except sqlite3.DatabaseError:
            faults += not step
            step += 1
    return np.array(rows).reshape(-1, 3), faults


def _data(database: sqlite3.Connection, row: int) -> bytes | None:
    """The data of a message; None where it cannot be read or is longer than any."""
    with contextlib.suppress(sqlite3.Error, MemoryError):
        query = database.execute("SELECT data FROM messages WHERE rowid = ? AND length(data) <= ?", (row, MAX_CHUNK))
        found = query.fetchone()
        if found and isinstance(found[0], bytes):
            return found[0]
    return None
