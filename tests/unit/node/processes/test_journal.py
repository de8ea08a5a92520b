# SPDX-License-Identifier: Apache-2.0
"""The journal: what was written down can be read again, elsewhere."""

import errno
import pickle
import subprocess
import sys
from pathlib import Path
from typing import IO

import pytest

from pipeprog_camera.errors import InputError
from pipeprog_node.processes.journal import Journal

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


def test_what_a_killed_process_wrote_is_taken_up_less_what_was_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    killed = Journal(path)
    for number in range(4):
        killed.write(number, ("command", number), waits=number > 0)
    killed.answered(1)
    killed.remove(2)
    killed.write_note("first")
    killed.write_note("second")
    killed.write(4, bytes(10_000))
    whole = path.read_bytes()
    for cut in (len(whole) - 1, len(whole) - 5_000, len(whole) - 10_020):
        path.write_bytes(whole[:cut])
        taken = Journal(path)
        assert list(taken.commands()) == [(0, ("command", 0)), (1, ("command", 1)), (3, ("command", 3))]
        assert (list(taken.waiting), taken.note, taken.end) == ([3], "second", 4)
        taken.write(4, "later")
        taken.close()
        again = Journal(path)
        assert list(again.record(5))[-1] == "later"


def test_a_journal_that_others_may_have_written_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    Journal(path).write(0, "command")
    path.chmod(0o666)
    with pytest.raises(InputError, match="others"):
        Journal(path)
    path.chmod(0o600)
    (tmp_path / "link").symlink_to(path)
    with pytest.raises(InputError, match="link"):
        Journal(tmp_path / "link")


def full(command: object, file: IO[bytes]) -> None:
    file.write(b"cut off")
    raise OSError(errno.ENOSPC, "No space left on device")
