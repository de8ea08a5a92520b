# SPDX-License-Identifier: Apache-2.0
"""Where a replay stands, as a file for programs: `pipeprog replay --progress FILE`."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pipeprog_bringup.playback.session import State

_SECONDS = 0.5  # between two states in the file; who reads it asks no more often


@contextlib.contextmanager
def state_file(path: Path | None, show: Callable[[State], None]) -> Iterator[Callable[[State], None]]:
    """Passes states on to `show`, and keeps `path` at the last one, a JSON object with the fields of State.

    Where the replay ends with an exception, the object is `{"failed": NAME OF ITS TYPE}`: of an InputError nothing is
    won by a second try.
    """
    if path is None:
        yield show
        return
    last = ("", 0.0)

    def keep(state: State) -> None:
        nonlocal last
        show(state)
        now = time.monotonic()
        if state.stage != last[0] or now > last[1] + _SECONDS:
            last = (state.stage, now)
            _write(path, dataclasses.asdict(state))

    try:
        yield keep
    except BaseException as error:
        with contextlib.suppress(OSError):  # a full disk may be what it ends of
            _write(path, {"failed": type(error).__name__})
        raise


def _write(path: Path, content: dict[str, Any]) -> None:
    """Replaces the file at once: a reader never finds half an object."""
    part = path.with_name(f"{path.name}.part")
    part.write_text(json.dumps(content) + "\n")
    part.replace(path)
