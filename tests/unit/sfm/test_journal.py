# SPDX-License-Identifier: Apache-2.0
"""The journal: what was written down can be read again, elsewhere."""

import pickle
import subprocess
import sys

from pipeprog_sfm.journal import Journal

READ = "import pickle, sys; print(list(pickle.loads(bytes.fromhex(sys.argv[1]))))"


def test_another_process_reads_what_was_written_less_what_was_struck_out() -> None:
    journal = Journal()
    for number in range(5):
        journal.append(("command", number))
    journal.remove(3)
    assert len(journal) == 4
    record = pickle.dumps(journal.record(1, 4)).hex()
    said = subprocess.run([sys.executable, "-c", READ, record], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "[('command', 1), ('command', 2), ('command', 4)]"
    journal.append("later")
    assert list(journal.record(3, 5)) == [("command", 4), "later"]
    journal.close()
