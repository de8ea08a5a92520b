# SPDX-License-Identifier: Apache-2.0
"""The journal: what was written down can be read again, elsewhere."""

import errno
import pickle
import subprocess
import sys
from typing import IO

import pytest

from pipeprog_node.journal import Journal

READ = "import pickle, sys; print(list(pickle.loads(bytes.fromhex(sys.argv[1]))))"


def test_another_process_reads_what_was_written_less_what_was_struck_out() -> None:
    journal = Journal()
    assert list(journal.record(9)) == []
    for number in range(5):
        journal.write(number, ("command", number))
    journal.remove(3)
    journal.remove(3)
    assert len(journal) == 4
    record = pickle.dumps(journal.record(4)).hex()
    said = subprocess.run([sys.executable, "-c", READ, record], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "[('command', 0), ('command', 1), ('command', 2)]"
    journal.write(7, "later")
    assert list(journal.record(8))[-2:] == [("command", 4), "later"]
    assert journal.read(7) == "later"
    journal.close()


def test_what_there_is_no_room_for_is_not_in_the_record(monkeypatch: pytest.MonkeyPatch) -> None:
    journal = Journal()
    journal.write(0, "first")
    monkeypatch.setattr(pickle, "dump", full)
    with pytest.raises(OSError, match="No space"):
        journal.write(1, "second")
    monkeypatch.undo()
    journal.write(2, "third")
    assert list(journal.record(3)) == ["first", "third"]
    journal.close()


def full(command: object, file: IO[bytes]) -> None:
    file.write(b"cut off")
    raise OSError(errno.ENOSPC, "No space left on device")
