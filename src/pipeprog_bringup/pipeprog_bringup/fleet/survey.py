# SPDX-License-Identifier: Apache-2.0
"""One survey on a worker: the recording comes to a scratch folder, its results go from there to their place.

run.json goes last and says what the results are of: a folder whose run.json is missing or fits something else counts
for nothing, whatever stopped its survey.
"""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path
from typing import Any

from pipeprog_bringup.fleet import fingerprint
from pipeprog_bringup.fleet.storage import Place, link_or_fetch
from pipeprog_bringup.fleet.task import Outcome, Refused, Runner, Task, Unwanted, Watcher
from pipeprog_camera.errors import InputError

RUN, LOG = "run.json", "replay.log"


def survey(task: Task, scratch: Path, runner: Runner, watcher: Watcher) -> Outcome:
    """Survey one recording in `scratch`, an empty folder; raises SurveyFailure, StorageFailure or Unwanted."""
    started = time.monotonic()
    place = Place(task.out)
    try:
        watcher.tell({"stage": "fetching"})
        recording = scratch / "recording" / task.recording.uri.rstrip("/").rpartition("/")[2]
        link_or_fetch(task.recording.uri, recording)
        fetched = time.monotonic()
        # Reading a large recording takes minutes: not where nothing is there to compare it with.
        earlier = _whole_results(place, task)
        state = fingerprint.state(recording)
        digest = fingerprint.digest(task, recording) if earlier else ""
        if earlier and earlier["fleet"].get("digest") == digest:
            _keep(place, task, earlier)
            return Outcome(task.name, "kept")
        (scratch / f"boq{task.boq_kind}").write_bytes(task.boq)
        if task.board:
            (scratch / "board.yaml").write_bytes(task.board)
        facts = runner(task, scratch, watcher)
    except (InputError, Refused) as error:
        return Outcome(task.name, "refused", getattr(error, "reason", str(error)), getattr(error, "log", ""))
    if not watcher.is_wanted():
        raise Unwanted
    watcher.tell({"stage": "storing"})
    surveyed = time.monotonic()
    facts = {**facts, "host": socket.gethostname(), "fetch_s": round(fetched - started, 3)}
    # Of a recording that was still written to, nobody knows what was surveyed: the next call does it again.
    is_unchanged = fingerprint.state(recording) == state
    digest = (digest or fingerprint.digest(task, recording)) if is_unchanged else ""
    _publish(place, task, scratch / "results", {"digest": digest, **facts}, surveyed)
    return Outcome(task.name, "done", facts={**facts, "store_s": round(time.monotonic() - surveyed, 3)})


def record(place: Place, task: Task, outcome: Outcome) -> None:
    """Write down, in the folder of the results, why a recording has none; what was there of it before goes."""
    _clear(place, task.name, [LOG, RUN])
    log = outcome.log.encode(errors="replace")
    place.write(f"{task.name}/{LOG}", log)
    entry = {"state": outcome.state, "reason": outcome.reason, "sizes": {LOG: len(log)}}
    content = {"command": "fleet", "files": [LOG, RUN], "fleet": _entry(task, entry)}
    place.write(f"{task.name}/{RUN}", _json(content))


def _whole_results(place: Place, task: Task) -> dict[str, Any]:
    """The run.json of results that are there with all their files; empty without."""
    files = place.files(task.name)
    if RUN not in files:
        return {}
    content = fingerprint.parsed(place.read(f"{task.name}/{RUN}"))
    return content if content and fingerprint.is_whole(content, files) else {}


def _keep(place: Place, task: Task, content: dict[str, Any]) -> None:
    """Writes the input's new mark to results of the same content."""
    entry = {**content["fleet"], "mark": fingerprint.mark(task)}
    place.write(f"{task.name}/{RUN}", _json({**content, "fleet": entry}))


def _publish(place: Place, task: Task, results: Path, facts: dict[str, Any], surveyed: float) -> None:
    """Copy the results to their place; run.json, by which they count, is the first to go and the last to come."""
    names = sorted(file.relative_to(results).as_posix() for file in results.rglob("*") if file.is_file())
    own = [name for name in names if name != RUN]
    _clear(place, task.name, names)
    place.store(results, own, task.name)
    sizes = {name: (results / name).stat().st_size for name in own}
    run = json.loads((results / RUN).read_text())
    facts["store_s"] = round(time.monotonic() - surveyed, 3)
    entry = _entry(task, {"state": "done", "reason": "", "sizes": sizes, **facts})
    place.write(f"{task.name}/{RUN}", _json({**run, "bag": task.recording.uri, "files": names, "fleet": entry}))


def _clear(place: Place, name: str, following: list[str]) -> None:
    """Remove run.json, and then what will have no successor."""
    there = place.files(name)
    stale = [file for file in there if file not in following]
    place.remove(f"{name}/{file}" for file in ([RUN] if RUN in there else []) + [file for file in stale if file != RUN])


def _entry(task: Task, facts: dict[str, Any]) -> dict[str, Any]:
    """What run.json holds of the fleet under `fleet`."""
    return {"recording": task.recording.uri, "mark": fingerprint.mark(task), **facts}


def _json(content: dict[str, Any]) -> bytes:
    return (json.dumps(content, indent=1) + "\n").encode()
