# SPDX-License-Identifier: Apache-2.0
"""What a node `survey` leaves besides its survey's journal for one that is started in its place."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from rclpy.serialization import deserialize_message, serialize_message

from pipeprog_bringup.survey.sign_of_life import is_alive, sign
from pipeprog_msgs.action import Survey

SIGN_PERIOD = 1.0  # s between two signs of life


class Takeover:
    """That a node is active, and the answer to its last survey, which its client may not have got.

    Attributes:
        was_active: whether a node of this name was active when it was killed a moment ago.
    """

    def __init__(self, results: Path, node: str) -> None:
        """`results`: the folder of the surveys; `node`: the full name of the node."""
        self._folder = results / node.replace("/", ".")  # /survey: .survey
        self._active, self._answer = self._folder / "active", self._folder / "answer.cdr"
        self.was_active = is_alive(self._active)
        self._left = self._read() if self.was_active else None

    def sign(self) -> None:
        """Notes that the node is active, due every `SIGN_PERIOD`."""
        with contextlib.suppress(OSError):
            if not self._active.exists():
                self._folder.mkdir(parents=True, exist_ok=True)
            sign(self._active)

    def end(self) -> None:
        """Notes that the node is not active any more."""
        with contextlib.suppress(OSError):
            self._active.unlink(missing_ok=True)

    def keep(self, result: Survey.Result) -> None:
        """Keeps the answer to a survey; to be called before its files get their names, for with that it is over."""
        self._left = None
        new = self._answer.with_suffix(".new")
        with contextlib.suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
            new.write_bytes(serialize_message(result))
            os.replace(new, self._answer)

    def answer_to(self, goal: Survey.Goal) -> Survey.Result | None:
        """The answer that the client of the node before may not have got, where this goal asks for it once more."""
        if self._left is None or goal.survey_id != Path(self._left.folder).name:
            return None
        return self._left if (Path(self._left.folder) / "run.json").is_file() else None

    def _read(self) -> Survey.Result | None:
        try:
            return deserialize_message(self._answer.read_bytes(), Survey.Result)
        except (OSError, RuntimeError):  # no survey yet; a file that is none of ours
            return None
